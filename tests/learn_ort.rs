//! ONNX Runtime gives the file's network the same probabilities as the scorer in Rust.
#![cfg(all(feature = "learn", feature = "infer"))]

mod infer_support;
mod learn_common;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use gakp::infer::{Linker, ModelSettings};
use gakp::learn::{GruScorer, LinkModel, onnx};
use gakp::track::{Dense, EXISTENCE_FEATURES, ExistenceHead, Features, TrackerConfig};
use infer_support::{models, settings, sha256};
use learn_common::{FEATURES, examples, model, request};

/// Writes a link model with `metadata` and its manifest to `to`; settings that name it.
fn write(to: &Path, models: &Path, model: &LinkModel, metadata: &BTreeMap<String, String>) -> ModelSettings {
    write_bytes(to, models, &onnx::write(model, "a test", metadata))
}

/// [`write()`] for a file that is there already.
fn write_bytes(to: &Path, models: &Path, bytes: &[u8]) -> ModelSettings {
    let file = to.join("link.onnx");
    fs::write(&file, bytes).expect("written");
    let manifest = to.join("manifest.toml");
    let entry = format!(
        "[[model]]\nname = \"link\"\ntask = \"link\"\nfamily = \"gru\"\nfile = \"link.onnx\"\n\
         sha256 = \"{}\"\nlicense = \"none\"\n",
        sha256(&file)
    );
    fs::write(&manifest, entry).expect("written");
    ModelSettings {
        manifest,
        link: "link".into(),
        onnxruntime: Some(models.join("cache/libonnxruntime.so")),
        ..settings(models)
    }
}

#[test]
fn the_existence_head_travels_in_the_file() {
    let Some(folder) = models() else { return };
    let mut rng = fastrand::Rng::with_seed(19);
    let model = model(8, &examples(Features::Relative, 30, &mut rng), &mut rng);
    let layer = Dense { weights: vec![0.25; EXISTENCE_FEATURES], bias: vec![-0.5] };
    let head = ExistenceHead::new([0.1; EXISTENCE_FEATURES], [3.0; EXISTENCE_FEATURES], vec![layer]);
    let head = head.expect("a network");
    for (text, expected) in
        [(head.to_string(), Ok(head)), (format!("{EXISTENCE_FEATURES} 1 0 7"), Err("ends early"))]
    {
        let written = tempfile::tempdir().expect("a folder");
        let metadata = BTreeMap::from([("existence".to_owned(), text)]);
        let settings = write(written.path(), &folder, &model, &metadata);
        match (Linker::load(&settings, Arc::new(())), expected) {
            (Ok(linker), Ok(expected)) => {
                let found = linker.calibrate(TrackerConfig::default()).existence.head;
                assert_eq!(found.as_deref(), Some(&expected));
                linker.shutdown();
            }
            (Err(error), Err(expected)) => {
                let error = error.to_string();
                assert!(error.contains("existence head") && error.contains(expected), "{error}");
            }
            (Ok(_), Err(_)) => panic!("a broken head is taken"),
            (Err(error), Ok(_)) => panic!("{error}"),
        }
    }
}

#[test]
fn onnx_runtime_equals_the_scorer() {
    let Some(folder) = models() else { return };
    let mut rng = fastrand::Rng::with_seed(17);
    let kinds = FEATURES.into_iter().flat_map(|features| [1, 32, 134].map(|hidden| (features, hidden)));
    for (features, hidden) in kinds {
        let model = model(hidden, &examples(features, 30, &mut rng), &mut rng);
        let written = tempfile::tempdir().expect("a folder");
        let settings = write(written.path(), &folder, &model, &BTreeMap::new());
        let linker = Linker::load(&settings, Arc::new(())).expect("ONNX Runtime takes the file");
        let tracker = linker.calibrate(TrackerConfig::default());
        assert!(tracker.existence.head.is_none());
        assert_eq!(tracker.association.features, features);
        for width in [None, Some(0), Some(features.embedding().unwrap_or(9)), Some(10)] {
            let fits = features.embedding().is_none_or(|expected| width == Some(expected));
            assert_eq!(linker.check_embeddings(width).is_ok(), fits, "{features}, embeddings of {width:?}");
        }
        let other = FEATURES.into_iter().find(|other| *other != features).expect("another");
        let refused = linker.score_blocking(request(other, 2, 2, &mut rng)).expect_err("refused").to_string();
        assert!(refused.contains(&format!("{other} features for a network")), "{refused}");
        let (mut scorer, mut expected) = (GruScorer::new(model), vec![]);
        for (tracks, pairs) in [(1, 1), (16, 40), (100, 400)] {
            let request = request(features, tracks, pairs, &mut rng);
            scorer.score(&request, &mut expected);
            let found = linker.score_blocking(request).expect("probabilities");
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(&expected) {
                assert!((found - expected).abs() <= 1e-5, "{features}, hidden {hidden}: {found}, {expected}");
            }
        }
        linker.shutdown();
    }
}

#[test]
fn a_file_whose_features_do_not_fit_its_graph_is_refused() {
    let Some(folder) = models() else { return };
    let mut rng = fastrand::Rng::with_seed(23);
    let model = model(4, &examples(Features::Literal { embedding: 9 }, 30, &mut rng), &mut rng);
    let file = onnx::write(&model, "a test", &BTreeMap::new());
    for (text, reason) in [("literal 8", "15 wide"), ("literal x", "names no features")] {
        let at = file.windows(9).position(|w| w == b"literal 9").expect("the metadata");
        let mut broken = file.clone();
        broken[at..at + 9].copy_from_slice(text.as_bytes());
        let written = tempfile::tempdir().expect("a folder");
        let settings = write_bytes(written.path(), &folder, &broken);
        let error = Linker::load(&settings, Arc::new(())).err().expect("refused").to_string();
        assert!(error.contains(reason), "{error}");
    }
}
