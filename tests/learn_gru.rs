//! Gradients against finite differences, training, reproducibility.
#![cfg(feature = "learn")]

mod learn_common;

use gakp::learn::{Batch, Checkpoint, Examples, Fit, LinkModel, Split, Tape, fit, literal, logits, metrics};
use gakp::track::Features;
use learn_common::{FEATURES, examples, model};

/// Weighted cross-entropy by the literal loop in f64.
fn literal_loss(model: &LinkModel, theta: &[f64], inputs: &Examples) -> f64 {
    (0..inputs.len() as u32)
        .map(|i| {
            let (history, candidate) = inputs.sequence(i);
            let wide = |row: &[f32]| row.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
            let rows: Vec<Vec<f64>> = history.chunks_exact(inputs.features().step()).map(wide).collect();
            let logit = literal::logit(model, theta, &rows, &wide(candidate));
            let (label, weight) = inputs.target(i);
            let p = 1.0 / (1.0 + (-logit).exp());
            -f64::from(weight) * if label > 0.5 { p.ln() } else { (1.0 - p).ln() }
        })
        .sum()
}

#[test]
fn gradients_equal_finite_differences_of_the_literal_loop() {
    for features in FEATURES {
        gradients_equal(features);
    }
}

fn gradients_equal(features: Features) {
    let mut rng = fastrand::Rng::with_seed(7);
    let raw = examples(features, 1, &mut rng);
    let model = model(5, &raw, &mut rng);
    let inputs = model.normalise(&raw);
    let (mut batch, mut tape) = (Batch::default(), Tape::default());
    batch.gather(features, &(0..inputs.len() as u32).collect::<Vec<_>>(), |i| inputs.sequence(i));
    let mut gradient = vec![0.0f32; model.gru.theta.len()];
    let loss = model.gru.loss(&batch, &mut tape, |i| inputs.target(i), 1.0, &mut gradient);

    let theta: Vec<f64> = model.gru.theta.iter().map(|v| f64::from(*v)).collect();
    let exact = literal_loss(&model, &theta, &inputs);
    assert!((loss - exact).abs() < 1e-5 * exact, "loss {loss}, literally {exact}");
    let scale = gradient.iter().fold(0.0f64, |m, g| m.max(f64::from(g.abs())));
    for i in 0..theta.len() {
        let moved = |by: f64| {
            let mut theta = theta.clone();
            theta[i] += by;
            literal_loss(&model, &theta, &inputs)
        };
        let difference = (moved(1e-5) - moved(-1e-5)) / 2e-5;
        let error = (f64::from(gradient[i]) - difference).abs();
        assert!(
            error < 1e-3 * difference.abs() + 1e-5 * scale,
            "{features}: parameter {i} of {}: gradient {}, finite difference {difference}",
            theta.len(),
            gradient[i]
        );
    }
}

#[test]
fn learns_what_only_the_first_observation_tells() {
    // With one W for all steps, observations and candidate look alike: too hard for so few examples.
    for features in [Features::Relative, Features::Appearance { embedding: 7 }] {
        learns(features);
    }
}

fn learns(features: Features) {
    let mut rng = fastrand::Rng::with_seed(3);
    let (seen, unseen) = (examples(features, 400, &mut rng), examples(features, 50, &mut rng));
    let settings = Fit { hidden: 12, epochs: 12, batch: 64, rate: 0.01, ..Fit::default() };
    let mut losses = vec![];
    let (model, _) = fit(&seen.into(), &settings, None, |p| losses.push(p.loss));
    let found = metrics::scores(&logits(&model, &unseen), unseen.labels(), unseen.weights());
    assert!(found.auc > 0.95, "{features}: area under the curve on unseen examples: {}", found.auc);
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let tenth = losses.len() / 10;
    assert!(
        mean(&losses[losses.len() - tenth..]) < 0.6 * mean(&losses[..tenth]),
        "{features}: the loss falls"
    );
}

#[test]
fn the_same_bits_for_any_number_of_threads_and_others_for_another_seed() {
    let mut rng = fastrand::Rng::with_seed(5);
    // A number of examples that leaves a last batch smaller than the number of shards.
    let examples = Split::from(examples(Features::Relative, 8, &mut rng));
    let settings = |threads, seed| Fit { hidden: 8, epochs: 2, batch: 159, threads, seed, ..Fit::default() };
    let (one, _) = fit(&examples, &settings(1, 1), None, |_| {});
    for threads in 2..=5 {
        assert_eq!(one, fit(&examples, &settings(threads, 1), None, |_| {}).0, "{threads} threads");
    }
    assert_ne!(one.gru, fit(&examples, &settings(1, 2), None, |_| {}).0.gru);
}

#[test]
fn an_interrupted_fit_goes_on_to_the_same_bits() {
    let mut rng = fastrand::Rng::with_seed(11);
    let examples = Split {
        training: examples(Features::Relative, 30, &mut rng),
        validation: examples(Features::Relative, 5, &mut rng),
    };
    let settings = Fit { hidden: 8, epochs: 5, batch: 64, patience: 0, ..Fit::default() };
    let mut states: Vec<Checkpoint> = vec![];
    let (whole, losses) = fit(&examples, &settings, None, |p| states.extend(p.checkpoint.cloned()));
    assert_eq!((losses.len(), states.len()), (5, 5));
    for state in states {
        let text = serde_json::to_string(&state).expect("JSON");
        let done = state.epochs.len();
        let read = serde_json::from_str(&text).expect("a checkpoint");
        let mut steps = vec![];
        let (resumed, again) = fit(&examples, &settings, Some(read), |p| steps.push(p.step));
        assert_eq!((resumed, again), (whole.clone(), losses.clone()), "after epoch {done}");
        assert_eq!(steps.len(), examples.training.len().div_ceil(64) * (5 - done));
    }
}

#[test]
fn stops_where_validation_does_and_keeps_the_best_epoch() {
    let mut rng = fastrand::Rng::with_seed(13);
    // Few examples for many parameters: it learns them by heart, which helps nobody else.
    let examples = Split {
        training: examples(Features::Relative, 2, &mut rng),
        validation: examples(Features::Relative, 20, &mut rng),
    };
    let settings = Fit { hidden: 32, epochs: 60, batch: 8, rate: 0.03, patience: 3, ..Fit::default() };
    let mut states: Vec<Checkpoint> = vec![];
    let (_, losses) = fit(&examples, &settings, None, |p| states.extend(p.checkpoint.cloned()));
    assert!(losses.len() < 60, "{} epochs", losses.len());
    let best = states.last().and_then(Checkpoint::best_epoch).expect("an epoch");
    assert_eq!(best + 3, losses.len() - 1, "three epochs without a lower loss");
    let at_best = Fit { epochs: 60, patience: 0, ..settings.clone() };
    let (all, _) = fit(&examples, &at_best, None, |_| {});
    let (stopped, _) = fit(&examples, &settings, None, |_| {});
    let loss = |model: &LinkModel| {
        let v = &examples.validation;
        metrics::scores(&logits(model, v), v.labels(), v.weights()).loss
    };
    // Both keep their best epoch; going on may at most find a better one.
    assert!(loss(&all) <= loss(&stopped) + 1e-6, "{} and {}", loss(&all), loss(&stopped));
    let unchecked = Split::from(examples.training.clone());
    assert!(loss(&fit(&unchecked, &at_best, None, |_| {}).0) > loss(&stopped), "the last epoch is worse");
}
