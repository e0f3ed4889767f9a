//! One track: its filter, its last observations, its stage of life.

use std::collections::VecDeque;

use super::config::{FilterConfig, LifeConfig};
use super::kalman::BoxFilter;
use super::link::HISTORY;
use super::motion::{Step, measurement_noise, newborn};
use super::shift::Shift;
use crate::types::{BBox, ClassId, Detection, Embedding, MediaTime, TrackId, TrackState};

/// Where the running mean of innovations begins, heights.
const TYPICAL_INNOVATION: f64 = 0.1;

/// One detection that was matched to a track.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// The detected box, in the picture's coordinates of now (moved along with the camera).
    pub bbox: BBox,
    /// When.
    pub time: MediaTime,
    /// The detection's score.
    pub score: f64,
    /// `(dx/h, dy/h, ln w/w', ln h/h')` against the box that was predicted for it.
    pub innovation: [f64; 4],
    /// What it looked like.
    pub embedding: Option<Embedding>,
}

/// Innovation of `seen` against `predicted`, in units of the predicted box.
pub fn innovation(predicted: &BBox, seen: &BBox) -> [f64; 4] {
    let h = predicted.h.max(1.0);
    [
        (seen.cx() - predicted.cx()) / h,
        (seen.cy() - predicted.cy()) / h,
        (seen.w.max(1.0) / predicted.w.max(1.0)).ln(),
        (seen.h.max(1.0) / h).ln(),
    ]
}

/// A track of one camera.
#[derive(Clone, Debug)]
pub struct Tracklet {
    /// Identity.
    pub id: TrackId,
    /// Class of its detections.
    pub class: ClassId,
    /// The filter, at [`Tracklet::time`].
    pub filter: BoxFilter,
    /// The time that the filter stands at.
    pub time: MediaTime,
    /// Up to [`HISTORY`] last observations, the oldest first; never empty.
    pub history: VecDeque<Observation>,
    /// When it was born.
    pub born: MediaTime,
    /// Frames since then, that of its birth included.
    pub frames: u32,
    /// Matches so far, birth included.
    pub hits: u32,
    /// Since when it has been matched in every frame; `None` when the last counted frame missed it.
    pub matched_since: Option<MediaTime>,
    /// Running mean of the length of its innovations `(dx/h, dy/h)`.
    pub mean_innovation: f64,
    /// Whether it was believed once; never taken back.
    pub confirmed: bool,
    /// Whether a detection of the current frame was matched.
    pub matched: bool,
    /// Link probability of the last match; 1 at birth.
    pub link: f64,
    /// Running mean of its embeddings.
    pub appearance: Option<Embedding>,
}

impl Tracklet {
    /// A track born of `detection` at `time`.
    pub fn born(
        id: TrackId,
        detection: &Detection,
        embedding: Option<&Embedding>,
        time: MediaTime,
        config: &FilterConfig,
    ) -> Self {
        let bbox = detection.bbox;
        let mut history = VecDeque::with_capacity(HISTORY);
        history.push_back(Observation {
            bbox,
            time,
            score: detection.score,
            innovation: [0.0; 4],
            embedding: embedding.cloned(),
        });
        Self {
            id,
            class: detection.class,
            filter: newborn(config, [bbox.cx(), bbox.cy(), bbox.w, bbox.h]),
            time,
            history,
            born: time,
            frames: 1,
            hits: 1,
            matched_since: Some(time),
            mean_innovation: TYPICAL_INNOVATION,
            confirmed: false,
            matched: true,
            link: 1.0,
            appearance: embedding.cloned(),
        }
    }

    /// Moves the filter by `step` to `time` (Eq. mean_prediction, covariance_prediction with Q*).
    pub fn predict(&mut self, time: MediaTime, step: &Step<'_>) {
        let adaptation = &step.config().adaptation;
        let link = if !self.matched && adaptation.zero_when_missed { 0.0 } else { self.link };
        self.filter.predict(&step.motion(self.bbox().h, adaptation.process_factor(link)));
        self.time = time;
    }

    /// The filter's box now; its size is kept at one pixel at least.
    pub fn bbox(&self) -> BBox {
        let [cx, cy, w, h] = self.filter.position();
        BBox::from_center(cx, cy, w.max(1.0), h.max(1.0))
    }

    /// Measurement noise of a sure match now: diagonal of `R`.
    pub fn measurement_noise(&self, config: &FilterConfig) -> [f64; 4] {
        measurement_noise(config, self.bbox().h, 1.0)
    }

    /// Takes a detection of `link` probability (Eq. mean_update, covariance_update with R*).
    pub fn observe(
        &mut self,
        detection: &Detection,
        embedding: Option<&Embedding>,
        link: f64,
        time: MediaTime,
        config: &FilterConfig,
    ) {
        let (predicted, seen) = (self.bbox(), detection.bbox);
        let innovation = innovation(&predicted, &seen);
        if self.history.len() == HISTORY {
            self.history.pop_front();
        }
        self.history.push_back(Observation {
            bbox: seen,
            time,
            score: detection.score,
            innovation,
            embedding: embedding.cloned(),
        });
        self.mean_innovation += 0.2 * (innovation[0].hypot(innovation[1]) - self.mean_innovation);
        self.matched_since.get_or_insert(time);
        let r = measurement_noise(config, predicted.h, config.adaptation.measurement_factor(link));
        self.filter.update([seen.cx(), seen.cy(), seen.w, seen.h], r);
        self.hits = self.hits.saturating_add(1);
        self.matched = true;
        self.link = link;
        self.class = detection.class;
    }

    /// Counts a frame whose matches have been applied.
    pub fn count_frame(&mut self) {
        self.frames = self.frames.saturating_add(1);
        if !self.matched {
            self.matched_since = None;
        }
    }

    /// Moves everything that it knows by the camera's shift, and is as much less sure of its place as the
    /// shift is unsure; velocities stay.
    pub fn shift(&mut self, shift: &Shift) {
        let Shift { by: [dx, dy], variance } = *shift;
        for ((axis, d), variance) in self.filter.axes.iter_mut().zip([dx, dy]).zip(variance) {
            axis.x[0] += d;
            axis.P[(0, 0)] += variance;
        }
        for seen in &mut self.history {
            seen.bbox = seen.bbox.shifted(dx, dy);
        }
    }

    /// The last matched detection.
    pub fn last(&self) -> &Observation {
        self.history.back().expect("a track has been seen at least once")
    }

    /// Seconds since the last match.
    pub fn missed_for(&self) -> f64 {
        self.time.since(self.last().time)
    }

    /// Stage of life of a track whose object is shown by its box now (`shown`) or not.
    pub fn state(&self, shown: bool) -> TrackState {
        match (self.confirmed && shown, self.matched) {
            (true, _) => TrackState::Confirmed,
            (false, true) => TrackState::Tentative,
            (false, false) if self.confirmed => TrackState::Lost,
            (false, false) => TrackState::Tentative,
        }
    }

    /// Whether it ends now: a tentative one missed, one lost for too long, or one that has left the
    /// `width` x `height` picture.
    pub fn is_over(&self, config: &LifeConfig, width: f64, height: f64) -> bool {
        if self.matched {
            return false;
        }
        !self.confirmed || self.missed_for() > config.lost || self.bbox().clipped(width, height).is_none()
    }
}
