//! Fitting the network of explicit weights to examples.

use std::thread;

use super::super::adam::{Adam, Schedule};
use super::super::examples::Examples;
use super::super::fit::{Fit, Progress};
use super::super::gru::cross_entropy;
use super::{ExplicitModel, ExplicitShape, Run, backward, encode, logit, sigmoid};
use crate::track::association::explicit::COSTS;

/// Parts that a batch is cut into, as in [`super::super::fit()`]: the same bits for any number of threads.
const SHARDS: usize = 4;

/// An example as the network takes it.
type Input = (Vec<f64>, [f64; COSTS]);

#[derive(Default)]
struct Shard {
    run: Run,
    gradient: Vec<f64>,
    loss: f64,
}

/// Trains a network on `examples` (raw features); the same examples and settings give the same bits on
/// the same kind of CPU, for any number of threads.
///
/// # Panics
/// When there is no example, or `batch`, `hidden` or `epochs` is zero.
pub fn fit_explicit(examples: &Examples, settings: &Fit, mut tell: impl FnMut(Progress)) -> ExplicitModel {
    assert!(!examples.is_empty() && settings.batch > 0 && settings.hidden > 0 && settings.epochs > 0);
    let mut rng = fastrand::Rng::with_seed(settings.seed);
    let shape = ExplicitShape { hidden: settings.hidden };
    let mut model = ExplicitModel::random(shape, examples, &mut rng);
    let mut adam = Adam::new(shape.parameters());
    let steps = examples.len().div_ceil(settings.batch) * settings.epochs;
    let warm_up = (steps as f64 * settings.warm_up).ceil() as usize;
    let schedule = Schedule { peak: settings.rate, warm_up, steps };
    let mut order: Vec<u32> = (0..examples.len() as u32).collect();
    let mut shards: [Shard; SHARDS] = Default::default();
    let mut step = 0;
    for _ in 0..settings.epochs {
        rng.shuffle(&mut order);
        for chosen in order.chunks(settings.batch) {
            let weight: f32 = chosen.iter().map(|i| examples.target(*i).1).sum();
            let scale = 1.0 / f64::from(weight.max(1e-6));
            gradient(&model, examples, chosen, scale, settings.threads, &mut shards);
            let sum: Vec<f32> = (0..shape.parameters())
                .map(|i| shards.iter().map(|shard| shard.gradient[i]).sum::<f64>() as f32)
                .collect();
            adam.step(&mut model.theta, &sum, schedule.rate(step));
            step += 1;
            tell(Progress { step, steps, loss: shards.iter().map(|s| s.loss).sum() });
        }
    }
    model
}

fn gradient(
    model: &ExplicitModel,
    examples: &Examples,
    chosen: &[u32],
    scale: f64,
    threads: usize,
    shards: &mut [Shard; SHARDS],
) {
    let theta = model.theta64();
    let part = chosen.len().div_ceil(SHARDS);
    let run = |work: &mut [Shard], first: usize| {
        for (i, shard) in work.iter_mut().enumerate() {
            let start = ((first + i) * part).min(chosen.len());
            shard.run(model, &theta, examples, &chosen[start..(start + part).min(chosen.len())], scale);
        }
    };
    let share = SHARDS.div_ceil(threads.clamp(1, SHARDS));
    thread::scope(|scope| {
        let (own, others) = shards.split_at_mut(share);
        for (i, work) in others.chunks_mut(share).enumerate() {
            let first = (i + 1) * share;
            thread::Builder::new()
                .name(format!("gradient-{}", i + 1))
                .spawn_scoped(scope, move || run(work, first))
                .expect("the system gives a training run its threads");
        }
        run(own, 0);
    });
}

impl Shard {
    fn run(&mut self, model: &ExplicitModel, theta: &[f64], examples: &Examples, chosen: &[u32], scale: f64) {
        self.gradient.clear();
        self.gradient.resize(theta.len(), 0.0);
        self.loss = 0.0;
        for i in chosen {
            let (history, features) = input(model, examples, *i);
            encode(model.shape, theta, &history, &mut self.run);
            let logit = logit(model.shape, theta, &self.run, &features);
            let (label, weight) = examples.target(*i);
            let weight = f64::from(weight) * scale;
            self.loss += weight * cross_entropy(logit as f32, label);
            let d_logit = (sigmoid(logit) - f64::from(label)) * weight;
            let inputs = (&history[..], &features);
            backward(model.shape, theta, inputs, &self.run, d_logit, &mut self.gradient);
        }
    }
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
