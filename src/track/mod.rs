//! Detections and link scores to tracks: the sans-I/O core.

pub mod assign;
mod link;

pub use link::{CANDIDATE_FEATURES, HISTORY, LinkRequest, Pair, STEP_FEATURES};
