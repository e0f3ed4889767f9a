//! Wrong manifests, files and settings are told in one clear message each.
#![cfg(feature = "infer")]

mod infer_support;

use std::fs;
use std::path::Path;
use std::sync::Arc;

use gakp::infer::{InferError, Manifest, ModelSettings, Models, ProviderChoice, Task};
use infer_support::{fixture, models, sha256};

const DETECTOR: &str = r#"
[[model]]
name = "cells"
task = "detect"
family = "yolox"
file = "yolox.onnx"
sha256 = "HASH"
license = "MIT"
[model.input]
name = "images"
shape = ["batch", 3, "height", "width"]
width = 64
height = 32
multiple = 8
colour = "rgb"
mean = [0, 0, 0]
std = [1, 1, 1]
resize = "stretch"
[model.output]
name = "output"
shape = ["batch", "anchors", 6]
classes = ["person"]
strides = [8]
score_threshold = 0.45
nms_iou = 0.6
"#;

/// A folder with the small detector and its manifest, changed by `edit`.
fn folder(edit: impl Fn(String) -> String) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    fs::copy(fixture("yolox.onnx"), folder.path().join("yolox.onnx")).expect("a copy");
    let text = edit(DETECTOR.replace("HASH", &sha256(&fixture("yolox.onnx"))));
    fs::write(folder.path().join("manifest.toml"), text).expect("a manifest");
    folder
}

fn read(folder: &Path) -> Result<Manifest, InferError> {
    Manifest::read(&folder.join("manifest.toml"))
}

#[test]
fn a_good_manifest_is_read() {
    let folder = folder(|text| text);
    let manifest = read(folder.path()).expect("a manifest");
    let model = manifest.find(Task::Detect, "cells").expect("the model");
    assert_eq!(manifest.verify(model).expect("the right hash"), folder.path().join("yolox.onnx"));
    let input = model.input.as_ref().expect("an input");
    assert_eq!((input.width, input.height, input.pad), (64, 32, 0.0));
}

#[test]
fn mistakes_in_a_manifest() {
    for (from, to, message) in [
        ("name = \"cells\"", "name = \"\"", "its name is empty"),
        ("license = \"MIT\"", "licence = \"MIT\"", "unknown field `licence`"),
        ("license = \"MIT\"", "", "missing field `license`"),
        ("width = 64", "widht = 64", "unknown field `widht`"),
        ("family = \"yolox\"", "family = \"detr\"", "unknown variant `detr`"),
        ("family = \"yolox\"", "family = \"gru\"", "its family does not fit its task"),
        ("sha256 = \"", "sha256 = \"00", "sha256 must be 64 hexadecimal digits"),
        ("width = 64", "width = 60", "input.width 60 must be 1 to 8192 and a multiple of input.multiple 8"),
        ("multiple = 8", "multiple = 0", "input.multiple must be at least 1"),
        ("[\"batch\", 3, \"height\", \"width\"]", "[\"batch\", 3, 64, 64]", "input.height 32 differs"),
        ("[\"batch\", 3, \"height\", \"width\"]", "[\"batch\", 1, 32, 64]", "must be 3 (the colours)"),
        ("[\"batch\", 3, \"height\", \"width\"]", "[3, 32, 64]", "must have 4 axes"),
        ("std = [1, 1, 1]", "std = [1, 0, 1]", "input.std positive"),
        ("resize = \"stretch\"", "resize = \"crop\"", "unknown variant `crop`"),
        ("classes = [\"person\"]", "", "output.classes is missing"),
        ("classes = [\"person\"]", "classes = [\"person\", \"car\"]", "must be 7: 2 classes and 5"),
        ("strides = [8]", "strides = [0]", "output.strides is missing"),
        ("score_threshold = 0.45", "score_threshold = 45", "output.score_threshold must be given"),
        ("nms_iou = 0.6", "", "output.nms_iou must be given"),
        ("[[model]]", "[[model]", "is not a manifest"),
    ] {
        assert!(DETECTOR.contains(from), "{from}");
        let folder = folder(|text| text.replacen(from, to, 1));
        let error = read(folder.path()).expect_err(message).to_string();
        assert!(error.contains(message), "{message:?} is not in {error:?}");
        assert!(error.contains("manifest.toml"), "{error}");
    }
    let twice = folder(|text| text.repeat(2));
    assert!(read(twice.path()).expect_err("twice").to_string().contains("two models are named \"cells\""));
    let nowhere = tempfile::tempdir().expect("a folder");
    assert!(read(nowhere.path()).expect_err("no file").to_string().contains("cannot be read"));
}

