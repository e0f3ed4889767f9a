//! GAKP: GRU association and Kalman prediction for multiple object tracking, as a service.
//!
//! ```text
//! camera -> frames -> detections -> embeddings -> link scores -> tracks -> subscribers
//!   ingest     types     detect        embed          infer        track     publish, api
//! ```
//!
//! [`types`], [`track`], [`analytics`] and [`mot`] are pure: they know no clock, thread, file or model, and
//! `cargo test --no-default-features` builds and tests them alone.

// F, Q, H, R, P, S and K are the field's names.
#![allow(non_snake_case)]

pub mod types;

#[cfg(feature = "service")]
pub mod egomotion;
#[cfg(feature = "ingest")]
pub mod ingest;

#[cfg(feature = "infer")]
pub mod detect;
#[cfg(feature = "infer")]
pub mod embed;
#[cfg(feature = "infer")]
pub mod infer;

pub mod track;

pub mod analytics;

#[cfg(feature = "service")]
pub mod config;
#[cfg(feature = "service")]
pub mod pipeline;
#[cfg(feature = "service")]
mod private;
#[cfg(feature = "service")]
pub mod telemetry;
#[cfg(any(feature = "cli", feature = "infer", feature = "service"))]
pub mod tuning;

#[cfg(feature = "service")]
pub mod api;
#[cfg(feature = "service")]
pub mod auth;
#[cfg(feature = "service")]
pub mod history;
#[cfg(feature = "service")]
pub mod notify;
#[cfg(feature = "service")]
pub mod outgoing;
#[cfg(feature = "service")]
pub mod publish;
#[cfg(feature = "service")]
pub mod traces;

pub mod mot;

#[cfg(any(feature = "cli", feature = "learn"))]
pub mod chart;
#[cfg(feature = "learn")]
pub mod learn;
#[cfg(feature = "cli")]
pub mod simulate;

#[cfg(feature = "cli")]
pub mod cli;
