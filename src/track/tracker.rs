//! The tracker of one camera: predict, then update, once a frame.

use super::association::{self, Affinity, Match, match_pairs};
use super::config::{ExistenceConfig, TrackerConfig};
use super::existence;
use super::gate::PairGeometry;
use super::link::{LinkRequest, Pair};
use super::motion::Step;
use super::nearby::Nearby;
use super::pair::PairView;
use super::record::DetectorRecord;
use super::shift::{Shift, global_shift};
use super::tracklet::Tracklet;
use crate::types::{BBox, Detection, Embedding, MediaTime, TrackId, TrackReport};

/// Boxes beyond this many pixels are garbage; squares of such numbers would overflow the filter.
const MAX_COORDINATE: f64 = 1e6;

/// One frame as the tracker sees it.
#[derive(Clone, Copy, Debug)]
pub struct FrameInput<'a> {
    /// When, on the camera's own time line.
    pub time: MediaTime,
    /// Width of the picture, pixels.
    pub width: f64,
    /// Height of the picture, pixels.
    pub height: f64,
    /// What was detected, in any order. Boxes that are not finite, have no area or lie beyond 1e6 pixels
    /// are ignored.
    pub detections: &'a [Detection],
    /// The detections' embeddings: empty, or one entry a detection.
    pub embeddings: &'a [Option<Embedding>],
    /// The camera's shift since the frame that was predicted last, where the picture tells it; otherwise, and
    /// where it is not [usable](Shift::is_usable), the boxes may.
    pub shift: Option<Shift>,
}

/// What the tracker says about the frame that it was just given.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Update {
    /// Live tracks, in the order of their ids.
    pub tracks: Vec<TrackReport>,
    /// Tracks that died, in the order of their ids.
    pub ended: Vec<TrackId>,
}

/// What to do with a frame: [`Tracker::decide`] makes it from scores, training from the truth.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decision {
    /// Matches; a track and a detection at most once each.
    pub matches: Vec<Match>,
    /// Detections that become tracks, in the order of the ids that they get.
    pub births: Vec<usize>,
}

/// Misuse of the predict-update contract.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TrackError {
    /// `update` without `predict`.
    #[error("update without a frame: call predict first")]
    NoFrame,
    /// The scorer's answer does not fit the request.
    #[error("{got} link probabilities for {expected} pairs: the scorer must answer every pair")]
    ScoreCount {
        /// Pairs asked for.
        expected: usize,
        /// Probabilities given.
        got: usize,
    },
}

/// A gated pair of the frame in hand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GatedPair {
    /// Index into [`Tracker::tracks`].
    pub track: usize,
    /// Index into [`Tracker::detections`].
    pub detection: usize,
    /// What the gate measured.
    pub geometry: PairGeometry,
}

/// Tracks the objects of one camera. Deterministic: the same calls give the same tracks.
#[derive(Clone, Debug)]
pub struct Tracker {
    config: TrackerConfig,
    tracks: Vec<Tracklet>,
    next_id: u64,
    record: DetectorRecord,
    // The frame in hand, between predict and update.
    awaiting: bool,
    size: (f64, f64),
    time: MediaTime,
    predicted: Vec<BBox>,
    detections: Vec<Detection>,
    embeddings: Vec<Option<Embedding>>,
    /// Detections of the first stages, those that score high.
    high: Nearby,
    pairs: Vec<GatedPair>,
}

impl Tracker {
    /// A tracker without tracks; the first id is 1.
    pub fn new(config: TrackerConfig) -> Self {
        Self {
            config,
            tracks: Vec::new(),
            next_id: 1,
            record: DetectorRecord::default(),
            awaiting: false,
            size: (0.0, 0.0),
            time: MediaTime::default(),
            predicted: Vec::new(),
            detections: Vec::new(),
            embeddings: Vec::new(),
            high: Nearby::default(),
            pairs: Vec::new(),
        }
    }

    /// A new one in its place, which goes on with the ids, and those that end with this one. After a panic in the middle of
    /// a frame nothing else of it is to be relied on.
    pub fn renewed(self) -> (Self, Vec<TrackId>) {
        let ended = self.tracks.iter().map(|track| track.id).collect();
        (Self { next_id: self.next_id, ..Self::new(self.config) }, ended)
    }

    /// Live tracks, in the order of their ids.
    pub fn tracks(&self) -> &[Tracklet] {
        &self.tracks
    }

    /// How the detector does on this camera.
    pub fn record(&self) -> DetectorRecord {
        self.record
    }

