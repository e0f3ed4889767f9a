//! Fitting the network of explicit weights to examples.

use super::super::descent::{Trainee, descend};
use super::super::examples::{Examples, Split};
use super::super::fit::{Checkpoint, Epoch, Fit, Progress};
use super::super::gru::cross_entropy;
use super::{ExplicitModel, Run, backward, encode, logit, sigmoid};
use crate::track::association::explicit::COSTS;

/// An example as the network takes it.
type Input = (Vec<f64>, [f64; COSTS]);

/// The work of one part of a batch.
#[derive(Default)]
pub struct Scratch {
    run: Run,
    theta: Vec<f64>,
    gradient: Vec<f64>,
}

impl Trainee for ExplicitModel {
    type Scratch = Scratch;

    fn theta(&mut self) -> &mut Vec<f32> {
        &mut self.theta
    }

    fn loss(
        &self,
        examples: &Examples,
        chosen: &[u32],
        scale: f32,
        scratch: &mut Scratch,
        gradient: &mut [f32],
    ) -> f64 {
        let Scratch { run, theta, gradient: sum } = scratch;
        theta.clear();
        theta.extend(self.theta.iter().map(|v| f64::from(*v)));
        sum.clear();
        sum.resize(theta.len(), 0.0);
        let mut loss = 0.0;
        for i in chosen {
            let (history, features) = input(self, examples, *i);
            encode(self.shape, theta, &history, run);
            let logit = logit(self.shape, theta, run, &features);
            let (label, weight) = examples.target(*i);
            let weight = f64::from(weight * scale);
            loss += weight * cross_entropy(logit as f32, label);
            let d_logit = (sigmoid(logit) - f64::from(label)) * weight;
            backward(self.shape, theta, (&history[..], &features), run, d_logit, sum);
        }
        gradient.iter_mut().zip(&*sum).for_each(|(g, sum)| *g += *sum as f32);
        loss
    }
}

/// Trains a network on `examples` (raw features); as [`super::super::fit()`].
///
/// # Panics
/// As [`super::super::fit()`].
pub fn fit_explicit(
    examples: &Split,
    settings: &Fit,
    from: Option<Checkpoint>,
    tell: impl FnMut(Progress<'_>),
) -> (ExplicitModel, Vec<Epoch>) {
    settings.check(examples);
    let mut rng = fastrand::Rng::with_seed(settings.seed);
    let mut model = ExplicitModel::random(settings.hidden, &examples.training, &mut rng);
    let epochs = descend(&mut model, examples, settings, rng, from, tell);
    (model, epochs)
}

fn input(model: &ExplicitModel, examples: &Examples, i: u32) -> Input {
    let (history, candidate) = examples.sequence(i);
    (model.normalised(history), model.features(candidate))
}

/// Logits of all `examples` (raw features) under `model`.
pub fn logits_explicit(model: &ExplicitModel, examples: &Examples) -> Vec<f32> {
    let (theta, mut run) = (model.theta64(), Run::default());
    (0..examples.len() as u32)
        .map(|i| {
            let (history, features) = input(model, examples, i);
            encode(model.shape, &theta, &history, &mut run);
            logit(model.shape, &theta, &run, &features) as f32
        })
        .collect()
}
