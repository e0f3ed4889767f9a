//! Fitting a link model to examples.

use super::descent::{Trainee, descend};
use super::examples::Examples;
use super::gru::{Batch, Gru, GruShape, Tape};
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
    /// Threads, at least 1; more than 4 are not used. Does not change the result.
    pub threads: usize,
}

impl Default for Fit {
    fn default() -> Self {
        Self { hidden: 32, epochs: 4, batch: 256, rate: 0.004, warm_up: 0.05, seed: 1, threads: 2 }
    }
}

/// State of a running fit, told after every gradient step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Gradient steps done.
    pub step: usize,
    /// Gradient steps in all.
    pub steps: usize,
    /// Weighted cross-entropy of this step's batch, nats.
    pub loss: f64,
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
        batch.gather(chosen, |i| examples.sequence(i));
        Gru::loss(self, batch, tape, |i| examples.target(i), scale, gradient)
    }
}

/// Trains a model on `examples` (raw features). The same examples and settings give the same bits on
/// the same kind of CPU, for any number of threads.
///
/// # Panics
/// When there is no example, or `batch`, `hidden` or `epochs` is zero.
pub fn fit(examples: &Examples, settings: &Fit, tell: impl FnMut(Progress)) -> LinkModel {
    assert!(!examples.is_empty() && settings.batch > 0 && settings.hidden > 0 && settings.epochs > 0);
    let mut rng = fastrand::Rng::with_seed(settings.seed);
    let mut model = LinkModel::random(GruShape { hidden: settings.hidden }, examples, &mut rng);
    let inputs = model.normalise(examples);
    descend(&mut model.gru, &inputs, settings, &mut rng, tell);
    model
}

/// Logits of all `examples` (raw features) under `model`.
pub fn logits(model: &LinkModel, examples: &Examples) -> Vec<f32> {
    let inputs = model.normalise(examples);
    let mut found = vec![0.0; inputs.len()];
    let (mut batch, mut tape) = (Batch::default(), Tape::default());
    let all: Vec<u32> = (0..inputs.len() as u32).collect();
    for chosen in all.chunks(1024) {
        batch.gather(chosen, |i| inputs.sequence(i));
        model.gru.forward(&batch, &mut tape);
        for (i, logit) in batch.order().iter().zip(tape.logits()) {
            found[*i as usize] = *logit;
        }
    }
    found
}
