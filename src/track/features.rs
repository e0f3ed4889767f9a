//! What the link scorer sees of a pair.
//!
//! Everything is relative to the track's last box `L` (units of its height, logarithms of size
//! ratios, seconds), so that the network is invariant to position, resolution and frame rate.
//!
//! A step (an observation, or the candidate), [`STEP_FEATURES`] values:
//!
//! | index | value |
//! | --- | --- |
//! | 0, 1 | `(cx - cxL) / hL`, `(cy - cyL) / hL` |
//! | 2, 3 | `ln w/wL`, `ln h/hL` |
//! | 4, 5 | displacement from the observation before it, `1/hL` per second |
//! | 6 | seconds since the observation before it |
//! | 7 | seconds before the last observation (0 for the last and for the candidate) |
//! | 8..12 | innovation against the box predicted for it: `dx/hP, dy/hP, ln w/wP, ln h/hP` |
//! | 12 | 1 for the candidate, 0 for an observation |
//! | 13 | detection score |
//!
//! A candidate adds: 14 IoU with the predicted box, 15 Mahalanobis distance / 5, 16 `ln(std_x / h)`
//! of the prediction, 17 `min(hits, 20) / 20`, 18 seconds since the last observation, 19 IoU with
//! the last box.

use super::gate::PairGeometry;
use super::link::{CANDIDATE_FEATURES, HISTORY, STEP_FEATURES};
use super::tracklet::{Observation, Tracklet, innovation};
use crate::types::{BBox, Detection, MediaTime};

/// Index of the seconds since the observation before.
pub const DT: usize = 6;
/// Index of the first of four innovations.
pub const INNOVATION: usize = 8;
/// Index of a candidate's IoU with the predicted box.
pub const IOU: usize = STEP_FEATURES;
/// Index of a candidate's Mahalanobis distance.
pub const MAHALANOBIS: usize = STEP_FEATURES + 1;
/// What the Mahalanobis distance is given in units of.
pub const MAHALANOBIS_UNIT: f64 = 5.0;

/// Velocities are clamped to this, heights per second: two boxes a millisecond apart say nothing.
const MAX_VELOCITY: f64 = 20.0;

struct Step<'a> {
    bbox: &'a BBox,
    time: MediaTime,
    score: f64,
    innovation: [f64; 4],
    candidate: bool,
}

fn step(step: &Step<'_>, previous: Option<&Observation>, last: &Observation) -> [f32; STEP_FEATURES] {
    let (reference, h) = (&last.bbox, last.bbox.h.max(1.0));
    let (mut vx, mut vy, mut dt) = (0.0, 0.0, 0.0);
    if let Some(previous) = previous {
        dt = step.time.since(previous.time);
        if dt > 0.0 {
            vx = ((step.bbox.cx() - previous.bbox.cx()) / h / dt).clamp(-MAX_VELOCITY, MAX_VELOCITY);
            vy = ((step.bbox.cy() - previous.bbox.cy()) / h / dt).clamp(-MAX_VELOCITY, MAX_VELOCITY);
        }
    }
    let age = if step.candidate { 0.0 } else { last.time.since(step.time) };
    [
        (step.bbox.cx() - reference.cx()) / h,
        (step.bbox.cy() - reference.cy()) / h,
        (step.bbox.w.max(1.0) / reference.w.max(1.0)).ln(),
        (step.bbox.h.max(1.0) / h).ln(),
        vx,
        vy,
        dt,
        age,
        step.innovation[0],
        step.innovation[1],
        step.innovation[2],
        step.innovation[3],
        f64::from(u8::from(step.candidate)),
        step.score,
    ]
    .map(|v| v as f32)
}

/// Appends a track's history, `[HISTORY, STEP_FEATURES]` padded with zeros, to `out`; returns how
/// many observations are valid.
pub fn push_history(track: &Tracklet, out: &mut Vec<f32>) -> usize {
    let last = track.last();
    let mut previous = None;
    for seen in &track.history {
        let Observation { bbox, time, score, innovation } = seen;
        let this = Step { bbox, time: *time, score: *score, innovation: *innovation, candidate: false };
        out.extend(step(&this, previous, last));
        previous = Some(seen);
    }
    let valid = track.history.len();
    out.resize(out.len() + (HISTORY - valid) * STEP_FEATURES, 0.0);
    valid
}

/// The features of a gated pair. `predicted` is the track's box at the detection's time.
pub fn candidate(
    track: &Tracklet,
    predicted: &BBox,
    detection: &Detection,
    geometry: &PairGeometry,
) -> [f32; CANDIDATE_FEATURES] {
    let last = track.last();
    let this = Step {
        bbox: &detection.bbox,
        time: track.time,
        score: detection.score,
        innovation: innovation(predicted, &detection.bbox),
        candidate: true,
    };
    let mut features = [0.0; CANDIDATE_FEATURES];
    features[..STEP_FEATURES].copy_from_slice(&step(&this, Some(last), last));
    let std_x = track.filter.variances()[0].sqrt();
    features[STEP_FEATURES..].copy_from_slice(
        &[
            geometry.iou,
            geometry.mahalanobis2.sqrt() / MAHALANOBIS_UNIT,
            (std_x / predicted.h).ln(),
            f64::from(track.hits.min(20)) / 20.0,
            track.missed_for(),
            last.bbox.iou(&detection.bbox),
        ]
        .map(|v| v as f32),
    );
    features
}
