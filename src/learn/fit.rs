//! Fitting a link model to examples.

use std::thread;

use super::adam::{Adam, Schedule};
use super::examples::Examples;
use super::gru::{Batch, Gru, GruShape, Tape};
use super::model::LinkModel;

/// Parts that a batch is cut into. Each has its own gradient and they are added in order, so the
/// result is the same to the bit for any number of threads.
const SHARDS: usize = 4;

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

#[derive(Default)]
struct Shard {
    batch: Batch,
    tape: Tape,
    gradient: Vec<f32>,
    loss: f64,
}

impl Shard {
    fn run(&mut self, gru: &Gru, examples: &Examples, chosen: &[u32], scale: f32) {
        self.gradient.clear();
        self.gradient.resize(gru.shape.parameters(), 0.0);
        self.batch.gather(chosen, |i| examples.sequence(i));
        self.loss = gru.loss(&self.batch, &mut self.tape, |i| examples.target(i), scale, &mut self.gradient);
    }
}

/// Trains a model on `examples` (raw features). The same examples and settings give the same bits on
/// the same kind of CPU, for any number of threads.
///
/// # Panics
/// When there is no example, or `batch`, `hidden` or `epochs` is zero.
pub fn fit(examples: &Examples, settings: &Fit, mut tell: impl FnMut(Progress)) -> LinkModel {
    assert!(!examples.is_empty() && settings.batch > 0 && settings.hidden > 0 && settings.epochs > 0);
    let mut rng = fastrand::Rng::with_seed(settings.seed);
    let mut model = LinkModel::random(GruShape { hidden: settings.hidden }, examples, &mut rng);
    let inputs = model.normalise(examples);
    let mut adam = Adam::new(model.gru.theta.len());
    let batches = inputs.len().div_ceil(settings.batch);
    let steps = batches * settings.epochs;
    let warm_up = (steps as f64 * settings.warm_up).ceil() as usize;
    let schedule = Schedule { peak: settings.rate, warm_up, steps };
    let mut order: Vec<u32> = (0..inputs.len() as u32).collect();
    let mut shards: [Shard; SHARDS] = Default::default();
    let mut step = 0;
    for _ in 0..settings.epochs {
        rng.shuffle(&mut order);
        for chosen in order.chunks(settings.batch) {
            let weight: f32 = chosen.iter().map(|i| inputs.target(*i).1).sum();
            gradient(&model.gru, &inputs, chosen, 1.0 / weight.max(1e-6), settings.threads, &mut shards);
            let (first, rest) = shards.split_at_mut(1);
            for shard in &*rest {
                first[0].gradient.iter_mut().zip(&shard.gradient).for_each(|(sum, g)| *sum += g);
            }
            adam.step(&mut model.gru.theta, &first[0].gradient, schedule.rate(step));
            step += 1;
            tell(Progress { step, steps, loss: shards.iter().map(|s| s.loss).sum() });
        }
    }
    model
}

fn gradient(
    gru: &Gru,
    inputs: &Examples,
    chosen: &[u32],
    scale: f32,
    threads: usize,
    shards: &mut [Shard; SHARDS],
) {
    let part = chosen.len().div_ceil(SHARDS);
    let run = |work: &mut [Shard], first: usize| {
        for (i, shard) in work.iter_mut().enumerate() {
            let start = ((first + i) * part).min(chosen.len());
            shard.run(gru, inputs, &chosen[start..(start + part).min(chosen.len())], scale);
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
