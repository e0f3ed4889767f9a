//! Detections and link scores to tracks: the sans-I/O core.
//!
//! ```text
//! predict(frame) -> the gated pairs that need a link probability   (LinkRequest)
//! update(scores) -> the tracks of that frame                       (TrackReport)
//! ```
//!
//! Whoever drives a [`Tracker`] fetches the scores: the service batches the pairs of all cameras
//! into one call, `gakp track` does the same offline, a test hands in numbers. The core knows no
//! clock, thread, file, random source or model; time is an argument.
//!
//! One concept a file, in the order of a frame: [`motion`] and [`kalman`] predict, [`shift`]
//! follows the camera, [`gate`] picks the pairs, [`features`] describes them, [`association`]
//! and [`assign`] match them, [`tracklet`] lives and dies, [`record`] remembers how the detector does,
//! [`existence`] says what is shown.

pub mod assign;
pub mod association;
mod config;
pub mod existence;
pub mod features;
pub mod gate;
pub mod kalman;
mod link;
pub mod motion;
pub mod nearby;
pub mod pair;
pub mod record;
pub mod shift;
mod tracker;
pub mod tracklet;

pub use association::{Association, Match, match_pairs};
pub use config::{
    AppearanceConfig, AssociationConfig, BirthConfig, ExistenceConfig, FilterConfig, GateConfig, LifeConfig,
    NoiseAdaptation, PairScore, ShiftConfig, TrackerConfig,
};
pub use existence::{Dense, EXISTENCE_FEATURES, ExistenceHead, HeadError};
pub use features::Features;
pub use link::{HISTORY, LinkRequest, Pair};
pub use tracker::{Decision, FrameInput, GatedPair, TrackError, Tracker, Update};
