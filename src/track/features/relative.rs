//! Features relative to the track.
//!
//! Everything is relative to the track's last box `L` (units of its height, logarithms of size
//! ratios, seconds), so that the network is invariant to position, resolution and frame rate.
//!
//! A step (an observation, or the candidate), [`STEP`] values:
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

use crate::track::pair::PairView;
use crate::track::tracklet::{Observation, Tracklet, innovation};
use crate::types::{BBox, MediaTime};

/// Values of a step.
pub const STEP: usize = 14;
/// Values of a candidate: those of a step, then those that only a pair has.
pub const CANDIDATE: usize = STEP + 6;
/// Index of the seconds since the observation before.
pub const DT: usize = 6;
/// Index of the first of four innovations.
pub const INNOVATION: usize = 8;
/// Index of a candidate's IoU with the predicted box.
pub const IOU: usize = STEP;
/// Index of a candidate's Mahalanobis distance.
pub const MAHALANOBIS: usize = STEP + 1;
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

fn step(step: &Step<'_>, previous: Option<&Observation>, last: &Observation) -> [f32; STEP] {
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

/// Appends a track's observations to `out`.
pub(super) fn push_history(track: &Tracklet, out: &mut Vec<f32>) {
    let last = track.last();
    let mut previous = None;
    for seen in &track.history {
        let Observation { bbox, time, score, innovation, .. } = seen;
        let this = Step { bbox, time: *time, score: *score, innovation: *innovation, candidate: false };
        out.extend(step(&this, previous, last));
        previous = Some(seen);
    }
}

/// The features of a gated pair.
pub fn candidate(pair: &PairView<'_>) -> [f32; CANDIDATE] {
    let PairView { track, predicted, detection, geometry, .. } = *pair;
    let last = track.last();
    let this = Step {
        bbox: &detection.bbox,
        time: track.time,
        score: detection.score,
        innovation: innovation(predicted, &detection.bbox),
        candidate: true,
    };
    let mut features = [0.0; CANDIDATE];
    features[..STEP].copy_from_slice(&step(&this, Some(last), last));
    let std_x = track.filter.variances()[0].sqrt();
    features[STEP..].copy_from_slice(
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
