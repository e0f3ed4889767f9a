//! Examples from the tracker driven by the truth.
//!
//! The tracker core predicts, gates and describes pairs as it does in the service; matches and
//! births come from the identities. Now and then a track loses its detections for a while though
//! they are there, so that every length of gap is seen: the detection it does not get stays a
//! positive.

use std::collections::BTreeMap;

use super::dataset::{LabelledFrame, LabelledSequence, Owner};
use super::examples::Examples;
use crate::track::{
    Decision, Features, FilterConfig, FrameInput, GateConfig, LinkRequest, Match, Tracker, TrackerConfig,
};
use crate::types::{Embedding, TrackId};

/// How pairs are made and chosen.
#[derive(Clone, Debug, PartialEq)]
pub struct Teacher {
    /// Chance, each frame, that a track begins to lose its detections.
    pub burst_chance: f64,
    /// Longest time that it loses them, s; short times are likelier (the time is this times `U^2`).
    pub burst_longest: f64,
    /// Share of easy positives that is kept: well overlapped, seen in the frame before.
    pub keep_easy: f64,
    /// Share of far negatives that is kept: outside the tracker's own gate.
    pub keep_far: f64,
    /// Bound on the weight of a kept example before its square root is taken.
    pub max_weight: f64,
    /// Least score of a detection.
    pub min_score: f64,
    /// Squared Mahalanobis distance of the gate, wider than the tracker's.
    pub mahalanobis: f64,
    /// The gate also takes pairs of at least this IoU.
    pub or_iou: f64,
    /// The gate also takes pairs whose centres are this near, heights.
    pub or_distance: f64,
    /// Whether false alarms make tracks too: pairs of those with people are negatives.
    pub false_tracks: bool,
    /// What the network reads.
    pub features: Features,
    /// Share of embeddings that it is not shown, so that it learns to do without.
    pub forget: f64,
    /// The filter that predicts: the one that the network will be used with.
    pub filter: FilterConfig,
}

impl Default for Teacher {
    fn default() -> Self {
        Self {
            burst_chance: 0.03,
            burst_longest: 1.5,
            keep_easy: 0.12,
            keep_far: 0.3,
            max_weight: 9.0,
            min_score: 0.4,
            mahalanobis: 20.0,
            or_iou: 0.1,
            or_distance: 0.5,
            false_tracks: false,
            features: Features::default(),
            forget: 0.1,
            filter: FilterConfig::default(),
        }
    }
}

impl Teacher {
    /// Every pair that the tracker itself would ask about, no lost detections, no choice: how pairs
    /// lie in the world.
    pub fn natural() -> Self {
        let gate = GateConfig::default();
        Self {
            burst_chance: 0.0,
            keep_easy: 1.0,
            keep_far: 1.0,
            forget: 0.0,
            min_score: 0.55,
            mahalanobis: gate.mahalanobis,
            or_iou: f64::INFINITY,
            or_distance: 0.0,
            ..Self::default()
        }
    }

