//! Fitting a link model to examples.

use serde::{Deserialize, Serialize};

use super::adam::Adam;
use super::descent::{Trainee, descend};
use super::examples::{Examples, Split};
use super::gru::{Batch, Gru, Tape};
use super::model::LinkModel;

/// How to train.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// Width of the hidden state.
    pub hidden: usize,
    /// Passes over the examples.
    pub epochs: usize,
    /// Examples a gradient step.
    pub batch: usize,
    /// Highest learning rate of Adam.
    pub rate: f32,
    /// Share of all steps that the learning rate rises.
    pub warm_up: f64,
    /// Seed of the initial parameters and of the order of examples.
    pub seed: u64,
    /// Epochs in a row without a lower validation loss after which training ends; 0: it goes on to the last.
    pub patience: usize,
    /// Threads, at least 1; more than 4 are not used. Does not change the result.
    pub threads: usize,
}

impl Default for Fit {
    fn default() -> Self {
        Self {
            hidden: 32,
            epochs: 4,
            batch: 256,
            rate: 0.004,
            warm_up: 0.05,
            seed: 1,
            patience: 2,
            threads: 2,
        }
    }
}

/// Loss of one pass over the examples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Epoch {
    /// Mean weighted cross-entropy of its batches, nats.
    pub training: f64,
    /// That of the validation examples after it; nothing where there are none.
    pub validation: Option<f64>,
}

/// The state of a fit after an epoch: what it needs to go on as if it had never been interrupted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// Epochs so far.
    pub epochs: Vec<Epoch>,
    pub(super) theta: Vec<f32>,
    pub(super) adam: Adam,
    /// Parameters after the epoch of least validation loss.
    pub(super) best: Vec<f32>,
    /// State of the random generator.
    pub(super) rng: u64,
}

impl Checkpoint {
    /// The epoch whose parameters are the result: that of least validation loss, the last one without
    /// validation. Counted from 0; nothing before the first.
    pub fn best_epoch(&self) -> Option<usize> {
        let last = self.epochs.len().checked_sub(1)?;
        let losses = self.epochs.iter().map(|e| e.validation).enumerate();
        let finite = losses.filter_map(|(i, loss)| Some((i, loss.filter(|l| l.is_finite())?)));
        let found = finite.min_by(|a, b| a.1.total_cmp(&b.1));
        Some(found.map_or(last, |(i, _)| i))
    }
}

/// State of a running fit, told after every gradient step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress<'a> {
    /// Gradient steps done.
    pub step: usize,
    /// Gradient steps in all.
    pub steps: usize,
    /// Weighted cross-entropy of this step's batch, nats.
    pub loss: f64,
    /// After the last step of an epoch.
    pub checkpoint: Option<&'a Checkpoint>,
}

impl Trainee for Gru {
    type Scratch = (Batch, Tape);

    fn theta(&mut self) -> &mut Vec<f32> {
        &mut self.theta
    }

    fn loss(
        &self,
        examples: &Examples,
        chosen: &[u32],
        scale: f32,
        (batch, tape): &mut Self::Scratch,
        gradient: &mut [f32],
    ) -> f64 {
        batch.gather(self.shape.features, chosen, |i| examples.sequence(i));
        Gru::loss(self, batch, tape, |i| examples.target(i), scale, gradient)
    }
}

/// Trains a model on `examples` (raw features), from the start or from the checkpoint of a fit of the same
/// examples and settings. The same examples and settings give the same bits on the same kind of CPU, for any
/// number of threads and however often it was interrupted. With it come the losses of the epochs.
///
/// # Panics
/// When there is no example, `batch`, `hidden` or `epochs` is zero, or `from` is of another network.
pub fn fit(
    examples: &Split,
    settings: &Fit,
    from: Option<Checkpoint>,
    tell: impl FnMut(Progress<'_>),
) -> (LinkModel, Vec<Epoch>) {
    settings.check(examples);
    let mut rng = fastrand::Rng::with_seed(settings.seed);
    let mut model = LinkModel::random(settings.hidden, &examples.training, &mut rng);
    let inputs = Split {
        training: model.normalise(&examples.training),
        validation: model.normalise(&examples.validation),
    };
    let epochs = descend(&mut model.gru, &inputs, settings, rng, from, tell);
    (model, epochs)
}

impl Fit {
    pub(super) fn check(&self, examples: &Split) {
        assert!(!examples.training.is_empty(), "examples to train on");
        assert!(self.batch > 0 && self.hidden > 0 && self.epochs > 0, "nothing of {self:?} may be zero");
    }
}

/// Logits of all `examples` (raw features) under `model`.
pub fn logits(model: &LinkModel, examples: &Examples) -> Vec<f32> {
    let inputs = model.normalise(examples);
    let mut found = vec![0.0; inputs.len()];
    let (mut batch, mut tape) = (Batch::default(), Tape::default());
    let all: Vec<u32> = (0..inputs.len() as u32).collect();
    for chosen in all.chunks(1024) {
        batch.gather(model.features(), chosen, |i| inputs.sequence(i));
        model.gru.forward(&batch, &mut tape);
        for (i, logit) in batch.order().iter().zip(tape.logits()) {
            found[*i as usize] = *logit;
        }
    }
    found
}
