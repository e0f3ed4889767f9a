//! The network of explicit weights: gradients, training, and its ONNX file under ONNX Runtime.
#![cfg(feature = "learn")]

#[allow(dead_code)]
mod learn_common;

use gakp::learn::explicit::{Run, backward, encode, logit};
use gakp::learn::{
    Examples, ExplicitModel, ExplicitScorer, Fit, Split, fit_explicit, logits_explicit, metrics,
};
use gakp::track::association::explicit::COSTS;
use gakp::track::features::{appearance, relative};
use gakp::track::{Features, HISTORY, LinkRequest};

const FEATURES: [Features; 2] = [Features::Relative, Features::Appearance { embedding: 7 }];
use learn_common::request;

/// Requests whose columns are what they are in the tracker: an IoU, a distance, a time.
fn real(features: Features, tracks: usize, pairs: usize, rng: &mut fastrand::Rng) -> LinkRequest {
    let mut request = request(features, tracks, pairs, rng);
    for row in request.candidates.chunks_exact_mut(features.candidate()) {
        row[relative::IOU] = rng.f32();
        row[relative::MAHALANOBIS] = rng.f32();
        row[relative::DT] = 0.04 * (1 + rng.u32(0..5)) as f32;
        row[relative::INNOVATION] = 0.2 * (rng.f32() - 0.5);
        row[relative::INNOVATION + 1] = 0.2 * (rng.f32() - 0.5);
        if features.see_appearance() {
            row[appearance::MEAN_COSINE] = rng.f32();
            row[appearance::KNOWN] = f32::from(rng.u8(0..2));
        }
    }
    request
}

/// Whether overlap counts is told by the first observation of the track: only weights that a network
/// reads from the history can do it.
fn examples(features: Features, requests: usize, rng: &mut fastrand::Rng) -> Examples {
    let mut examples = Examples::of(features);
    for _ in 0..requests {
        let request = real(features, 7, 20, rng);
        examples.push(&request, |pair| {
            let first = request.histories[request.pairs[pair].track as usize * HISTORY * relative::STEP + 3];
            let row = &request.candidates[pair * features.candidate()..];
            let by_overlap = row[relative::IOU] > 0.5;
            let by_distance = row[relative::MAHALANOBIS] < 0.5;
            Some((if first > 3.0 { by_overlap } else { by_distance }, 0.5 + rng.f32()))
        });
    }
    examples
}

fn model(features: Features, hidden: usize, rng: &mut fastrand::Rng) -> (ExplicitModel, Examples) {
    let examples = examples(features, 2, rng);
    let mut model = ExplicitModel::random(hidden, &examples, rng);
    model.theta.iter_mut().for_each(|v| *v += 0.2 * (rng.f32() - 0.5));
    (model, examples)
}

#[test]
fn gradients_equal_finite_differences() {
    FEATURES.into_iter().for_each(gradients_equal);
}

fn gradients_equal(features: Features) {
    let mut rng = fastrand::Rng::with_seed(7);
    let (model, examples) = model(features, 5, &mut rng);
    let shape = model.shape;
    let inputs: Vec<(Vec<f64>, [f64; COSTS])> = (0..examples.len() as u32)
        .map(|i| {
            let (history, candidate) = examples.sequence(i);
            (model.normalised(history), model.features(candidate))
        })
        .collect();
    // Any smooth function of the logits does: the sum of their squares.
    let value = |theta: &[f64]| -> f64 {
        let mut run = Run::default();
        inputs
            .iter()
            .map(|(history, features)| {
                encode(shape, theta, history, &mut run);
                logit(shape, theta, &run, features).powi(2)
            })
            .sum()
    };
    let theta = model.theta64();
    let (mut run, mut gradient) = (Run::default(), vec![0.0; theta.len()]);
    for (history, features) in &inputs {
        encode(shape, &theta, history, &mut run);
        let d = 2.0 * logit(shape, &theta, &run, features);
        backward(shape, &theta, (history, features), &run, d, &mut gradient);
    }
    let scale = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    for i in 0..theta.len() {
        let moved = |by: f64| {
            let mut theta = theta.clone();
            theta[i] += by;
            value(&theta)
        };
        let difference = (moved(1e-5) - moved(-1e-5)) / 2e-5;
        let error = (gradient[i] - difference).abs();
        assert!(
            error < 1e-6 * difference.abs() + 1e-7 * scale,
            "{features}: parameter {i}: gradient {}, finite difference {difference}",
            gradient[i]
        );
    }
}