    /// The usable detections of the frame in hand; pairs and decisions index into these.
    pub fn detections(&self) -> &[Detection] {
        &self.detections
    }

    /// The gated pairs of the frame in hand, in the order of the request's pairs.
    pub fn pairs(&self) -> &[GatedPair] {
        &self.pairs
    }

    /// The tracks' boxes predicted for the frame in hand.
    pub fn predicted(&self) -> &[BBox] {
        &self.predicted
    }

    /// Takes a frame, moves every track to its time, and writes the pairs that need a link
    /// probability to `request` (which is emptied first). A time before the last frame's counts as
    /// the last frame's. A frame that still awaits its scores is given up: it changed no track
    /// beyond the prediction.
    pub fn predict(&mut self, frame: FrameInput<'_>, request: &mut LinkRequest) {
        self.take_detections(&frame);
        self.awaiting = true;
        self.size = (frame.width, frame.height);
        // Every track stands at the last frame's time.
        let time = self.time.max(frame.time);
        let step = Step::new(&self.config.filter, time.since(self.time));
        self.record.fade(time.since(self.time));
        self.time = time;
        for track in &mut self.tracks {
            track.predict(time, &step);
        }
        self.follow_camera(frame.shift);
        for track in &mut self.tracks {
            track.matched = false;
        }
        self.predicted.clear();
        self.predicted.extend(self.tracks.iter().map(Tracklet::bbox));
        self.gate_pairs(request);
    }

    /// Decides the frame in hand by link probabilities, one for each of the request's pairs (a value
    /// that is not finite counts as 0), and applies the decision.
    pub fn update(&mut self, links: &[f32]) -> Result<Update, TrackError> {
        let decision = self.decide(links)?;
        self.apply(&decision)
    }

    /// The matches and births that `links` make of the frame in hand.
    pub fn decide(&self, links: &[f32]) -> Result<Decision, TrackError> {
        if !self.awaiting {
            return Err(TrackError::NoFrame);
        }
        let asked = self.config.association.method.asks_scorer();
        let expected = if asked { self.pairs.len() } else { 0 };
        if links.len() != expected {
            return Err(TrackError::ScoreCount { expected, got: links.len() });
        }
        let worth: Vec<Option<Affinity>> = (0..self.pairs.len())
            .map(|index| self.affinity(&self.pairs[index], links.get(index).copied()))
            .collect();
        let mut matches = Vec::new();
        let mut track_taken = vec![false; self.tracks.len()];
        let mut detection_taken = vec![false; self.detections.len()];
        for confirmed in [true, false] {
            self.match_stage(confirmed, &worth, &mut matches, &mut track_taken, &mut detection_taken);
        }
        self.match_low_scores(&mut matches, &mut track_taken, &mut detection_taken);
        let births = self.births(&matches, &detection_taken);
        Ok(Decision { matches, births })
    }

    /// Applies a decision to the frame in hand.
    ///
    /// # Panics
    /// When an index of the decision is out of range.
    pub fn apply(&mut self, decision: &Decision) -> Result<Update, TrackError> {
        if !self.awaiting {
            return Err(TrackError::NoFrame);
        }
        self.awaiting = false;
        for m in &decision.matches {
            let detection = self.detections[m.detection];
            let embedding = self.embeddings.get(m.detection).and_then(Option::as_ref);
            self.tracks[m.track].observe(&detection, embedding, m.link, self.time, &self.config.filter);
            self.learn_appearance(m);
        }
        for track in &mut self.tracks {
            track.count_frame();
            if track.confirmed {
                self.record.expect(track.missed_for(), track.matched);
                continue;
            }
            track.confirmed = track.hits >= self.config.life.confirm_hits;
            if track.confirmed || !track.matched {
                self.record.settle(track.confirmed);
            }
        }
        let (width, height) = self.size;
        let mut ended = Vec::new();
        let life = self.config.life;
        self.tracks.retain(|track| {
            let over = track.is_over(&life, width, height);
            if over {
                ended.push(track.id);
            }
            !over
        });
        for &index in &decision.births {
            if self.tracks.len() < life.max_tracks {
                let embedding = self.embeddings.get(index).and_then(Option::as_ref);
                let id = TrackId(self.next_id);
                let mut track =
                    Tracklet::born(id, &self.detections[index], embedding, self.time, &self.config.filter);
                track.confirmed = life.confirm_hits <= 1;
                self.tracks.push(track);
                self.next_id += 1;
            }
        }
        let shown = self.shown();
        Ok(Update {
            tracks: self.tracks.iter().zip(shown).map(|(t, shown)| report(t, shown)).collect(),
            ended,
        })
    }

