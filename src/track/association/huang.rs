//! Huang's link probability `P_link = A_pos A_size A_appr` (Eq. P_link of the paper).
//!
//! Huang, Wu, Nevatia, "Robust Object Tracking by Hierarchical Association of Detection Responses",
//! ECCV 2008: Gaussians of the difference in position and size, and the similarity of appearance
//! (colour histograms there, embeddings here; 1 where a side has none). The position is taken from the
//! prediction, and differences are in heights, so that one width serves near and far people.

use super::Affinity;
use crate::track::pair::PairView;
use crate::track::tracklet::innovation;

/// Width of `A_pos`, h.
const SIGMA_POSITION: f64 = 0.5;
/// Width of `A_size`, logarithm of a ratio.
const SIGMA_SIZE: f64 = 0.4;
/// Least link probability.
const LEAST: f64 = 0.1;

/// The cost is `-ln P_link`, worth what it is less than that of the least probability.
pub(super) fn affinity(pair: &PairView<'_>) -> Option<Affinity> {
    let [dx, dy, dw, dh] = innovation(pair.predicted, &pair.detection.bbox);
    let gaussian = |a: f64, b: f64, sigma: f64| (-(a * a + b * b) / (sigma * sigma)).exp();
    let position = gaussian(dx, dy, SIGMA_POSITION);
    let size = gaussian(dw, dh, SIGMA_SIZE);
    let appearance = pair.likeness().unwrap_or(1.0);
    let link = position * size * appearance;
    (link > LEAST).then(|| Affinity { gain: (link / LEAST).ln(), link })
}
