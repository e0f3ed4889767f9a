//! Tracks to what a shop or a guard asks: who crossed a line, who is in a zone and for how long, where people go.
//!
//! ```text
//! rules (fractions of the picture) + a frame's tracks -> happenings, counts, heat
//! ```
//!
//! Pure, like the tracking core: no clock, no file; [`Analyst::update`] is one frame. What counts:
//!
//! - A track counts once it is confirmed, from the place of its birth on; before that it does nothing, and one
//!   that never is confirmed counts nowhere.
//! - Only frames in which it was matched count: a predicted box crosses no line. Someone who was covered
//!   while crossing is counted when found again on the other side, which takes [`FOUND_AGAIN`] matches: one match
//!   after a gap may be a false alarm that a lost track has run into.
//! - A place near a line or a zone's border decides nothing: within [`MARGIN`] heights of it a track stays on the
//!   side where it was, so that a trembling box is no crowd.

mod geometry;
mod heat;
mod line;
mod rules;
mod zone;

use std::collections::BTreeMap;

pub use geometry::Point;
pub use heat::{HEAT_COLUMNS, HEAT_ROWS, Heat};
pub use line::{Direction, LineCount};
pub use rules::{Anchor, Line, MAX_RULES, Mask, MaskStyle, RuleError, RuleId, Rules, Zone};
pub use zone::ZoneCount;

use crate::types::{ClassId, FrameTracks, MediaTime, TrackId, TrackState};
use line::LineWatch;
use zone::ZoneWatch;

/// Within this many heights of its box from a line or border, a track's side is undecided.
pub const MARGIN: f64 = 0.05;

/// A track that was not matched for longer than this, s, and in more than one frame, has to be found again.
const GAP: f64 = 0.3;

/// Matches that it takes to be found again.
pub const FOUND_AGAIN: u32 = 3;

/// Longest time between two frames that counts as presence, s; a longer one is a hole in the video.
const LONGEST_STEP: f64 = 1.0;

/// Something that happened at a line or in a zone.
#[derive(Clone, Debug, PartialEq)]
pub struct Happening {
    /// Who; `None` for what concerns a zone as a whole.
    pub track: Option<(TrackId, ClassId)>,
    /// Where, as fractions of the picture; the zone's centre where it concerns the zone.
    pub place: Point,
    /// What.
    pub what: What,
}

/// What happened.
#[derive(Clone, Debug, PartialEq)]
pub enum What {
    /// A track crossed a line.
    Crossed {
        /// Which.
        line: RuleId,
        /// Which way.
        direction: Direction,
    },
    /// A track came into a zone.
    Entered {
        /// Which.
        zone: RuleId,
    },
    /// A track left a zone, or ended in it.
    Left {
        /// Which.
        zone: RuleId,
        /// How long it was there, until it was last seen, s.
        dwell: f64,
    },
    /// A track has been in a zone for longer than the zone allows; once a visit.
    Loitering {
        /// Which.
        zone: RuleId,
        /// How long it has been there, s.
        dwell: f64,
    },
    /// More are in a zone than it allows.
    Crowded {
        /// Which.
        zone: RuleId,
        /// How many.
        occupancy: u32,
    },
    /// No longer.
    Cleared {
        /// Which.
        zone: RuleId,
        /// How many.
        occupancy: u32,
    },
}

/// What a camera's rules have counted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Counts {
    /// Each line.
    pub lines: BTreeMap<RuleId, LineCount>,
    /// Each zone.
    pub zones: BTreeMap<RuleId, ZoneCount>,
}

/// A track as the rules see it in one frame.
#[derive(Clone, Copy, Debug)]
struct Seen {
    id: TrackId,
    class: ClassId,
    /// Foot and centre of its box, pixels.
    foot: Point,
    centre: Point,
    /// Undecided within this distance, pixels.
    margin: f64,
    /// Whether it counts, or only its first place is kept.
    counts: bool,
}

impl Seen {
    fn at(&self, anchor: Anchor) -> Point {
        match anchor {
            Anchor::Foot => self.foot,
            Anchor::Centre => self.centre,
        }
    }
}

