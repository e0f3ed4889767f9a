//! Every number of the tracker, with its unit and where it comes from.
//!
//! Lengths marked `h` are in units of the box's height, so that the tracker is invariant to
//! resolution; times are in seconds, so that it is invariant to frame rate.

use std::sync::Arc;

use super::association::Association;
use super::existence::ExistenceHead;
use super::features::Features;
use super::tracklet::Tracklet;

/// All settings of a [`super::Tracker`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrackerConfig {
    /// Kalman filter noise.
    pub filter: FilterConfig,
    /// Which pairs of track and detection are looked at.
    pub gate: GateConfig,
    /// How pairs become matches.
    pub association: AssociationConfig,
    /// How appearance joins in, where there are embeddings.
    pub appearance: AppearanceConfig,
    /// Camera motion from the matched boxes.
    pub shift: ShiftConfig,
    /// Births.
    pub birth: BirthConfig,
    /// Confirmation, loss and death.
    pub life: LifeConfig,
    /// Which boxes of confirmed tracks are output.
    pub existence: ExistenceConfig,
}

/// Noise of the constant-velocity Kalman filter over `(cx, cy, w, h)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilterConfig {
    /// White acceleration of the centre: square root of its spectral density, h / s^1.5.
    pub centre_acceleration: f64,
    /// White acceleration of width and height, h / s^1.5.
    pub size_acceleration: f64,
    /// Random walk of the centre, h / s^0.5.
    pub centre_walk: f64,
    /// Random walk of width and height, h / s^0.5.
    pub size_walk: f64,
    /// Standard deviation of a measured centre, h.
    pub centre_measurement: f64,
    /// Standard deviation of a measured width or height, h.
    pub size_measurement: f64,
    /// Standard deviation of a newborn's centre velocity, h / s.
    pub birth_centre_velocity: f64,
    /// Standard deviation of a newborn's size velocity, h / s.
    pub birth_size_velocity: f64,
    /// Time constant with which the velocity of width and height decays, s.
    pub size_velocity_decay: f64,
    /// Noise adapted by the link probability (paper, Eq. Q* and R*).
    pub adaptation: NoiseAdaptation,
}

impl Default for FilterConfig {
    /// As [`FilterConfig::TUNED_ON`] says; `docs/method.md` has the figures. A link network's file brings the
    /// filter that it was trained with.
    fn default() -> Self {
        Self {
            centre_acceleration: 0.117,
            size_acceleration: 0.0317,
            centre_walk: 0.062,
            size_walk: 0.143,
            centre_measurement: 0.0525,
            size_measurement: 0.106,
            ..Self::hand_set()
        }
    }
}

impl FilterConfig {
    /// How the default was found.
    pub const TUNED_ON: &str = "tuned by `gakp tune` (NEES, likelihood) on MOT17-02, 04, 05 and 10 with four \
                                detectors and on ETH-Bahnhof, ETH-Sunnyday, KITTI-13 and KITTI-17 of MOT15";

    /// A first guess, set by hand: what tuning begins with.
    pub fn hand_set() -> Self {
        Self {
            centre_acceleration: 0.5,
            size_acceleration: 0.1,
            centre_walk: 0.3,
            size_walk: 0.1,
            centre_measurement: 0.05,
            size_measurement: 0.07,
            birth_centre_velocity: 2.0,
            birth_size_velocity: 0.1,
            size_velocity_decay: 1.0,
            adaptation: NoiseAdaptation::default(),
        }
    }
}

/// `Q* = Q / (C + lambda_c)` and `R* = R / (C + lambda_c)` (paper, Eq. Q* and R*), where `C` is the
/// link probability of the match.
///
/// The `Q` and `R` of the equation are the [`FilterConfig`]'s times `1 + lambda_c`, so that a sure
/// match (`C = 1`) leaves the tuned noise as it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseAdaptation {
    /// Regularisation `lambda_c` (paper: 0.5).
    pub lambda: f64,
    /// Adapt the process noise by the track's last link probability.
    pub process: bool,
    /// Adapt the measurement noise by the link probability of the match being applied.
    pub measurement: bool,
    /// A track that was not matched has `C = 0` (the paper's reading); otherwise it keeps its last.
    pub zero_when_missed: bool,
}

