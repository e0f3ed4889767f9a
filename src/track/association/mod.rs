//! Which detection continues which track: every association of the paper, one a file.
//!
//! | setting | file | a pair's worth | asks the link scorer |
//! | --- | --- | --- | --- |
//! | `iou` | [`iou`] | overlap with the track's last box (Bochinski 2017) | no |
//! | `iou-motion` | [`iou_motion`] | overlap with the predicted box, gated | no |
//! | `deep` | [`deep`] | overlap, motion and appearance, weighed by hand (POI, Yu 2016) | no |
//! | `explicit` | [`explicit`] | `-C_ij` of Eq. cost_function, weights from a recurrent network | yes |
//! | `explicit-fixed` | [`explicit`] | the same, fixed weights | no |
//! | `implicit` | [`implicit`] | link probability of the GRU (Eq. GRU) | yes |
//! | `huang` | [`huang`] | `ln(A_pos A_size A_appr)` (Huang 2008) | no |
//! | `mahalanobis` | [`mahalanobis`] | gate less squared distance (Eq. Mahalanobis) | no |
//!
//! Each says what a gated pair is worth; [`match_pairs`] takes the pairs of greatest total worth. All
//! else (filter, camera motion, births, loss) is the same for all of them. [`gate()`] differs for `iou`
//! alone, which knows no motion.

pub mod deep;
pub mod explicit;
pub mod huang;
pub mod implicit;
pub mod iou;
pub mod iou_motion;
pub mod mahalanobis;
mod matching;

use std::fmt;
use std::str::FromStr;

pub use matching::{Match, match_pairs};

use super::TrackerConfig;
use super::gate::{self, PairGeometry};
use super::nearby::Nearby;
use super::pair::PairView;
use super::tracklet::Tracklet;
use crate::types::BBox;

/// How a pair of track and detection is judged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Association {
    /// Overlap with the track's last box.
    Iou,
    /// Overlap with the predicted box.
    IouMotion,
    /// Overlap, motion and appearance, weighed by hand.
    Deep,
    /// Explicit features, weighed by a recurrent network.
    Explicit,
    /// Explicit features, fixed weights.
    ExplicitFixed,
    /// The GRU's link probability, as [`super::PairScore`] says.
    #[default]
    Implicit,
    /// Huang's product of position, size and appearance.
    Huang,
    /// The squared Mahalanobis distance.
    Mahalanobis,
}

impl Association {
    /// All of them.
    pub const ALL: [Association; 8] = [
        Association::Iou,
        Association::IouMotion,
        Association::Deep,
        Association::Explicit,
        Association::ExplicitFixed,
        Association::Implicit,
        Association::Huang,
        Association::Mahalanobis,
    ];

    /// The name in settings.
    pub const fn as_str(self) -> &'static str {
        match self {
            Association::Iou => "iou",
            Association::IouMotion => "iou-motion",
            Association::Deep => "deep",
            Association::Explicit => "explicit",
            Association::ExplicitFixed => "explicit-fixed",
            Association::Implicit => "implicit",
            Association::Huang => "huang",
            Association::Mahalanobis => "mahalanobis",
        }
    }

    /// Whether it needs a link probability of every pair. Without, the tracker's request is always
    /// empty and no scorer is called.
    pub const fn asks_scorer(self) -> bool {
        matches!(self, Association::Explicit | Association::Implicit)
    }

    /// Whether it is incomplete without embeddings.
    pub const fn needs_appearance(self) -> bool {
        matches!(self, Association::Deep | Association::Huang)
    }

    /// Whether the Kalman prediction takes part; otherwise a track is where it was last seen.
    pub const fn uses_motion(self) -> bool {
        !matches!(self, Association::Iou)
    }
}

impl fmt::Display for Association {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A name that is no association.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no association: use iou, iou-motion, deep, explicit, explicit-fixed, implicit, huang or mahalanobis"
)]
pub struct UnknownAssociation(String);

impl FromStr for Association {
    type Err = UnknownAssociation;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|a| a.as_str() == name).ok_or_else(|| UnknownAssociation(name.into()))
    }
}

/// What a pair is worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affinity {
    /// What the assignment maximises; positive and finite.
    pub gain: f64,
    /// The composite similarity `C` of Eq. Q* and R*, `[0, 1]`.
    pub link: f64,
}

impl Affinity {
    /// A similarity in `[0, 1]`, worth what it has beyond `least`; `None` when it has no more.
    fn beyond(similarity: f64, least: f64) -> Option<Self> {
        (similarity > least).then(|| Self { gain: similarity - least, link: similarity.clamp(0.0, 1.0) })
    }
}

/// What the pair is worth; `None` when it must not match. `probability` is the link scorer's, for
/// those that ask it.
pub fn affinity(config: &TrackerConfig, pair: &PairView<'_>, probability: Option<f32>) -> Option<Affinity> {
    match config.association.method {
        Association::Iou => iou::affinity(pair),
        Association::IouMotion => iou_motion::affinity(&config.association, pair),
        Association::Deep => deep::affinity(config.gate.mahalanobis, pair),
        Association::Explicit => explicit::affinity(config, pair, probability.unwrap_or(0.0)),
        Association::ExplicitFixed => explicit::fixed_affinity(config, pair),
        Association::Implicit => implicit::affinity(config, pair, probability.unwrap_or(0.0)),
        Association::Huang => huang::affinity(pair),
        Association::Mahalanobis => mahalanobis::affinity(config.gate.mahalanobis, pair),
    }
}

/// The detections that [`gate()`] may let through, and no more than a few others: number and box.
pub fn near<'a>(
    config: &TrackerConfig,
    track: &Tracklet,
    predicted: &BBox,
    r: [f64; 4],
    detections: &'a Nearby,
) -> impl Iterator<Item = (usize, &'a BBox)> {
    let (centre, reach) = if config.association.method.uses_motion() {
        (predicted, gate::reach(&config.gate, &track.filter, r))
    } else {
        let last = &track.last().bbox;
        (last, detections.reach(last))
    };
    detections.within([centre.cx(), centre.cy()], reach)
}

/// Whether the pair is looked at; see [`gate::gate`] for the arguments.
pub fn gate(
    config: &TrackerConfig,
    track: &Tracklet,
    predicted: &BBox,
    r: [f64; 4],
    detection: &BBox,
) -> Option<PairGeometry> {
    if config.association.method.uses_motion() {
        gate::gate(&config.gate, &track.filter, predicted, r, detection)
    } else {
        iou::gate(track, detection)
    }
}
