//! The squared Mahalanobis distance as the cost (Eq. Mahalanobis), for comparison: it is a gate.

use super::Affinity;
use crate::track::pair::PairView;

/// Worth `1 - D / gate`; `C = exp(-D / 2)`, the likelihood over its peak.
pub(super) fn affinity(gate: f64, pair: &PairView<'_>) -> Option<Affinity> {
    let d2 = pair.geometry.mahalanobis2;
    (d2 < gate).then(|| Affinity { gain: 1.0 - d2 / gate, link: (-0.5 * d2).exp() })
}
