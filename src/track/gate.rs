//! Which pairs of track and detection are worth a link probability.

use super::GateConfig;
use super::kalman::BoxFilter;
use crate::types::BBox;

/// What the gate measured of a pair; the features use it again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairGeometry {
    /// Squared Mahalanobis distance (Eq. Mahalanobis).
    pub mahalanobis2: f64,
    /// IoU of the detection with the predicted box.
    pub iou: f64,
}

/// Measures a pair: `filter` is predicted to the detection's time, `predicted` is its box, `r` the
/// diagonal of the measurement noise. `None` when the gate is closed.
pub fn gate(
    config: &GateConfig,
    filter: &BoxFilter,
    predicted: &BBox,
    r: [f64; 4],
    detection: &BBox,
) -> Option<PairGeometry> {
    let z = [detection.cx(), detection.cy(), detection.w, detection.h];
    let mahalanobis2 = filter.mahalanobis2(z, if config.innovation { r } else { [0.0; 4] });
    let near = mahalanobis2 < config.mahalanobis;
    if !near && config.or_iou.is_none() && config.or_distance.is_none() {
        return None;
    }
    let iou = predicted.iou(detection);
    let distance = || (z[0] - predicted.cx()).hypot(z[1] - predicted.cy()) / predicted.h.max(1.0);
    let open = near
        || config.or_iou.is_some_and(|bound| iou > bound)
        || config.or_distance.is_some_and(|bound| distance() < bound);
    open.then_some(PairGeometry { mahalanobis2, iou })
}
