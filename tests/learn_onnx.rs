//! The Rust scorer, the literal loop and the ONNX file are one and the same network.
#![cfg(feature = "learn")]

mod learn_common;

use std::collections::BTreeMap;

use gakp::learn::{GruScorer, LinkModel, literal, onnx};
use gakp::track::LinkRequest;
use learn_common::{FEATURES, examples, model, request};

fn models() -> impl Iterator<Item = (usize, LinkModel, Vec<LinkRequest>)> {
    let mut rng = fastrand::Rng::with_seed(11);
    let kinds = FEATURES.into_iter().flat_map(|features| [1, 8, 32, 134].map(|hidden| (features, hidden)));
    kinds.map(move |(features, hidden)| {
        let model = model(hidden, &examples(features, 30, &mut rng), &mut rng);
        let sizes = [(1, 1), (1, 9), (13, 1), (16, 40), (100, 400)];
        let requests = sizes.map(|(tracks, pairs)| request(features, tracks, pairs, &mut rng)).to_vec();
        (hidden, model, requests)
    })
}

#[test]
fn scorer_equals_the_literal_loop() {
    for (hidden, model, requests) in models() {
        let mut scorer = GruScorer::new(model.clone());
        let mut found = vec![0.5];
        // One scorer for all requests: nothing may remain from the larger call before.
        for request in requests.iter().rev().chain(&requests) {
            scorer.score(request, &mut found);
            assert_eq!(found.len(), request.pairs.len());
            for (pair, p) in found.iter().enumerate() {
                let exact = literal::probability(&model, request, pair);
                assert!(
                    (f64::from(*p) - exact).abs() <= 1e-5,
                    "{}, hidden {hidden}, pair {pair}: {p}, {exact}",
                    model.features()
                );
            }
        }
        scorer.score(&LinkRequest::default(), &mut found);
        assert!(found.is_empty());
    }
}

#[test]
fn a_file_gives_its_model_back() {
    let metadata = BTreeMap::from([("licence".to_owned(), "none".to_owned())]);
    for (hidden, model, _) in models() {
        let bytes = onnx::write(&model, "a test", &metadata);
        let (again, found) = onnx::read(&bytes).expect("what was written is read");
        assert_eq!(model, again, "hidden {hidden}");
        assert_eq!(found["licence"], "none");
        assert_eq!(found["hidden"], hidden.to_string());
    }
}

#[test]
fn other_files_are_refused_with_a_reason() {
    let refused = |bytes: &[u8]| onnx::read(bytes).expect_err("refused").to_string();
    assert!(refused(b"\xff\xff\xffnot a model").contains("not an ONNX model"));
    assert!(refused(b"").contains("\"readout.v\" is missing"), "an empty file decodes to an empty model");
    let (_, model, _) = models().next().expect("one model");
    let bytes = onnx::write(&model, "", &BTreeMap::new());
    for cut in [bytes.len() / 3, bytes.len() / 2, bytes.len() - 200] {
        assert!(onnx::read(&bytes[..cut]).is_err(), "cut at {cut} of {}", bytes.len());
    }
}
