//! ONNX Runtime: the manifest of models, sessions on an execution provider, the batcher that all
//! cameras share, the link scorer. [`Models::load`] makes all of it.

mod batcher;
pub mod bench;
mod config;
mod error;
mod graph;
mod linker;
mod manifest;
mod models;
mod picture;
pub mod rates;
mod runtime;
mod scale;
#[cfg(test)]
pub(crate) mod testing;

pub use batcher::{Arrangement, BatchModel, BatchStats, Batcher, Observer};
pub use config::ModelConfig;
pub use error::InferError;
pub use linker::Linker;
pub use manifest::{
    Calibration, ColourOrder, Dim, Family, Fit, InputSpec, Manifest, ModelEntry, OutputSpec, Task,
};
pub use models::{ModelSettings, Models, Report};
pub use runtime::{Provider, ProviderChoice, Runtime};

pub(crate) use graph::PictureGraph;
pub(crate) use picture::{Normalisation, Placement, Rasteriser, yuv_to_rgb};