impl Default for NoiseAdaptation {
    fn default() -> Self {
        Self { lambda: 0.5, process: true, measurement: true, zero_when_missed: false }
    }
}

impl NoiseAdaptation {
    /// Factor on the process noise for a track whose last link probability is `link`.
    pub fn process_factor(&self, link: f64) -> f64 {
        if self.process { (1.0 + self.lambda) / (link + self.lambda) } else { 1.0 }
    }

    /// Factor on the measurement noise for a match of link probability `link`.
    pub fn measurement_factor(&self, link: f64) -> f64 {
        if self.measurement { (1.0 + self.lambda) / (link + self.lambda) } else { 1.0 }
    }
}

/// Which pairs are worth a score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GateConfig {
    /// Squared Mahalanobis distance, chi-square 95 % with 4 degrees of freedom (paper: 9.4877).
    pub mahalanobis: f64,
    /// Whether the gate's covariance is the innovation covariance `H P H' + R` (true) or the
    /// paper's literal `H P H'` (false).
    pub innovation: bool,
    /// Also take pairs with at least this IoU (training looks wider than tracking).
    pub or_iou: Option<f64>,
    /// Also take pairs whose centres are at most this far apart, h.
    pub or_distance: Option<f64>,
}

impl Default for GateConfig {
    fn default() -> Self {
        Self { mahalanobis: 9.4877, innovation: true, or_iou: None, or_distance: None }
    }
}

/// What the Hungarian assignment maximises over the gated pairs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PairScore {
    /// `ln P`: the paper's cost `-ln P`.
    LogLink,
    /// `iou_weight * IoU * (0.7 + 0.3 score) + (1 - iou_weight) * P`.
    Blend {
        /// Weight of the overlap, `[0, 1]`.
        iou_weight: f64,
    },
}

impl Default for PairScore {
    fn default() -> Self {
        Self::Blend { iou_weight: 0.2 }
    }
}

/// From pairs to matches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AssociationConfig {
    /// How a pair is judged.
    pub method: Association,
    /// What the link scorer is shown: what its network was trained on.
    pub features: Features,
    /// What is maximised, for [`Association::Implicit`].
    pub score: PairScore,
    /// Detections below this score do not take part in the first stages.
    pub high_score: f64,
    /// Detections below this score are ignored altogether.
    pub low_score: f64,
    /// A pair below this link probability never matches: for a track just seen.
    pub min_link: f64,
    /// The same once the track has been missed for [`AssociationConfig::min_link_after`].
    pub min_link_lost: f64,
    /// Time over which the bound rises from `min_link` to `min_link_lost`, s.
    pub min_link_after: f64,
    /// Least [`PairScore`] of a match with a confirmed track (for [`PairScore::Blend`]).
    pub min_score: f64,
    /// The same for a tentative track.
    pub min_score_tentative: f64,
    /// Second stage (ByteTrack's idea): unmatched confirmed tracks seen within this time, s, may
    /// take a low-scored detection. Zero turns the stage off.
    pub second_stage_within: f64,
    /// Least IoU in the second stage.
    pub second_stage_iou: f64,
}

impl Default for AssociationConfig {
    fn default() -> Self {
        Self {
            method: Association::default(),
            features: Features::default(),
            score: PairScore::default(),
            high_score: 0.55,
            low_score: 0.1,
            min_link: 0.02,
            min_link_lost: 0.2,
            min_link_after: 0.3,
            min_score: 0.15,
            min_score_tentative: 0.1,
            second_stage_within: 0.0,
            second_stage_iou: 0.5,
        }
    }
}

impl AssociationConfig {
    /// Least score of a match with a confirmed or a tentative track.
    pub fn least(&self, confirmed: bool) -> f64 {
        if confirmed { self.min_score } else { self.min_score_tentative }
    }