/// Watches one camera's tracks.
#[derive(Debug, Default)]
pub struct Analyst {
    rules: Rules,
    size: (u32, u32),
    time: Option<MediaTime>,
    lines: Vec<LineWatch>,
    zones: Vec<ZoneWatch>,
    heat: Heat,
    /// Matches of each track since it was last lost, and when the last of them was.
    streaks: BTreeMap<TrackId, (u32, MediaTime)>,
}

impl Analyst {
    /// A watcher of `rules`.
    pub fn new(rules: Rules) -> Self {
        let mut analyst = Self::default();
        analyst.set_rules(rules);
        analyst
    }

    /// Watches other rules from now on. What did not change keeps its counts and its state.
    pub fn set_rules(&mut self, rules: Rules) {
        let mut lines = std::mem::take(&mut self.lines);
        let mut zones = std::mem::take(&mut self.zones);
        let kept_line = |line: &Line, from: &mut Vec<LineWatch>| {
            let at = from.iter().position(|watch| watch.rule() == line)?;
            Some(from.swap_remove(at))
        };
        let kept_zone = |zone: &Zone, from: &mut Vec<ZoneWatch>| {
            let at = from.iter().position(|watch| watch.rule() == zone)?;
            Some(from.swap_remove(at))
        };
        let size = self.size;
        self.lines = { rules.lines.iter() }
            .map(|line| kept_line(line, &mut lines).unwrap_or_else(|| LineWatch::new(line.clone(), size)))
            .collect();
        self.zones = { rules.zones.iter() }
            .map(|zone| kept_zone(zone, &mut zones).unwrap_or_else(|| ZoneWatch::new(zone.clone(), size)))
            .collect();
        self.rules = rules;
    }

    /// The tracks begin anew, with ids of their own; what was counted stays.
    pub fn begin_epoch(&mut self) {
        self.time = None;
        self.streaks.clear();
        self.lines.iter_mut().for_each(LineWatch::forget_tracks);
        self.zones.iter_mut().for_each(ZoneWatch::forget_tracks);
    }

    /// The rules.
    pub fn rules(&self) -> &Rules {
        &self.rules
    }

    /// Takes the next frame's tracks; gives what happened, lines first, each in the order of the rules.
    pub fn update(&mut self, report: &FrameTracks) -> Vec<Happening> {
        let size = (report.width, report.height);
        if size != self.size {
            self.size = size;
            self.lines.iter_mut().for_each(|line| line.resize(size));
            self.zones.iter_mut().for_each(|zone| zone.resize(size));
        }
        let interval = self.time.map_or(0.0, |last| report.time.since(last).max(0.0));
        let step = interval.min(LONGEST_STEP);
        self.time = Some(report.time);
        let seen: Vec<Seen> = { report.tracks.iter() }
            .filter(|track| track.matched)
            .map(|track| {
                let bbox = &track.bbox;
                let (matches, last) = self.streaks.entry(track.id).or_insert((0, report.time));
                let lost = report.time.since(*last) > GAP.max(1.5 * interval);
                *matches = if lost { 1 } else { *matches + 1 };
                *last = report.time;
                Seen {
                    id: track.id,
                    class: track.class,
                    foot: Point { x: bbox.cx(), y: bbox.bottom() },
                    centre: Point { x: bbox.cx(), y: bbox.cy() },
                    margin: MARGIN * bbox.h,
                    counts: track.state == TrackState::Confirmed && *matches >= FOUND_AGAIN,
                }
            })
            .collect();
        for id in &report.ended {
            self.streaks.remove(id);
        }
        for track in seen.iter().filter(|track| track.counts) {
            self.heat.add(track.foot.within(size), step);
        }
        let mut happened = vec![];
        for line in &mut self.lines {
            line.update(&seen, &report.ended, size, &mut happened);
        }
        for zone in &mut self.zones {
            zone.update(&seen, &report.ended, report.time, size, &mut happened);
        }
        happened
    }

    /// What was counted so far.
    pub fn counts(&self) -> Counts {
        Counts {
            lines: self.lines.iter().map(|line| (line.rule().id.clone(), line.count())).collect(),
            zones: self.zones.iter().map(|zone| (zone.rule().id.clone(), zone.count(self.time))).collect(),
        }
    }

    /// Where people were.
    pub fn heat(&self) -> &Heat {
        &self.heat
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
