//! Lines, zones and masks as they are drawn: in fractions of the picture, so that they survive another resolution.

use std::fmt;
use std::sync::Arc;

use super::geometry::{Point, area};
use crate::types::is_name;

/// Lines, and likewise zones and masks, that one camera takes.
pub const MAX_RULES: usize = 32;
/// Points of one line, zone or mask at most.
const MAX_POINTS: usize = 32;
/// A zone or mask covers at least this share of the picture.
const LEAST_AREA: f64 = 1e-4;
/// A line is at least so long, in fractions of the picture.
const LEAST_LENGTH: f64 = 0.01;

/// The name of a line, zone or mask: 1 to 64 of `A-Z a-z 0-9 . _ -`, so that it fits a URL and a metric label.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RuleId(Arc<str>);

impl RuleId {
    /// Checks and takes a name.
    ///
    /// # Errors
    /// [`RuleError::Name`].
    pub fn new(name: &str) -> Result<Self, RuleError> {
        if is_name(name) {
            Ok(Self(name.into()))
        } else {
            Err(RuleError::Name(name.chars().take(80).collect()))
        }
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for RuleId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What of a box is held against lines and zones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Anchor {
    /// The middle of its lower edge: where a person stands.
    #[default]
    Foot,
    /// Its centre: for cameras that look straight down, or see only heads.
    Centre,
}

/// A line that tracks cross: from its first point to its last.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Its name.
    pub id: RuleId,
    /// 2 to 32 points, in fractions of the picture.
    pub points: Vec<Point>,
    /// What of a box crosses it.
    pub anchor: Anchor,
}

/// A zone that tracks are in or not.
#[derive(Clone, Debug, PartialEq)]
pub struct Zone {
    /// Its name.
    pub id: RuleId,
    /// 3 to 32 corners, in fractions of the picture; the last is joined to the first.
    pub points: Vec<Point>,
    /// What of a box is in it.
    pub anchor: Anchor,
    /// Who stays longer loiters, s.
    pub loiter: Option<f64>,
    /// More than so many are a crowd.
    pub capacity: Option<u32>,
}

/// How a mask hides what is under it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MaskStyle {
    /// Black: nothing of it is left.
    #[default]
    Fill,
    /// Coarse blocks of the mean colour: one sees that something moves, not who.
    Pixelate,
}

/// A part of the picture that nobody is to see. Tracks under it are tracked all the same.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    /// Its name.
    pub id: RuleId,
    /// 3 to 32 corners, in fractions of the picture; the last is joined to the first.
    pub points: Vec<Point>,
    /// How it hides.
    pub style: MaskStyle,
}

/// What is drawn on a camera.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rules {
    /// Lines, names differ.
    pub lines: Vec<Line>,
    /// Zones, names differ.
    pub zones: Vec<Zone>,
    /// Masks, names differ.
    pub masks: Vec<Mask>,
}

/// Why a line or a zone cannot be watched.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RuleError {
    /// The name is none.
    #[error(
        "the name {0:?} is not usable: use 1 to 64 of A-Z a-z 0-9 . _ - and begin with a letter or digit"
    )]
    Name(String),
    /// Too few points, or too many.
    #[error("{id} has {got} points: a line has 2 to {MAX_POINTS}, a zone or mask 3 to {MAX_POINTS}")]
    PointCount {
        /// Whose.
        id: RuleId,
        /// How many.
        got: usize,
    },
    /// A point outside the picture.
    #[error("point {index} of {id} is ({x}, {y}): both numbers are fractions of the picture, from 0 to 1")]
    Outside {
        /// Whose.
        id: RuleId,
        /// Which, from 0.
        index: usize,
        /// As given.
        x: f64,
        /// As given.
        y: f64,
    },
    /// Too small to be crossed or entered.
    #[error(
        "{id} is too small: a line is at least 0.01 of the picture long, a zone or mask at least 0.0001 of it large"
    )]
    Small {
        /// Which.
        id: RuleId,
    },
    /// A limit that is none.
    #[error("{id}: {what}")]
    Limit {
        /// Which.
        id: RuleId,
        /// What is wrong.
        what: &'static str,
    },
    /// Two of the same name.
    #[error("two {what}s are named {id}: names must differ")]
    Twice {
        /// `line`, `zone` or `mask`.
        what: &'static str,
        /// The name.
        id: RuleId,
    },
    /// Too many.
    #[error("{got} {what}s: a camera takes at most {MAX_RULES}")]
    TooMany {
        /// `line`, `zone` or `mask`.
        what: &'static str,
        /// How many.
        got: usize,
    },
}

impl Rules {
    /// Whether all of it can be watched.
    ///
    /// # Errors
    /// [`RuleError`], of the first that cannot.
    pub fn check(&self) -> Result<(), RuleError> {
        for (what, ids) in [
            ("line", self.lines.iter().map(|l| &l.id).collect::<Vec<_>>()),
            ("zone", self.zones.iter().map(|z| &z.id).collect()),
            ("mask", self.masks.iter().map(|m| &m.id).collect()),
        ] {
            if ids.len() > MAX_RULES {
                return Err(RuleError::TooMany { what, got: ids.len() });
            }
            if let Some((_, id)) = ids.iter().enumerate().find(|(at, id)| ids[..*at].contains(id)) {
                return Err(RuleError::Twice { what, id: (*id).clone() });
            }
        }
        for Line { id, points, .. } in &self.lines {
            check_points(id, points, 2)?;
            let length: f64 = points.windows(2).map(|s| (s[1].x - s[0].x).hypot(s[1].y - s[0].y)).sum();
            if length < LEAST_LENGTH {
                return Err(RuleError::Small { id: id.clone() });
            }
        }
        for Zone { id, points, loiter, .. } in &self.zones {
            check_points(id, points, 3)?;
            if area(points) < LEAST_AREA {
                return Err(RuleError::Small { id: id.clone() });
            }
            if loiter.is_some_and(|s| !(s.is_finite() && s > 0.0)) {
                return Err(RuleError::Limit { id: id.clone(), what: "loiter_s must be more than 0" });
            }
        }
        for Mask { id, points, .. } in &self.masks {
            check_points(id, points, 3)?;
            if area(points) < LEAST_AREA {
                return Err(RuleError::Small { id: id.clone() });
            }
        }
        Ok(())
    }
}

fn check_points(id: &RuleId, points: &[Point], least: usize) -> Result<(), RuleError> {
    if !(least..=MAX_POINTS).contains(&points.len()) {
        return Err(RuleError::PointCount { id: id.clone(), got: points.len() });
    }
    // A number that is not finite is in no range.
    let inside = |v: f64| (0.0..=1.0).contains(&v);
    match points.iter().enumerate().find(|(_, p)| !(inside(p.x) && inside(p.y))) {
        Some((index, &Point { x, y })) => Err(RuleError::Outside { id: id.clone(), index, x, y }),
        None => Ok(()),
    }
}