    /// The link probability that a match with `track` must have more than.
    pub fn min_link_of(&self, track: &Tracklet) -> f64 {
        let waited = (track.missed_for() / self.min_link_after).clamp(0.0, 1.0);
        self.min_link + (self.min_link_lost - self.min_link) * waited
    }
}

/// How an embedding's similarity moves the link probability:
/// `logit P' = logit P + weight * (cosine - pivot)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AppearanceConfig {
    /// Logits a unit of cosine similarity; zero ignores appearance.
    pub weight: f64,
    /// The similarity that says nothing either way.
    pub pivot: f64,
    /// Share of the new embedding in the track's running mean.
    pub learning_rate: f32,
    /// Embeddings of boxes overlapped more than this (IoU with another detection) are not learned.
    pub max_overlap: f64,
}

impl Default for AppearanceConfig {
    fn default() -> Self {
        Self { weight: 0.0, pivot: 0.8, learning_rate: 0.1, max_overlap: 0.3 }
    }
}

impl AppearanceConfig {
    /// For embeddings of a deep ReID network that nothing else is known of: these have cosines of 0.8
    /// to 0.95 for one person and 0.4 to 0.5 for two.
    pub fn deep() -> Self {
        Self { weight: 20.0, pivot: 0.7, ..Self::default() }
    }
}

/// Camera motion: a global shift estimated from tracks matched by overlap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShiftConfig {
    /// Off for cameras known to be fixed.
    pub enabled: bool,
    /// Whether whoever has the pictures should look for it there first.
    pub picture: bool,
    /// Least IoU of a pair that takes part.
    pub min_iou: f64,
    /// Least number of pairs.
    pub min_pairs: usize,
    /// Shrinkage: the median moves by `n / (n + shrink)`.
    pub shrink: f64,
    /// A track takes part from this many hits on.
    pub min_hits: u32,
}

impl Default for ShiftConfig {
    fn default() -> Self {
        Self { enabled: true, picture: true, min_iou: 0.25, min_pairs: 3, shrink: 0.3, min_hits: 3 }
    }
}

/// When an unmatched detection becomes a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BirthConfig {
    /// Least score.
    pub score: f64,
    /// Not where a track matched in this frame overlaps more than this (IoU).
    pub max_iou: f64,
}

impl Default for BirthConfig {
    fn default() -> Self {
        Self { score: 0.6, max_iou: 0.5 }
    }
}

/// Confirmation, coasting, loss and death.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LifeConfig {
    /// A track is confirmed at this many hits; a tentative one dies at its first miss.
    pub confirm_hits: u32,
    /// A confirmed track that is missed stays `confirmed`, its box predicted, this long, s (where no
    /// existence head decides).
    pub coast: f64,
    /// A track missed longer than this dies, s.
    pub lost: f64,
    /// Bound on live tracks a camera: beyond it nothing is born.
    pub max_tracks: usize,
    /// Bound on detections a frame: the best by score are taken.
    pub max_detections: usize,
}

impl Default for LifeConfig {
    fn default() -> Self {
        Self { confirm_hits: 3, coast: 0.15, lost: 2.0, max_tracks: 1000, max_detections: 1000 }
    }
}

/// A learned decision on what is output: [`super::ExistenceHead`].
#[derive(Clone, Debug, PartialEq)]
pub struct ExistenceConfig {
    /// The network. Without one, what is matched is output, and what is missed for
    /// [`LifeConfig::coast`].
    pub head: Option<Arc<ExistenceHead>>,
    /// Least log-odds of a matched box that is output: the detection speaks for it, so doubt must be plain.
    pub matched: f64,
    /// Least log-odds of a coasted box that is output.
    pub coasted: f64,
    /// A track missed longer than this is not output, whatever the network says, s.
    pub coast: f64,
}

impl Default for ExistenceConfig {
    fn default() -> Self {
        Self { head: None, matched: -1.0, coasted: -0.3, coast: 0.5 }
    }
}
