//! Explicit features (Eq. cost_function): the weighted sum of squared differences
//!
//! ```text
//! C_ij = lambda_D D^2 + lambda_I (1 - IoU)^2 + lambda_v |dv|^2 + lambda_a |da|^2 + lambda_f |df|^2
//! ```
//!
//! and `P = sigmoid(b - C_ij)`. The weights come from a recurrent network that reads the track's history
//! (`gakp train --association explicit`; it answers as the link scorer does), or are fixed.
//!
//! `dv` is the innovation over the time since the track was seen: the velocity that the detection implies
//! less the Kalman filter's. The filter's own acceleration is zero, so `da = dv / dt`. For embeddings of
//! unit length `|df|^2 = 2 - 2 cos`. A network of [`crate::track::Features::Appearance`] predicts `lambda_f`
//! too. For one of boxes alone it is half of [`crate::track::AppearanceConfig::weight`], and the network's
//! probability is moved by it as the implicit one's is.

use super::Affinity;
use super::implicit::with_appearance;
use crate::track::TrackerConfig;
use crate::track::features::{appearance, relative};
use crate::track::pair::PairView;

/// Explicit features: `D`, `IoU`, `dv`, `da`, `df`.
pub const COSTS: usize = 5;
/// Those that boxes give; `df` comes last.
pub const BOX_COSTS: usize = 4;

/// Squared features are cut here: beyond, a pair is hopeless and the numbers only grow.
pub const COST_LIMITS: [f32; COSTS] = [40.0, 1.0, 400.0, 40_000.0, 4.0];

/// Times below this count as this, s: two boxes a millisecond apart say nothing of velocity.
pub const LEAST_DT: f32 = 0.01;

/// Fixed weights: about the mean of what the networks predict.
const FIXED: [f32; BOX_COSTS] = [0.25, 6.0, 0.03, 1e-4];
/// The bias `b` that goes with them.
const FIXED_BIAS: f32 = 2.4;

/// The squared features of a candidate row ([`relative`] and [`appearance`] say what stands where):
/// `[D^2, (1 - IoU)^2, |dv|^2, |da|^2, |df|^2]`, velocity and acceleration in heights per second
/// (squared). `df` is 0 where there is nothing to compare.
///
/// # Panics
/// When the row is shorter than a candidate's.
pub fn costs(candidate: &[f32]) -> [f32; COSTS] {
    let dt = candidate[relative::DT].max(LEAST_DT);
    let distance = candidate[relative::MAHALANOBIS] * relative::MAHALANOBIS_UNIT as f32;
    let apart = 1.0 - candidate[relative::IOU];
    let [dx, dy] = [candidate[relative::INNOVATION], candidate[relative::INNOVATION + 1]];
    let velocity2 = (dx * dx + dy * dy) / (dt * dt);
    let known = candidate.get(appearance::KNOWN).copied().unwrap_or(0.0);
    let unlike = if known > 0.0 { 2.0 - 2.0 * candidate[appearance::MEAN_COSINE] } else { 0.0 };
    let found = [distance * distance, apart * apart, velocity2, velocity2 / (dt * dt), unlike.max(0.0)];
    std::array::from_fn(|i| found[i].min(COST_LIMITS[i]))
}

/// Worth `-C_ij` less that of the least probability, where `probability` is the network's.
pub(super) fn affinity(config: &TrackerConfig, pair: &PairView<'_>, probability: f32) -> Option<Affinity> {
    let link = with_appearance(config, pair, probability);
    let least = config.association.min_link_of(pair.track);
    let logit = |p: f64| {
        let p = p.clamp(1e-6, 1.0 - 1e-6);
        (p / (1.0 - p)).ln()
    };
    (link > least).then(|| Affinity { gain: logit(link) - logit(least), link }).filter(|a| a.gain > 0.0)
}

/// The same with fixed weights.
pub(super) fn fixed_affinity(config: &TrackerConfig, pair: &PairView<'_>) -> Option<Affinity> {
    let row = relative::candidate(pair);
    let cost: f32 = costs(&row).iter().zip(FIXED).map(|(cost, weight)| cost * weight).sum();
    affinity(config, pair, 1.0 / (1.0 + (cost - FIXED_BIAS).exp()))
}
