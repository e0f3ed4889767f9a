//! Stochastic gradient descent over examples, a batch cut into parts that threads share.

use std::thread;

use super::adam::{Adam, Schedule};
use super::examples::Examples;
use super::fit::{Fit, Progress};

/// Parts that a batch is cut into. Each has its own gradient and they are added in order, so the
/// result is the same to the bit for any number of threads.
const PARTS: usize = 4;

/// A network that is being trained.
pub(super) trait Trainee: Sync {
    /// What one part of a batch needs to work in, kept between batches.
    type Scratch: Default + Send;

    /// The parameters.
    fn theta(&mut self) -> &mut Vec<f32>;

    /// The loss of `chosen` examples, and its gradient added to `gradient` (one number a parameter), both
    /// times `scale`.
    fn loss(
        &self,
        examples: &Examples,
        chosen: &[u32],
        scale: f32,
        scratch: &mut Self::Scratch,
        gradient: &mut [f32],
    ) -> f64;
}

#[derive(Default)]
struct Part<S> {
    scratch: S,
    gradient: Vec<f32>,
    loss: f64,
}

/// Trains `network` on `examples` by Adam; `rng` shuffles them for each epoch. The same input gives the
/// same bits on the same kind of CPU, for any number of threads.
pub(super) fn descend<N: Trainee>(
    network: &mut N,
    examples: &Examples,
    settings: &Fit,
    rng: &mut fastrand::Rng,
    mut tell: impl FnMut(Progress),
) {
    let parameters = network.theta().len();
    let mut adam = Adam::new(parameters);
    let steps = examples.len().div_ceil(settings.batch) * settings.epochs;
    let warm_up = (steps as f64 * settings.warm_up).ceil() as usize;
    let schedule = Schedule { peak: settings.rate, warm_up, steps };
    let mut order: Vec<u32> = (0..examples.len() as u32).collect();
    let mut parts: [Part<N::Scratch>; PARTS] = std::array::from_fn(|_| Part::default());
    let mut step = 0;
    for _ in 0..settings.epochs {
        rng.shuffle(&mut order);
        for chosen in order.chunks(settings.batch) {
            let weight: f32 = chosen.iter().map(|i| examples.target(*i).1).sum();
            let scale = 1.0 / weight.max(1e-6);
            run(&*network, examples, chosen, (scale, parameters), settings.threads, &mut parts);
            let (first, rest) = parts.split_at_mut(1);
            for part in &*rest {
                first[0].gradient.iter_mut().zip(&part.gradient).for_each(|(sum, g)| *sum += g);
            }
            adam.step(network.theta(), &first[0].gradient, schedule.rate(step));
            step += 1;
            tell(Progress { step, steps, loss: parts.iter().map(|part| part.loss).sum() });
        }
    }
}

/// Losses and gradients of all parts of a batch.
fn run<N: Trainee>(
    network: &N,
    examples: &Examples,
    chosen: &[u32],
    (scale, parameters): (f32, usize),
    threads: usize,
    parts: &mut [Part<N::Scratch>; PARTS],
) {
    let length = chosen.len().div_ceil(PARTS);
    let run = |work: &mut [Part<N::Scratch>], first: usize| {
        for (i, Part { scratch, gradient, loss }) in work.iter_mut().enumerate() {
            let start = ((first + i) * length).min(chosen.len());
            let chosen = &chosen[start..(start + length).min(chosen.len())];
            gradient.clear();
            gradient.resize(parameters, 0.0);
            *loss = network.loss(examples, chosen, scale, scratch, gradient);
        }
    };
    let share = PARTS.div_ceil(threads.clamp(1, PARTS));
    thread::scope(|scope| {
        let (own, others) = parts.split_at_mut(share);
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