#[test]
fn files_are_what_the_manifest_says() {
    let folder = folder(|text| text);
    let manifest = read(folder.path()).expect("a manifest");
    let model = manifest.find(Task::Detect, "cells").expect("the model");
    let file = folder.path().join("yolox.onnx");

    let mut bytes = fs::read(&file).expect("the file");
    bytes[10] ^= 1;
    fs::write(&file, bytes).expect("a changed file");
    let error = manifest.verify(model).expect_err("another file");
    let message = error.to_string();
    for part in [sha256(&file).as_str(), &model.sha256, "bash deploy/setup.sh models", "\"cells\""] {
        assert!(message.contains(part), "{part} is not in {message}");
    }
    assert!(matches!(error, InferError::WrongHash { .. }));

    fs::remove_file(&file).expect("no file");
    let error = manifest.verify(model).expect_err("no file");
    assert!(matches!(error, InferError::Missing { .. }));
    assert!(error.to_string().contains("bash deploy/setup.sh models"), "{error}");

    let error = manifest.find(Task::Detect, "cell").expect_err("no such name").to_string();
    assert!(error.contains("no detect model named \"cell\"; it has: cells"), "{error}");
    let error = manifest.find(Task::Link, "cells").expect_err("another task").to_string();
    assert!(error.contains("it has: none"), "{error}");
}

/// Settings for a folder of [`folder`].
fn settings(folder: &Path, models: &Path) -> ModelSettings {
    ModelSettings {
        onnxruntime: Some(models.join("cache/libonnxruntime.so")),
        detector: "cells".into(),
        ..infer_support::settings(folder)
    }
}

#[test]
fn graphs_are_what_the_manifest_says() {
    let Some(models) = models() else { return };
    for (from, to, message) in [
        ("name = \"images\"", "name = \"pictures\"", "names the input \"pictures\", the file has images"),
        ("name = \"output\"", "name = \"boxes\"", "names the output \"boxes\", the file has output"),
        (
            "[\"batch\", \"anchors\", 6]",
            "[\"batch\", \"anchors\", 7]",
            "the shape [any, any, 7], the file has [any, any, 6]",
        ),
        ("strides = [8]", "strides = [16]", "8 points of 6 values are expected"),
    ] {
        let folder = folder(|text| {
            let text = text.replacen(from, to, 1);
            if to.contains('7') { text.replace("[\"person\"]", "[\"person\", \"car\"]") } else { text }
        });
        let error = Models::load(&settings(folder.path(), &models), Arc::new(())).err().expect(message);
        assert!(error.to_string().contains(message), "{message:?} is not in {error}");
    }
    // A file whose hash is right and that is no model.
    let folder = folder(|text| text.replace(&sha256(&fixture("yolox.onnx")), &"0".repeat(64)));
    fs::write(folder.path().join("yolox.onnx"), "no graph").expect("a file");
    let text = fs::read_to_string(folder.path().join("manifest.toml")).expect("the manifest");
    let hash = sha256(&folder.path().join("yolox.onnx"));
    fs::write(folder.path().join("manifest.toml"), text.replace(&"0".repeat(64), &hash)).expect("a manifest");
    let error = Models::load(&settings(folder.path(), &models), Arc::new(())).err().expect("no model");
    assert!(error.to_string().contains("ONNX Runtime refuses"), "{error}");
}

#[test]
fn settings_that_a_model_cannot_follow() {
    let Some(models) = models() else { return };
    let folder = folder(|text| text);
    type Edit = fn(&mut ModelSettings);
    let cases: [(Edit, &str); 7] = [
        (|s| s.detection.size = Some((60, 32)), "60x32: both must be multiples of 8"),
        (|s| s.detection.score_threshold = Some(1.5), "1.5 is not between 0 and 1"),
        (|s| s.detection.classes = vec!["cat".into()], "has no class \"cat\"; it has: person"),
        (|s| s.detector = "other".into(), "no detect model named \"other\"; it has: cells"),
        (|s| s.reid = "other".into(), "no reid model named \"other\""),
        (|s| s.link = "other".into(), "no link model named \"other\""),
        (
            |s| s.provider = ProviderChoice::Cuda,
            "execution provider cuda was asked for and does not work here",
        ),
    ];
    for (edit, message) in cases {
        let mut settings = settings(folder.path(), &models);
        edit(&mut settings);
        match Models::load(&settings, Arc::new(())) {
            Err(error) => assert!(error.to_string().contains(message), "{message:?} is not in {error}"),
            // A machine with a GPU may well have CUDA.
            Ok(models) => assert_eq!(models.report.provider, "cuda"),
        }
    }
}

#[test]
fn a_model_of_the_users_own() {
    let Some(models) = models() else { return };
    let own = folder(|text| text);
    let path = |name: &str| own.path().join(name).display().to_string();
    fs::rename(own.path().join("manifest.toml"), own.path().join("yolox.toml")).expect("a rename");
    let elsewhere = folder(|text| text.replace("cells", "another"));
    for detector in [path("yolox.toml"), path("yolox.toml") + "#cells", path("yolox.onnx"), "auto".into()] {
        let settings = ModelSettings { detector: detector.clone(), ..settings(elsewhere.path(), &models) };
        let models = Models::load(&settings, Arc::new(())).expect(&detector);
        let expected = if detector == "auto" { "another" } else { "cells" };
        assert_eq!(models.report.models[0].1, expected);
    }
    let error = Models::load(
        &ModelSettings { detector: path("yolox.toml") + "#x", ..settings(elsewhere.path(), &models) },
        Arc::new(()),
    );
    assert!(error.err().expect("no such name").to_string().contains("no detect model named \"x\""));
}