    /// Whether each track's box shows its object now, as far as can be told; of confirmed tracks only.
    fn shown(&self) -> Vec<bool> {
        let Some(head) = &self.config.existence.head else {
            let coast = self.config.life.coast;
            return self.tracks.iter().map(|t| t.matched || t.missed_for() <= coast).collect();
        };
        let ExistenceConfig { matched, coasted, coast, .. } = self.config.existence;
        let scene = existence::Scene::new(&self.tracks, self.size, self.record);
        let shown = |(index, track): (usize, &Tracklet)| {
            let least = if track.matched { matched } else { coasted };
            let may = track.confirmed && (track.matched || track.missed_for() <= coast);
            may && f64::from(head.logit(&scene.features(index))) >= least
        };
        self.tracks.iter().enumerate().map(shown).collect()
    }

    fn take_detections(&mut self, frame: &FrameInput<'_>) {
        let usable = |d: &Detection| {
            let BBox { x, y, w, h } = d.bbox;
            d.bbox.is_valid()
                && [x, y, w, h].iter().all(|v| v.abs() <= MAX_COORDINATE)
                && d.score.is_finite()
                && d.score >= self.config.association.low_score
        };
        let mut order: Vec<usize> =
            (0..frame.detections.len()).filter(|&i| usable(&frame.detections[i])).collect();
        if order.len() > self.config.life.max_detections {
            order.sort_by(|&a, &b| frame.detections[b].score.total_cmp(&frame.detections[a].score));
            order.truncate(self.config.life.max_detections);
            order.sort_unstable();
        }
        self.detections.clear();
        self.detections.extend(order.iter().map(|&i| frame.detections[i]));
        self.embeddings.clear();
        if frame.embeddings.len() == frame.detections.len() {
            self.embeddings.extend(order.iter().map(|&i| frame.embeddings[i].clone()));
        }
        let high = self.config.association.high_score;
        let boxes = self.detections.iter().map(|d| (d.score, d.bbox)).enumerate();
        self.high.fill(boxes.filter(|(_, (score, _))| *score >= high).map(|(i, (_, bbox))| (i, bbox)));
    }

    /// Moves every track by the camera's own motion, which the picture has told or the boxes tell.
    fn follow_camera(&mut self, told: Option<Shift>) {
        let config = &self.config.shift;
        if !config.enabled {
            return;
        }
        let seen: Vec<BBox> = self
            .tracks
            .iter()
            .filter(|t| t.matched && t.hits >= config.min_hits)
            .map(Tracklet::bbox)
            .collect();
        if let Some(shift) = told.filter(Shift::is_usable).or_else(|| global_shift(config, &seen, &self.high))
        {
            for track in &mut self.tracks {
                track.shift(&shift);
            }
        }
    }

    fn gate_pairs(&mut self, request: &mut LinkRequest) {
        request.clear();
        let features = self.config.association.features;
        request.features = features;
        self.pairs.clear();
        let asks = self.config.association.method.asks_scorer();
        for (index, (track, predicted)) in self.tracks.iter().zip(&self.predicted).enumerate() {
            let r = track.measurement_noise(&self.config.filter);
            let first = self.pairs.len();
            for (d, _) in association::near(&self.config, track, predicted, r, &self.high) {
                let detection = &self.detections[d];
                if detection.class != track.class {
                    continue;
                }
                let open = association::gate(&self.config, track, predicted, r, &detection.bbox);
                if let Some(geometry) = open {
                    if asks {
                        let pair = Pair { track: request.lengths.len() as u32, detection: d as u32 };
                        request.pairs.push(pair);
                        let embedding = self.embeddings.get(d).and_then(Option::as_ref);
                        let geometry = &geometry;
                        let view = PairView { track, predicted, detection, embedding, geometry };
                        features.push_candidate(&view, self.size, &mut request.candidates);
                    }
                    self.pairs.push(GatedPair { track: index, detection: d, geometry });
                }
            }
            if asks && self.pairs.len() > first {
                let valid = features.push_history(track, self.size, &mut request.histories);
                request.lengths.push(valid as i32);
            }
        }
    }

