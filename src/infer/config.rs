//! `[models]` of the configuration file and of the command line.

use std::path::PathBuf;

use serde::Deserialize;

use super::{InferError, ModelSettings};
use crate::detect::DetectorSettings;

/// `[models]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Manifest file or its folder.
    pub manifest: Option<PathBuf>,
    /// Detector: `auto`, a name in the manifest, or the user's own (`own.toml#name`).
    pub detector: Option<String>,
    /// Largest detector input, `[width, height]`.
    pub detector_size: Option<(usize, usize)>,
    /// Least score of a detection.
    pub score_threshold: Option<f64>,
    /// Classes to track, by the manifest's names.
    pub classes: Option<Vec<String>>,
    /// ReID: `builtin`, `none`, a name, or the user's own.
    pub reid: Option<String>,
    /// Link scorer: a name, or the user's own.
    pub link: Option<String>,
    /// `auto`, `cpu`, `cuda`, `tensorrt`.
    pub provider: Option<String>,
    /// CPU cores for models.
    pub threads: Option<usize>,
    /// ONNX Runtime's library.
    pub onnxruntime: Option<PathBuf>,
}

impl ModelConfig {
    /// What `self` says, and `other` where `self` says nothing.
    pub fn or(self, other: ModelConfig) -> ModelConfig {
        ModelConfig {
            manifest: self.manifest.or(other.manifest),
            detector: self.detector.or(other.detector),
            detector_size: self.detector_size.or(other.detector_size),
            score_threshold: self.score_threshold.or(other.score_threshold),
            classes: self.classes.or(other.classes),
            reid: self.reid.or(other.reid),
            link: self.link.or(other.link),
            provider: self.provider.or(other.provider),
            threads: self.threads.or(other.threads),
            onnxruntime: self.onnxruntime.or(other.onnxruntime),
        }
    }

    /// As settings for [`super::Models::load`].
    ///
    /// # Errors
    /// A provider that does not exist, or no core at all.
    pub fn settings(self) -> Result<ModelSettings, InferError> {
        let default = ModelSettings::default();
        if self.threads == Some(0) {
            let reason = "0 is none; give at least 1, or leave it out".into();
            return Err(InferError::Setting { setting: "models.threads", reason });
        }
        Ok(ModelSettings {
            manifest: self.manifest.unwrap_or_else(default_manifest),
            detector: self.detector.unwrap_or(default.detector),
            detection: DetectorSettings {
                size: self.detector_size,
                score_threshold: self.score_threshold,
                classes: self.classes.unwrap_or_default(),
            },
            reid: self.reid.unwrap_or(default.reid),
            link: self.link.unwrap_or(default.link),
            provider: match self.provider {
                Some(name) => name.parse()?,
                None => default.provider,
            },
            threads: self.threads,
            onnxruntime: self.onnxruntime,
        })
    }
}

/// `models/` here, beside the program (or its build folder), or where a package puts it.
fn default_manifest() -> PathBuf {
    let beside = std::env::current_exe().ok();
    let beside = beside.iter().flat_map(|exe| exe.ancestors().skip(1).take(3)).map(|dir| dir.join("models"));
    [PathBuf::from("models")]
        .into_iter()
        .chain(beside)
        .chain([PathBuf::from("/usr/share/gakp/models")])
        .find(|dir| dir.join("manifest.toml").is_file())
        .unwrap_or_else(|| "models".into())
}
