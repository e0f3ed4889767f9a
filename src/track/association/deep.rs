//! IOU + motion + deep: three hand-made similarities and fixed weights, after Yu et al., "POI: Multiple
//! Object Tracking with High Performance Detection and Appearance Feature", ECCV workshops 2016.
//!
//! `s = sum w_k s_k / sum w_k` over overlap with the predicted box, motion `1 - D / gate` and appearance
//! ([`PairView::likeness`]). Where a side has no embedding, the other two remain.

use super::Affinity;
use crate::track::pair::PairView;

/// Weight of the overlap.
const OVERLAP: f64 = 0.35;
/// Weight of the motion.
const MOTION: f64 = 0.15;
/// Weight of the appearance.
const APPEARANCE: f64 = 0.5;
/// Least similarity.
const LEAST: f64 = 0.4;

/// The weighted similarity.
pub(super) fn affinity(gate: f64, pair: &PairView<'_>) -> Option<Affinity> {
    let motion = (1.0 - pair.geometry.mahalanobis2 / gate).max(0.0);
    let boxes = OVERLAP * pair.geometry.iou + MOTION * motion;
    let similarity = match pair.likeness() {
        Some(likeness) => boxes + APPEARANCE * likeness,
        None => boxes / (OVERLAP + MOTION),
    };
    Affinity::beyond(similarity, LEAST)
}