#[test]
fn weights_are_positive_and_follow_the_history() {
    let mut rng = fastrand::Rng::with_seed(3);
    let (seen, unseen) =
        (examples(Features::Relative, 300, &mut rng), examples(Features::Relative, 50, &mut rng));
    let settings = Fit { hidden: 12, epochs: 12, batch: 64, rate: 0.01, ..Fit::default() };
    let (model, _) = fit_explicit(&seen.into(), &settings, None, |_| {});
    let found = metrics::scores(&logits_explicit(&model, &unseen), unseen.labels(), unseen.weights());
    assert!(found.auc > 0.95, "area under the curve on unseen examples: {}", found.auc);
    let (mut scorer, request) = (ExplicitScorer::new(model), real(Features::Relative, 12, 1, &mut rng));
    let mut by_overlap = [(0.0, 0); 2];
    for (rows, length) in request.histories.chunks_exact(HISTORY * relative::STEP).zip(&request.lengths) {
        let weights = scorer.weights(&rows[..*length as usize * relative::STEP]);
        assert!(weights[..COSTS - 1].iter().all(|weight| *weight > 0.0), "{weights:?}");
        let kind = &mut by_overlap[usize::from(rows[3] > 3.0)];
        *kind = (kind.0 + weights[1], kind.1 + 1);
    }
    let [(distance, a), (overlap, b)] = by_overlap;
    assert!(overlap / f64::from(b) > distance / f64::from(a), "{by_overlap:?}");
}

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let mut rng = fastrand::Rng::with_seed(5);
    let examples = Split::from(examples(Features::Relative, 8, &mut rng));
    let settings = |threads, seed| Fit { hidden: 6, epochs: 1, batch: 61, threads, seed, ..Fit::default() };
    let one = fit_explicit(&examples, &settings(1, 1), None, |_| {});
    for threads in 2..=4 {
        assert_eq!(one, fit_explicit(&examples, &settings(threads, 1), None, |_| {}), "{threads} threads");
    }
    assert_ne!(one, fit_explicit(&examples, &settings(1, 2), None, |_| {}));
}

#[cfg(feature = "infer")]
mod infer_support;

#[cfg(feature = "infer")]
#[test]
fn onnx_runtime_equals_the_scorer() {
    use gakp::infer::{Linker, ModelSettings};
    use gakp::learn::onnx;
    use gakp::track::Association;
    use std::sync::Arc;

    let Some(folder) = infer_support::models() else { return };
    let mut rng = fastrand::Rng::with_seed(17);
    for (features, hidden) in FEATURES.into_iter().flat_map(|features| [(features, 1), (features, 16)]) {
        let (model, _) = model(features, hidden, &mut rng);
        let written = tempfile::tempdir().expect("a folder");
        let file = written.path().join("explicit.onnx");
        std::fs::write(&file, onnx::write_explicit(&model, "a test", &Default::default())).expect("written");
        let entry = format!(
            "[[model]]\nname = \"e\"\ntask = \"link\"\nfamily = \"explicit\"\nfile = \"explicit.onnx\"\n\
             sha256 = \"{}\"\nlicense = \"none\"\n",
            infer_support::sha256(&file)
        );
        let manifest = written.path().join("manifest.toml");
        std::fs::write(&manifest, entry).expect("written");
        let settings = ModelSettings {
            manifest,
            link: "e".into(),
            onnxruntime: Some(folder.join("cache/libonnxruntime.so")),
            ..infer_support::settings(&folder)
        };
        let linker = Linker::load(&settings, Arc::new(())).expect("ONNX Runtime takes the file");
        assert!(linker.check_suits(Association::Explicit).is_ok());
        let refused = linker.check_suits(Association::Implicit).expect_err("refused").to_string();
        assert!(refused.contains("no network of the association \"implicit\""), "{refused}");
        let (mut scorer, mut expected) = (ExplicitScorer::new(model), vec![]);
        for (tracks, pairs) in [(1, 1), (16, 40), (100, 400)] {
            let request = real(features, tracks, pairs, &mut rng);
            scorer.score(&request, &mut expected);
            let found = linker.score_blocking(request).expect("probabilities");
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(&expected) {
                assert!((found - expected).abs() <= 2e-5, "{features}, hidden {hidden}: {found}, {expected}");
            }
        }
        linker.shutdown();
    }
}
