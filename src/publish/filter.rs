//! What of the reports a subscriber wants: tracks by class, state and confidence, and how often.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::Report;
use crate::types::{CameraId, ClassId, Epoch, FrameTracks, MediaTime, TrackId, TrackReport, TrackState};

/// Which tracks, and how often. Empty sets mean all.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrackFilter {
    /// Of these classes.
    pub classes: BTreeSet<ClassId>,
    /// In these states.
    pub states: BTreeSet<TrackState>,
    /// Whose last detection scored at least this.
    pub min_confidence: f64,
    /// At most so many reports of a camera per second of its own time.
    pub rate: Option<f64>,
}

impl TrackFilter {
    fn wants(&self, track: &TrackReport) -> bool {
        (self.classes.is_empty() || self.classes.contains(&track.class))
            && (self.states.is_empty() || self.states.contains(&track.state))
            && (self.min_confidence <= 0.0 || track.confidence >= self.min_confidence)
    }

    fn wants_all_tracks(&self) -> bool {
        self.classes.is_empty() && self.states.is_empty() && self.min_confidence <= 0.0
    }
}

/// What is left of a report.
#[derive(Clone, Debug)]
pub enum Sifted {
    /// All of it; its encoded form is shared with the other subscribers.
    Whole(Arc<Report>),
    /// A part.
    Part(FrameTracks),
}

/// Sifts one subscriber's reports.
#[derive(Debug, Default)]
pub struct Sieve {
    filter: TrackFilter,
    cameras: BTreeMap<CameraId, Passed>,
}

/// What passed of a camera.
#[derive(Debug)]
struct Passed {
    epoch: Epoch,
    /// From when on the next report passes.
    next: MediaTime,
    /// Tracks that ended in reports that did not pass.
    ended: Vec<TrackId>,
}

impl Sieve {
    /// A sieve.
    pub fn new(filter: TrackFilter) -> Self {
        Self { filter, cameras: BTreeMap::new() }
    }

    /// What the subscriber gets of the next report; `None` when it comes too soon after the last one. Ends of
    /// tracks are never lost: those of reports that did not pass come with the next that does.
    pub fn sift(&mut self, report: Arc<Report>) -> Option<Sifted> {
        let mut ended = vec![];
        if let Some(rate) = self.filter.rate {
            let tracks = &*report.tracks;
            let passed = self.cameras.entry(tracks.camera.clone()).or_insert_with(|| Passed {
                epoch: tracks.epoch,
                next: tracks.time,
                ended: vec![],
            });
            if passed.epoch != tracks.epoch {
                // Another time line, other ids.
                *passed = Passed { epoch: tracks.epoch, next: tracks.time, ended: vec![] };
            }
            if tracks.time < passed.next {
                passed.ended.extend(&tracks.ended);
                return None;
            }
            // In step with the rate, not with the frames; after a hole from now on.
            let interval = (1e9 / rate) as i64;
            let due = passed.next.0.saturating_add(interval);
            passed.next =
                MediaTime(if due > tracks.time.0 { due } else { tracks.time.0.saturating_add(interval) });
            ended = std::mem::take(&mut passed.ended);
        }
        if ended.is_empty() && self.filter.wants_all_tracks() {
            return Some(Sifted::Whole(report));
        }
        let mut part = FrameTracks::clone(&report.tracks);
        part.tracks.retain(|track| self.filter.wants(track));
        ended.append(&mut part.ended);
        part.ended = ended;
        Some(Sifted::Part(part))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::publish::report::tests::example;

    fn report(ms: i64, epoch: u64, ended: &[u64]) -> Arc<Report> {
        let (mut tracks, classes) = example();
        tracks.time = MediaTime(ms * 1_000_000);
        tracks.epoch = Epoch(epoch);
        tracks.ended = ended.iter().map(|id| TrackId(*id)).collect();
        Arc::new(Report::new(Arc::new(tracks), classes.into()))
    }

    #[test]
    fn tracks_are_chosen_by_class_state_and_confidence() {
        for (filter, expected) in [
            (TrackFilter { classes: [ClassId(0)].into(), ..TrackFilter::default() }, vec![3]),
            (TrackFilter { states: [TrackState::Lost].into(), ..TrackFilter::default() }, vec![4]),
            // A score that is no number is none.
            (TrackFilter { min_confidence: 0.5, ..TrackFilter::default() }, vec![3]),
            (TrackFilter { min_confidence: 0.95, ..TrackFilter::default() }, vec![]),
        ] {
            let Some(Sifted::Part(part)) = Sieve::new(filter.clone()).sift(report(0, 1, &[1])) else {
                panic!("{filter:?}")
            };
            assert_eq!(part.tracks.iter().map(|t| t.id.0).collect::<Vec<_>>(), expected, "{filter:?}");
            assert_eq!(part.ended, [TrackId(1)]);
        }
        let whole = Sieve::default().sift(report(0, 1, &[]));
        assert!(matches!(whole, Some(Sifted::Whole(_))), "shared where nothing is left out");
    }

    #[test]
    fn a_rate_holds_on_average_and_loses_no_end() {
        let mut sieve = Sieve::new(TrackFilter { rate: Some(10.0), ..TrackFilter::default() });
        let (mut passed, mut ended) = (0, vec![]);
        // 25 frames a second for ten seconds, a track ends in each.
        for frame in 0..250 {
            match sieve.sift(report(frame * 40, 1, &[frame as u64])) {
                Some(Sifted::Whole(report)) => {
                    passed += 1;
                    ended.extend(report.tracks.ended.iter().map(|id| id.0));
                }
                Some(Sifted::Part(part)) => {
                    passed += 1;
                    ended.extend(part.ended.iter().map(|id| id.0));
                }
                None => {}
            }
        }
        assert_eq!(passed, 100);
        assert_eq!(ended, (0..=ended.len() as u64 - 1).collect::<Vec<_>>());
        assert!(sieve.sift(report(9_970, 2, &[])).is_some(), "another epoch begins at once");
    }
}
