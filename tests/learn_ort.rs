//! ONNX Runtime gives the file's network the same probabilities as the scorer in Rust.
#![cfg(all(feature = "learn", feature = "infer"))]

mod infer_support;
mod learn_common;

use std::collections::BTreeMap;
use std::fs;
use std::sync::Arc;

use gakp::infer::{Linker, ModelSettings};
use gakp::learn::{GruScorer, onnx};
use infer_support::{models, settings, sha256};
use learn_common::{examples, model, request};

#[test]
fn onnx_runtime_equals_the_scorer() {
    let Some(folder) = models() else { return };
    let mut rng = fastrand::Rng::with_seed(17);
    let raw = examples(30, &mut rng);
    for hidden in [1, 32, 134] {
        let model = model(hidden, &raw, &mut rng);
        let written = tempfile::tempdir().expect("a folder");
        let file = written.path().join("link.onnx");
        fs::write(&file, onnx::write(&model, "a test", &BTreeMap::new())).expect("written");
        let manifest = written.path().join("manifest.toml");
        let entry = format!(
            "[[model]]\nname = \"link\"\ntask = \"link\"\nfamily = \"gru\"\nfile = \"link.onnx\"\n\
             sha256 = \"{}\"\nlicense = \"none\"\n",
            sha256(&file)
        );
        fs::write(&manifest, entry).expect("written");
        let settings = ModelSettings {
            manifest,
            link: "link".into(),
            onnxruntime: Some(folder.join("cache/libonnxruntime.so")),
            ..settings(&folder)
        };
        let linker = Linker::load(&settings, Arc::new(())).expect("ONNX Runtime takes the file");
        let (mut scorer, mut expected) = (GruScorer::new(model), vec![]);
        for (tracks, pairs) in [(1, 1), (16, 40), (100, 400)] {
            let request = request(tracks, pairs, &mut rng);
            scorer.score(&request, &mut expected);
            let found = linker.score_blocking(request).expect("probabilities");
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(&expected) {
                assert!((found - expected).abs() <= 1e-5, "hidden {hidden}: {found}, {expected}");
            }
        }
        linker.shutdown();
    }
}
