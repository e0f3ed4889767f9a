//! Stochastic gradient descent over examples, a batch cut into parts that threads share.

use std::thread;

use super::adam::{Adam, Schedule};
use super::examples::{Examples, Split};
use super::fit::{Checkpoint, Epoch, Fit, Progress};

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

/// Trains `network` on `examples` by Adam; `rng` shuffles them for each epoch. It ends with the parameters of
/// the epoch of least validation loss (the last one where there is nothing to validate on), and gives the
/// losses of all epochs.
///
/// # Panics
/// When `from` is of another network.
pub(super) fn descend<N: Trainee>(
    network: &mut N,
    examples: &Split,
    settings: &Fit,
    mut rng: fastrand::Rng,
    from: Option<Checkpoint>,
    mut tell: impl FnMut(Progress<'_>),
) -> Vec<Epoch> {
    let Split { training, validation } = examples;
    let parameters = network.theta().len();
    let mut state = from.unwrap_or_else(|| Checkpoint {
        epochs: vec![],
        theta: network.theta().clone(),
        adam: Adam::new(parameters),
        best: network.theta().clone(),
        rng: rng.get_seed(),
    });
    assert_eq!(state.theta.len(), parameters, "the checkpoint is of this network");
    network.theta().clone_from(&state.theta);
    rng.seed(state.rng);
    let of_epoch = training.len().div_ceil(settings.batch);
    let steps = of_epoch * settings.epochs;
    let warm_up = (steps as f64 * settings.warm_up).ceil() as usize;
    let schedule = Schedule { peak: settings.rate, warm_up, steps };
    let mut order: Vec<u32> = vec![];
    let mut parts: [Part<N::Scratch>; PARTS] = std::array::from_fn(|_| Part::default());
    while state.epochs.len() < settings.epochs && !is_over(&state, settings.patience) {
        order.clear();
        order.extend(0..training.len() as u32);
        rng.shuffle(&mut order);
        let (mut sum, first) = (0.0, of_epoch * state.epochs.len());
        for (i, chosen) in order.chunks(settings.batch).enumerate() {
            let weight: f32 = chosen.iter().map(|i| training.target(*i).1).sum();
            let scale = 1.0 / weight.max(1e-6);
            run(&*network, training, chosen, (scale, parameters), settings.threads, &mut parts);
            let (own, rest) = parts.split_at_mut(1);
            for part in &*rest {
                own[0].gradient.iter_mut().zip(&part.gradient).for_each(|(sum, g)| *sum += g);
            }
            state.adam.step(network.theta(), &own[0].gradient, schedule.rate(first + i));
            let loss: f64 = parts.iter().map(|part| part.loss).sum();
            sum += loss;
            if i + 1 == of_epoch {
                let validation = loss_of(&*network, validation, settings, &mut parts);
                state.epochs.push(Epoch { training: sum / of_epoch as f64, validation });
                state.theta.clone_from(network.theta());
                state.rng = rng.get_seed();
                if state.best_epoch() == state.epochs.len().checked_sub(1) {
                    state.best.clone_from(&state.theta);
                }
            }
            let checkpoint = (i + 1 == of_epoch).then_some(&state);
            tell(Progress { step: first + i + 1, steps, loss, checkpoint });
        }
    }
    network.theta().clone_from(&state.best);
    state.epochs
}

/// Whether the last `patience` epochs have brought nothing.
fn is_over(state: &Checkpoint, patience: usize) -> bool {
    let since = state.best_epoch().map_or(0, |best| state.epochs.len() - 1 - best);
    patience > 0 && since >= patience
}

/// Mean weighted loss of `examples`; nothing where there are none.
fn loss_of<N: Trainee>(
    network: &N,
    examples: &Examples,
    settings: &Fit,
    parts: &mut [Part<N::Scratch>; PARTS],
) -> Option<f64> {
    const BATCH: usize = 1024;
    let all: Vec<u32> = (0..examples.len() as u32).collect();
    let weight: f64 = examples.weights().iter().map(|w| f64::from(*w)).sum();
    let mut sum = 0.0;
    for chosen in all.chunks(BATCH) {
        let parameters = parts[0].gradient.len();
        run(network, examples, chosen, (1.0, parameters), settings.threads, parts);
        sum += parts.iter().map(|part| part.loss).sum::<f64>();
    }
    (weight > 0.0).then(|| sum / weight)
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
