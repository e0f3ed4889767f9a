//! IOU + motion: the overlap with the box that the Kalman filter predicts, within the Mahalanobis gate.
//!
//! Also the row "IoU cost" of the ablation: the default tracker with the GRU taken out of
//! [`super::super::PairScore::Blend`].

use super::Affinity;
use crate::track::AssociationConfig;
use crate::track::pair::PairView;

/// Overlap with the predicted box, a doubtful detection counting less, beyond the least score of the
/// track's stage of life.
pub(super) fn affinity(config: &AssociationConfig, pair: &PairView<'_>) -> Option<Affinity> {
    Affinity::beyond(overlap(pair), config.least(pair.track.confirmed))
}

/// `IoU (0.7 + 0.3 score)`.
pub(super) fn overlap(pair: &PairView<'_>) -> f64 {
    pair.geometry.iou * (0.7 + 0.3 * pair.detection.score)
}
