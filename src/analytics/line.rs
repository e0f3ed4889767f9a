//! Counting who crosses a line.

use std::collections::BTreeMap;

use super::geometry::{Point, crossings, distance_to_path};
use super::rules::Line;
use super::{Happening, Seen, What};
use crate::types::TrackId;

/// Which way a line is crossed, by one who looks along it from its first point to its last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From the left to the right.
    In,
    /// From the right to the left.
    Out,
}

impl Direction {
    /// The name on the wire.
    pub fn as_str(self) -> &'static str {
        match self {
            Direction::In => "in",
            Direction::Out => "out",
        }
    }
}

/// How often a line was crossed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LineCount {
    /// From left to right.
    pub inwards: u64,
    /// From right to left.
    pub outwards: u64,
}

#[derive(Debug)]
pub(super) struct LineWatch {
    rule: Line,
    /// In pixels.
    path: Vec<Point>,
    /// Where each track was when its side was last decided, pixels.
    settled: BTreeMap<TrackId, Point>,
    count: LineCount,
}

impl LineWatch {
    pub fn new(rule: Line, size: (u32, u32)) -> Self {
        let mut watch = Self { rule, path: vec![], settled: BTreeMap::new(), count: LineCount::default() };
        watch.resize(size);
        watch
    }

    pub fn rule(&self) -> &Line {
        &self.rule
    }

    pub fn count(&self) -> LineCount {
        self.count
    }

    /// Pictures have another size from now on. Nobody can tell where the tracks were in it.
    pub fn resize(&mut self, size: (u32, u32)) {
        self.path = self.rule.points.iter().map(|p| p.pixels(size)).collect();
        self.settled.clear();
    }

    /// Nobody is known any more.
    pub fn forget_tracks(&mut self) {
        self.settled.clear();
    }

    pub fn update(
        &mut self,
        seen: &[Seen],
        ended: &[TrackId],
        size: (u32, u32),
        happened: &mut Vec<Happening>,
    ) {
        for track in seen {
            let here = track.at(self.rule.anchor);
            // The first place decides, wherever it is.
            let before = self.settled.entry(track.id).or_insert(here);
            if !track.counts || distance_to_path(here, &self.path) < track.margin {
                continue;
            }
            let net = crossings(*before, here, &self.path);
            *before = here;
            let direction = match net {
                0 => continue,
                1.. => Direction::In,
                _ => Direction::Out,
            };
            match direction {
                Direction::In => self.count.inwards += 1,
                Direction::Out => self.count.outwards += 1,
            }
            happened.push(Happening {
                track: Some((track.id, track.class)),
                place: here.within(size),
                what: What::Crossed { line: self.rule.id.clone(), direction },
            });
        }
        for id in ended {
            self.settled.remove(id);
        }
    }
}
