//! IOU: the overlap with the track's last box and nothing else.
//!
//! Bochinski, Eiselein, Sikora, "High-Speed Tracking-by-Detection Without Using Image Information",
//! AVSS 2017. The paper matches greedily; here the assignment is the same as everywhere else.

use super::Affinity;
use crate::track::gate::PairGeometry;
use crate::track::pair::PairView;
use crate::track::tracklet::Tracklet;
use crate::types::BBox;

/// Least overlap, `sigma_IOU` of the paper.
pub const MIN_IOU: f64 = 0.5;

/// Pairs that overlap at all. No prediction, so no Mahalanobis distance: it is given as 0, and the IoU
/// is that with the last box.
pub(super) fn gate(track: &Tracklet, detection: &BBox) -> Option<PairGeometry> {
    let iou = track.last().bbox.iou(detection);
    (iou > 0.0).then_some(PairGeometry { mahalanobis2: 0.0, iou })
}

/// Overlap with the last box.
pub(super) fn affinity(pair: &PairView<'_>) -> Option<Affinity> {
    Affinity::beyond(pair.geometry.iou, MIN_IOU)
}
