//! Implicit features: the GRU's link probability (Eq. GRU), the default.

use super::Affinity;
use super::iou_motion::overlap;
use crate::track::pair::PairView;
use crate::track::{PairScore, TrackerConfig};

/// The link probability as [`PairScore`] says, if it is not below the track's bound.
pub(super) fn affinity(config: &TrackerConfig, pair: &PairView<'_>, probability: f32) -> Option<Affinity> {
    let link = with_appearance(config, pair, probability);
    let config = &config.association;
    let min_link = config.min_link_of(pair.track);
    if link <= min_link {
        return None;
    }
    let gain = match config.score {
        PairScore::LogLink => link.ln() - min_link.max(1e-6).ln(),
        PairScore::Blend { iou_weight } => {
            iou_weight * overlap(pair) + (1.0 - iou_weight) * link - config.least(pair.track.confirmed)
        }
    };
    (gain > 0.0).then_some(Affinity { gain, link })
}

/// The scorer's probability (one that is not finite counts as 0), moved by appearance where both sides
/// have one and the scorer has not seen it: `logit P' = logit P + weight (cosine - pivot)`.
pub(super) fn with_appearance(config: &TrackerConfig, pair: &PairView<'_>, probability: f32) -> f64 {
    let p = if probability.is_finite() { f64::from(probability).clamp(0.0, 1.0) } else { 0.0 };
    let seen = config.association.method.asks_scorer() && config.association.features.see_appearance();
    let config = &config.appearance;
    if seen || config.weight == 0.0 {
        return p;
    }
    let Some(cosine) = pair.cosine() else { return p };
    let p = p.clamp(1e-6, 1.0 - 1e-6);
    let logit = (p / (1.0 - p)).ln() + config.weight * (cosine - config.pivot);
    1.0 / (1.0 + (-logit).exp())
}
