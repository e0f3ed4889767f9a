//! What unit tests of models share.

use std::path::{Path, PathBuf};

use super::{ProviderChoice, Runtime};

/// ONNX Runtime from the models' folder on the CPU; says so where it is missing.
pub(crate) fn runtime() -> Option<Runtime> {
    let folder = std::env::var_os("GAKP_MODELS")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("models"), PathBuf::from);
    let library = folder.join("cache/libonnxruntime.so");
    if !library.exists() {
        eprintln!("SKIPPED: no {}: run `bash deploy/setup.sh models`", library.display());
        return None;
    }
    Some(Runtime::load(ProviderChoice::Cpu, Some(&library), &folder).expect("ONNX Runtime"))
}

/// A small graph of this repository.
pub(crate) fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/infer").join(name)
}
