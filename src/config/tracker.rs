//! `[tracker]`: the settings of the core that users change.

use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;

use crate::infer::ModelSettings;
use crate::track::{Association, PairScore, TrackerConfig};
use crate::tuning::Tuning;

/// `[tracker]`: what users change; see [`TrackerConfig`] for the meaning.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackerOptions {
    /// A tuning file of `gakp tune`: the filter's noise. Relative to the configuration's folder.
    pub tuning: Option<PathBuf>,
    /// Detections from this score on take part in the first matching stage.
    pub high_score: Option<f64>,
    /// Detections below this score are ignored.
    pub low_score: Option<f64>,
    /// Least score of a birth.
    pub birth_score: Option<f64>,
    /// Hits until a track is confirmed.
    pub confirm_hits: Option<u32>,
    /// How long a missed track stays confirmed at most, seconds.
    pub coast_s: Option<f64>,
    /// Whether the existence head of the link model decides which boxes are output.
    pub existence: Option<bool>,
    /// How long a missed track may take a low-scored detection, seconds; 0 never.
    pub second_stage_s: Option<f64>,
    /// How long a lost track is kept, seconds.
    pub lost_s: Option<f64>,
    /// Whether the camera may move.
    pub camera_motion: Option<bool>,
    /// Whether its motion is looked for in the pictures; otherwise the boxes alone tell it.
    pub picture_motion: Option<bool>,
    /// How pairs are judged: `iou`, `iou-motion`, `deep`, `explicit`, `explicit-fixed`, `implicit`, `huang`,
    /// `mahalanobis`; see [`crate::track::association`].
    pub association: Option<String>,
    /// `blend` (link probability and overlap) or `log-link` (the paper's `-ln P`).
    pub cost: Option<String>,
    /// `lambda_c` of Eq. Q* and R*.
    pub lambda_c: Option<f64>,
    /// Whether Q and R adapt to the link probability.
    pub adapt_noise: Option<bool>,
    /// The Mahalanobis gate, squared distance.
    pub gate: Option<f64>,
    /// Gate by the paper's literal `H P H'` instead of the innovation covariance.
    pub literal_gate: Option<bool>,
    /// Logits that a unit of cosine similarity moves the link probability by; 0 ignores appearance. A link
    /// network that reads embeddings itself is left alone.
    pub appearance_weight: Option<f64>,
    /// The cosine similarity that says nothing either way.
    pub appearance_pivot: Option<f64>,
}

impl TrackerOptions {
    /// `models` without the link scorer where the association asks none.
    ///
    /// # Errors
    /// As [`TrackerOptions::apply`].
    pub fn without_idle(&self, models: &ModelSettings) -> Result<ModelSettings> {
        let asks = self.apply(TrackerConfig::default())?.association.method.asks_scorer();
        let link = if asks { models.link.clone() } else { "none".into() };
        Ok(ModelSettings { link, ..models.clone() })
    }

    /// These options with the tuning file of the command line, where one is given.
    ///
    /// # Errors
    /// The file cannot be used; the message names it.
    pub fn tuned(mut self, file: Option<PathBuf>) -> Result<Self> {
        if let Some(file) = file {
            Tuning::read(&file)?;
            self.tuning = Some(file);
        }
        Ok(self)
    }

    /// `base` with what these options change.
    ///
    /// # Errors
    /// A value out of its range, or a tuning file that cannot be used; the message names the key or the file.
    pub fn apply(&self, mut base: TrackerConfig) -> Result<TrackerConfig> {
        if let Some(file) = &self.tuning {
            base.filter = Tuning::read(file).context("tracker.tuning")?.filter.apply(base.filter);
        }
        let unit = |key: &str, value: Option<f64>, into: &mut f64| -> Result<()> {
            if let Some(value) = value {
                ensure!((0.0..=1.0).contains(&value), "tracker.{key} = {value}: must be from 0 to 1");
                *into = value;
            }
            Ok(())
        };
        let positive = |key: &str, value: Option<f64>, into: &mut f64| -> Result<()> {
            if let Some(value) = value {
                ensure!(value.is_finite() && value > 0.0, "tracker.{key} = {value}: must be more than 0");
                *into = value;
            }
            Ok(())
        };
        unit("high_score", self.high_score, &mut base.association.high_score)?;
        unit("low_score", self.low_score, &mut base.association.low_score)?;
        unit("birth_score", self.birth_score, &mut base.birth.score)?;
        positive("lost_s", self.lost_s, &mut base.life.lost)?;
        positive("lambda_c", self.lambda_c, &mut base.filter.adaptation.lambda)?;
        positive("gate", self.gate, &mut base.gate.mahalanobis)?;
        if let Some(coast) = self.coast_s {
            ensure!(
                (0.0..=base.life.lost).contains(&coast),
                "tracker.coast_s = {coast}: must be from 0 to lost_s"
            );
            base.life.coast = coast;
            base.existence.coast = coast;
        }
        if self.existence == Some(false) {
            base.existence.head = None;
        }
        if let Some(seconds) = self.second_stage_s {
            ensure!(
                seconds.is_finite() && seconds >= 0.0,
                "tracker.second_stage_s = {seconds}: must not be negative"
            );
            base.association.second_stage_within = seconds;
        }
        if let Some(hits) = self.confirm_hits {
            ensure!(hits >= 1, "tracker.confirm_hits = 0: must be at least 1");
            base.life.confirm_hits = hits;
        }
        if let Some(moves) = self.camera_motion {
            base.shift.enabled = moves;
        }
        if let Some(look) = self.picture_motion {
            base.shift.picture = look;
        }
        if let Some(name) = &self.association {
            base.association.method = name.parse::<Association>().context("tracker.association")?;
        }
        match self.cost.as_deref() {
            None => {}
            Some("blend") => base.association.score = PairScore::default(),
            Some("log-link") => base.association.score = PairScore::LogLink,
            Some(other) => bail!("tracker.cost = {other:?}: must be \"blend\" or \"log-link\""),
        }
        if let Some(adapt) = self.adapt_noise {
            base.filter.adaptation.process = adapt;
            base.filter.adaptation.measurement = adapt;
        }
        if let Some(literal) = self.literal_gate {
            base.gate.innovation = !literal;
        }
        if let Some(weight) = self.appearance_weight {
            ensure!(
                weight.is_finite() && weight >= 0.0,
                "tracker.appearance_weight = {weight}: must not be negative"
            );
            base.appearance.weight = weight;
        }
        if let Some(pivot) = self.appearance_pivot {
            ensure!(
                (-1.0..=1.0).contains(&pivot),
                "tracker.appearance_pivot = {pivot}: must be from -1 to 1"
            );
            base.appearance.pivot = pivot;
        }
        Ok(base)
    }
}