    /// What a match of `pair` is worth; `None` when it must not be.
    fn affinity(&self, pair: &GatedPair, probability: Option<f32>) -> Option<Affinity> {
        let view = PairView {
            track: &self.tracks[pair.track],
            predicted: &self.predicted[pair.track],
            detection: &self.detections[pair.detection],
            embedding: self.embeddings.get(pair.detection).and_then(Option::as_ref),
            geometry: &pair.geometry,
        };
        association::affinity(&self.config, &view, probability)
    }

    fn match_stage(
        &self,
        confirmed: bool,
        worth: &[Option<Affinity>],
        matches: &mut Vec<Match>,
        track_taken: &mut [bool],
        detection_taken: &mut [bool],
    ) {
        let mut allowed = Vec::new();
        let mut source = Vec::new();
        for (index, (pair, worth)) in self.pairs.iter().zip(worth).enumerate() {
            if self.tracks[pair.track].confirmed != confirmed || detection_taken[pair.detection] {
                continue;
            }
            if let Some(Affinity { gain, link }) = *worth {
                allowed.push((pair.track, pair.detection, gain));
                source.push((index, link));
            }
        }
        for chosen in match_pairs(&allowed, self.tracks.len(), self.detections.len()) {
            let (index, link) = source[chosen];
            let GatedPair { track, detection, .. } = self.pairs[index];
            track_taken[track] = true;
            detection_taken[detection] = true;
            matches.push(Match { track, detection, link });
        }
    }

    /// Second stage: tracks seen a moment ago may take a low-scored detection, by overlap alone.
    fn match_low_scores(
        &self,
        matches: &mut Vec<Match>,
        track_taken: &mut [bool],
        detection_taken: &mut [bool],
    ) {
        let config = &self.config.association;
        if config.second_stage_within <= 0.0 {
            return;
        }
        let motion = config.method.uses_motion();
        let mut allowed = Vec::new();
        for (d, detection) in self.detections.iter().enumerate() {
            if detection.score >= config.high_score {
                continue;
            }
            for (t, track) in self.tracks.iter().enumerate() {
                let waiting = track.confirmed
                    && !track_taken[t]
                    && track.class == detection.class
                    && track.missed_for() <= config.second_stage_within;
                if waiting {
                    let place = if motion { &self.predicted[t] } else { &track.last().bbox };
                    let iou = place.iou(&detection.bbox);
                    if iou > config.second_stage_iou {
                        allowed.push((t, d, iou));
                    }
                }
            }
        }
        for chosen in match_pairs(&allowed, self.tracks.len(), self.detections.len()) {
            let (track, detection, iou) = allowed[chosen];
            track_taken[track] = true;
            detection_taken[detection] = true;
            matches.push(Match { track, detection, link: iou * self.detections[detection].score });
        }
    }

    fn births(&self, matches: &[Match], detection_taken: &[bool]) -> Vec<usize> {
        let config = &self.config.birth;
        let covered =
            |d: &BBox| matches.iter().any(|m| self.detections[m.detection].bbox.iou(d) > config.max_iou);
        let mut births: Vec<usize> = (0..self.detections.len())
            .filter(|&d| {
                let detection = &self.detections[d];
                !detection_taken[d] && detection.score >= config.score && !covered(&detection.bbox)
            })
            .collect();
        // Ids follow the boxes, not the detector's order.
        births.sort_by(|&a, &b| {
            let key =
                |i: usize| (-self.detections[i].score, self.detections[i].bbox.x, self.detections[i].bbox.y);
            let (a, b) = (key(a), key(b));
            a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.total_cmp(&b.2))
        });
        births
    }

    fn learn_appearance(&mut self, m: &Match) {
        let Some(Some(seen)) = self.embeddings.get(m.detection) else { return };
        let config = &self.config.appearance;
        let bbox = self.detections[m.detection].bbox;
        let crowded = self
            .detections
            .iter()
            .enumerate()
            .any(|(i, other)| i != m.detection && other.bbox.iou(&bbox) > config.max_overlap);
        match &mut self.tracks[m.track].appearance {
            Some(_) if crowded => {}
            Some(mean) => mean.blend(seen, config.learning_rate),
            none => *none = Some(seen.clone()),
        }
    }
}

fn report(track: &Tracklet, shown: bool) -> TrackReport {
    let [vx, vy, ..] = track.filter.velocity();
    TrackReport {
        id: track.id,
        state: track.state(shown),
        class: track.class,
        bbox: track.bbox(),
        confidence: track.last().score,
        link: if track.matched { track.link } else { 0.0 },
        velocity: [vx, vy],
        matched: track.matched,
    }
}
