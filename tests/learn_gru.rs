//! Gradients against finite differences, training, reproducibility.
#![cfg(feature = "learn")]

mod learn_common;

use gakp::learn::{Batch, Examples, Fit, LinkModel, Tape, fit, literal, logits, metrics};
use learn_common::{examples, model};

/// Weighted cross-entropy by the literal loop in f64.
fn literal_loss(model: &LinkModel, theta: &[f64], inputs: &Examples) -> f64 {
    (0..inputs.len() as u32)
        .map(|i| {
            let (history, candidate) = inputs.sequence(i);
            let wide = |row: &[f32]| row.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
            let rows: Vec<Vec<f64>> = history.chunks_exact(candidate.len() - 6).map(wide).collect();
            let logit = literal::logit(model, theta, &rows, &wide(candidate));
            let (label, weight) = inputs.target(i);
            let p = 1.0 / (1.0 + (-logit).exp());
            -f64::from(weight) * if label > 0.5 { p.ln() } else { (1.0 - p).ln() }
        })
        .sum()
}

#[test]
fn gradients_equal_finite_differences_of_the_literal_loop() {
    let mut rng = fastrand::Rng::with_seed(7);
    let raw = examples(1, &mut rng);
    let model = model(5, &raw, &mut rng);
    let inputs = model.normalise(&raw);
    let (mut batch, mut tape) = (Batch::default(), Tape::default());
    batch.gather(&(0..inputs.len() as u32).collect::<Vec<_>>(), |i| inputs.sequence(i));
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
            "parameter {i} of {}: gradient {}, finite difference {difference}",
            theta.len(),
            gradient[i]
        );
    }
}

#[test]
fn learns_what_only_the_first_observation_tells() {
    let mut rng = fastrand::Rng::with_seed(3);
    let (seen, unseen) = (examples(400, &mut rng), examples(50, &mut rng));
    let settings = Fit { hidden: 12, epochs: 12, batch: 64, rate: 0.01, ..Fit::default() };
    let mut losses = vec![];
    let model = fit(&seen, &settings, |p| losses.push(p.loss));
    let found = metrics::scores(&logits(&model, &unseen), unseen.labels(), unseen.weights());
    assert!(found.auc > 0.95, "area under the curve on unseen examples: {}", found.auc);
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let tenth = losses.len() / 10;
    assert!(mean(&losses[losses.len() - tenth..]) < 0.6 * mean(&losses[..tenth]), "the loss falls");
}

#[test]
fn the_same_bits_for_any_number_of_threads_and_others_for_another_seed() {
    let mut rng = fastrand::Rng::with_seed(5);
    // A number of examples that leaves a last batch smaller than the number of shards.
    let examples = examples(8, &mut rng);
    let settings = |threads, seed| Fit { hidden: 8, epochs: 2, batch: 159, threads, seed, ..Fit::default() };
    let one = fit(&examples, &settings(1, 1), |_| {});
    for threads in 2..=5 {
        assert_eq!(one, fit(&examples, &settings(threads, 1), |_| {}), "{threads} threads");
    }
    assert_ne!(one.gru, fit(&examples, &settings(1, 2), |_| {}).gru);
}