    /// Adds the pairs of `sequence` to `examples`, which are of the teacher's features.
    pub fn collect(&self, sequence: &LabelledSequence, rng: &mut fastrand::Rng, examples: &mut Examples) {
        let config = self.tracker_config();
        let inner_gate = GateConfig::default().mahalanobis;
        let mut tracker = Tracker::new(config.clone());
        let mut request = LinkRequest::default();
        let mut identities: BTreeMap<TrackId, Option<i64>> = BTreeMap::new();
        let mut blind_until: BTreeMap<TrackId, f64> = BTreeMap::new();
        for frame in &sequence.frames {
            let usable: Vec<usize> = (0..frame.detections.len())
                .filter(|i| {
                    let d = &frame.detections[*i];
                    d.bbox.is_valid() && d.score >= self.min_score
                })
                .take(config.life.max_detections)
                .collect();
            let detections: Vec<_> = usable.iter().map(|i| frame.detections[*i]).collect();
            let owners: Vec<Owner> = usable.iter().map(|i| frame.owners[*i]).collect();
            let embeddings = self.embeddings(frame, &usable, rng);
            let (width, height) = (sequence.width, sequence.height);
            let input = FrameInput {
                time: frame.time,
                width,
                height,
                detections: &detections,
                embeddings: &embeddings,
                shift: None,
            };
            tracker.predict(input, &mut request);

            examples.push(&request, |index| {
                let pair = &tracker.pairs()[index];
                let track = &tracker.tracks()[pair.track];
                let identity = identities[&track.id];
                let label = match (identity, owners[pair.detection]) {
                    (Some(of), Owner::Of(owner)) => of == owner,
                    (Some(of), Owner::Near(owner)) if of == owner => return None,
                    (None, Owner::Near(_) | Owner::Nobody) => return None,
                    _ => false,
                };
                let fresh = track.missed_for() * sequence.frame_rate < 1.5;
                let keep = match label {
                    true if fresh && pair.geometry.iou > 0.6 => self.keep_easy,
                    false if pair.geometry.mahalanobis2 > inner_gate => self.keep_far,
                    _ => 1.0,
                };
                (rng.f64() < keep).then(|| (label, (1.0 / keep).min(self.max_weight).sqrt() as f32))
            });

            let seconds = frame.time.since(Default::default());
            let decision = self.decide(&tracker, &owners, &identities, |id| {
                let until = blind_until.entry(id).or_insert(f64::NEG_INFINITY);
                if *until < seconds && rng.f64() < self.burst_chance {
                    *until = seconds + self.burst_longest * rng.f64().powi(2);
                }
                seconds <= *until
            });
            let born: Vec<Option<i64>> = decision.births.iter().map(|d| identity(owners[*d])).collect();
            let before = tracker.tracks().last().map_or(0, |t| t.id.0);
            // The frame was predicted above, so there is one to apply a decision to.
            let Ok(update) = tracker.apply(&decision) else { return };
            for id in update.ended {
                identities.remove(&id);
                blind_until.remove(&id);
            }
            let newborn = tracker.tracks().iter().filter(|t| t.id.0 > before && t.hits == 1);
            for (track, identity) in newborn.rev().zip(born.iter().rev()) {
                identities.insert(track.id, *identity);
            }
        }
    }

    /// What the tracker is shown of the looks of the `usable` detections.
    fn embeddings(
        &self,
        frame: &LabelledFrame,
        usable: &[usize],
        rng: &mut fastrand::Rng,
    ) -> Vec<Option<Embedding>> {
        if !self.features.see_appearance() || frame.embeddings.is_empty() {
            return vec![];
        }
        usable.iter().map(|i| frame.embeddings[*i].clone().filter(|_| rng.f64() >= self.forget)).collect()
    }

    fn tracker_config(&self) -> TrackerConfig {
        let mut config = TrackerConfig { filter: self.filter, ..TrackerConfig::default() };
        config.gate.mahalanobis = self.mahalanobis;
        config.gate.or_iou = Some(self.or_iou);
        config.gate.or_distance = Some(self.or_distance);
        config.association.features = self.features;
        config.association.high_score = self.min_score;
        config.association.low_score = self.min_score;
        // Tracks that lose their detections on purpose must outlive it.
        config.life.confirm_hits = 1;
        config
    }

    fn decide(
        &self,
        tracker: &Tracker,
        owners: &[Owner],
        identities: &BTreeMap<TrackId, Option<i64>>,
        mut is_blind: impl FnMut(TrackId) -> bool,
    ) -> Decision {
        let mut decision = Decision::default();
        let mut taken = vec![false; owners.len()];
        for (track, tracklet) in tracker.tracks().iter().enumerate() {
            let found = match identities[&tracklet.id] {
                Some(of) => owners.iter().position(|o| *o == Owner::Of(of)),
                None => {
                    let overlap = |d: &usize| tracker.predicted()[track].iou(&tracker.detections()[*d].bbox);
                    let free = |d: &usize| !taken[*d] && identity(owners[*d]).is_none();
                    (0..owners.len())
                        .filter(free)
                        .max_by(|a, b| overlap(a).total_cmp(&overlap(b)))
                        .filter(|d| overlap(d) > 0.5)
                }
            };
            let blind = is_blind(tracklet.id);
            if let Some(detection) = found {
                // Also when it is blind: the same person must not be born a second time.
                taken[detection] = true;
                if !blind {
                    decision.matches.push(Match { track, detection, link: 1.0 });
                }
            }
        }
        let births = (0..owners.len()).filter(|d| !taken[*d]);
        decision.births = births.filter(|d| self.false_tracks || identity(owners[*d]).is_some()).collect();
        decision
    }
}

fn identity(owner: Owner) -> Option<i64> {
    match owner {
        Owner::Of(id) => Some(id),
        Owner::Near(_) | Owner::Nobody => None,
    }
}
