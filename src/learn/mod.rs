//! Training the link network: examples, a GRU with hand-written gradients, Adam, ONNX out.
//!
//! ```text
//! sequences -> tracker driven by the truth -> examples -> fit -> LinkModel -> ONNX, model card
//! ```
//!
//! Not part of the service: the service runs the ONNX file. [`GruScorer`] computes the same without
//! ONNX Runtime, [`literal`] computes it the way the paper prints it, one pair at a time.

mod activate;
mod adam;
pub mod card;
pub mod dataset;
mod descent;
mod examples;
mod existence;
pub mod explicit;
mod fit;
mod gemm;
mod gru;
pub mod literal;
mod looks;
pub mod metrics;
mod model;
pub mod network;
pub mod onnx;
mod recipe;
mod scorer;
mod teacher;
pub mod tune;

pub use adam::{Adam, Schedule};
pub use examples::{Examples, Split};
pub use existence::{Boxes, HeadFit, fit_head};
pub use explicit::{ExplicitModel, ExplicitScorer, ExplicitShape, fit_explicit, logits_explicit};
pub use fit::{Checkpoint, Epoch, Fit, Progress, fit, logits};
pub use gru::{Batch, Gru, GruShape, Tape};
pub use looks::Looks;
pub use model::{LinkModel, Normaliser};
pub use recipe::Recipe;
pub use scorer::GruScorer;
pub use teacher::Teacher;
