//! Who is in a zone, and for how long.

use std::collections::BTreeMap;

use super::geometry::{Point, along_edge, distance_to_sides, inside, middle, sides};
use super::rules::Zone;
use super::{Happening, Seen, What};
use crate::types::{ClassId, MediaTime, TrackId};

/// A zone is crowded, or no longer, once it has been so for this long, s.
const SETTLES: f64 = 1.0;

/// What a zone has counted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ZoneCount {
    /// How many are in it now.
    pub occupancy: u32,
    /// How many came in.
    pub entries: u64,
    /// How many left or ended in it.
    pub exits: u64,
    /// How long those who left were there, all together, s.
    pub dwell: f64,
    /// How long the one has been there who has been there longest, s.
    pub longest: f64,
    /// Whether more are in it than it allows.
    pub crowded: bool,
}

#[derive(Clone, Copy, Debug)]
struct Visit {
    class: ClassId,
    since: MediaTime,
    last: MediaTime,
    /// Fractions of the picture.
    place: Point,
    loitered: bool,
}

#[derive(Debug)]
pub(super) struct ZoneWatch {
    rule: Zone,
    /// In pixels.
    polygon: Vec<Point>,
    /// Its sides, in pixels, but for those along the picture's edge: nobody comes from behind that.
    borders: Vec<[Point; 2]>,
    visits: BTreeMap<TrackId, Visit>,
    count: ZoneCount,
    /// Since when the number of visitors has said otherwise than `count.crowded`.
    contradicted: Option<MediaTime>,
}

impl ZoneWatch {
    pub fn new(rule: Zone, size: (u32, u32)) -> Self {
        let (visits, count) = (BTreeMap::new(), ZoneCount::default());
        let mut watch = Self { rule, polygon: vec![], borders: vec![], visits, count, contradicted: None };
        watch.resize(size);
        watch
    }

    pub fn rule(&self) -> &Zone {
        &self.rule
    }

    /// The count at `now`.
    pub fn count(&self, now: Option<MediaTime>) -> ZoneCount {
        let longest = self.visits.values().filter_map(|v| Some(now?.since(v.since))).fold(0.0, f64::max);
        ZoneCount { occupancy: self.visits.len() as u32, longest, ..self.count }
    }

    /// Pictures have another size from now on; a zone is the same part of them.
    pub fn resize(&mut self, size: (u32, u32)) {
        self.polygon = self.rule.points.iter().map(|p| p.pixels(size)).collect();
        self.borders = sides(&self.rule.points)
            .filter(|side| !along_edge(side))
            .map(|side| side.map(|p| p.pixels(size)))
            .collect();
    }

    /// Nobody is known any more; who was in it has left, at a time that nobody knows.
    pub fn forget_tracks(&mut self) {
        self.count.exits += self.visits.len() as u64;
        self.visits.clear();
        self.count.crowded = false;
        self.contradicted = None;
    }

    pub fn update(
        &mut self,
        seen: &[Seen],
        ended: &[TrackId],
        now: MediaTime,
        size: (u32, u32),
        happened: &mut Vec<Happening>,
    ) {
        for track in seen.iter().filter(|track| track.counts) {
            let here = track.at(self.rule.anchor);
            let is_inside = inside(here, &self.polygon);
            let decided = distance_to_sides(here, &self.borders) >= track.margin;
            let place = here.within(size);
            match self.visits.get_mut(&track.id) {
                Some(visit) => {
                    if !is_inside && decided {
                        self.leave(track.id, happened);
                    } else {
                        (visit.last, visit.place) = (now, place);
                    }
                }
                None if is_inside && decided => {
                    let visit = Visit { class: track.class, since: now, last: now, place, loitered: false };
                    self.visits.insert(track.id, visit);
                    self.count.entries += 1;
                    let what = What::Entered { zone: self.rule.id.clone() };
                    happened.push(Happening { track: Some((track.id, track.class)), place, what });
                }
                None => {}
            }
        }
        for id in ended {
            self.leave(*id, happened);
        }
        self.look_for_loiterers(happened);
        self.look_for_crowd(now, happened);
    }

    fn leave(&mut self, id: TrackId, happened: &mut Vec<Happening>) {
        let Some(visit) = self.visits.remove(&id) else { return };
        let dwell = visit.last.since(visit.since);
        self.count.exits += 1;
        self.count.dwell += dwell;
        let what = What::Left { zone: self.rule.id.clone(), dwell };
        happened.push(Happening { track: Some((id, visit.class)), place: visit.place, what });
    }

    fn look_for_loiterers(&mut self, happened: &mut Vec<Happening>) {
        let Some(limit) = self.rule.loiter else { return };
        for (id, visit) in &mut self.visits {
            let dwell = visit.last.since(visit.since);
            if !visit.loitered && dwell > limit {
                visit.loitered = true;
                let what = What::Loitering { zone: self.rule.id.clone(), dwell };
                happened.push(Happening { track: Some((*id, visit.class)), place: visit.place, what });
            }
        }
    }

    fn look_for_crowd(&mut self, now: MediaTime, happened: &mut Vec<Happening>) {
        let Some(capacity) = self.rule.capacity else { return };
        let occupancy = self.visits.len() as u32;
        if (occupancy > capacity) == self.count.crowded {
            self.contradicted = None;
            return;
        }
        let since = *self.contradicted.get_or_insert(now);
        if now.since(since) < SETTLES {
            return;
        }
        self.contradicted = None;
        self.count.crowded = !self.count.crowded;
        let zone = self.rule.id.clone();
        let what = if self.count.crowded {
            What::Crowded { zone, occupancy }
        } else {
            What::Cleared { zone, occupancy }
        };
        happened.push(Happening { track: None, place: middle(&self.rule.points), what });
    }
}
