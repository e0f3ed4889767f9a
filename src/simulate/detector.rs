//! The detector: whom it misses, where it errs, what it imagines.

use std::collections::BTreeMap;

use super::camera::Seen;
use super::{Drift, normal};
use crate::types::BBox;

/// How long a whim of the detector about one person lasts, s.
const WHIM: f64 = 0.8;
/// How long an error of place or size lasts, s.
const ERROR: f64 = 0.4;
/// Overlap from which only the better of two boxes stays.
const SUPPRESSED: f64 = 0.6;

/// A detector; how good it is is a matter of its seed.
pub struct Detector {
    /// Log-odds of seeing a tall person in the open.
    skill: f64,
    /// Log-odds lost by one who is covered altogether.
    cover: f64,
    /// Height at which half of that skill is gone, pixels.
    small: f64,
    /// Spread of its whims, in log-odds.
    whims: f64,
    /// Standard deviation of errors that last and of errors from frame to frame, in heights.
    errors: (f64, f64),
    /// Imagined people a frame.
    false_alarms: f64,
    moods: BTreeMap<i64, Mood>,
    ghosts: Vec<Ghost>,
}

/// What it makes of one person.
struct Mood {
    whim: Drift,
    errors: [Drift; 4],
}

/// Something that is taken for a person.
struct Ghost {
    bbox: BBox,
    /// Seconds that it is still seen.
    left: f64,
}

impl Detector {
    /// A detector between a poor one and a good one.
    pub fn new(rng: &mut fastrand::Rng) -> Self {
        let quality = rng.f64();
        Self {
            skill: -0.3 + 2.8 * quality,
            cover: 7.0 - 2.0 * quality,
            small: 60.0 - 40.0 * quality,
            whims: 1.5,
            errors: (0.02 + 0.04 * rng.f64(), 0.008 + 0.02 * rng.f64()),
            false_alarms: 0.5 * (1.0 - quality) * rng.f64() + 0.05,
            moods: BTreeMap::new(),
            ghosts: vec![],
        }
    }

    /// Boxes and scores of a frame, `dt` seconds after the last one.
    pub fn detect(
        &mut self,
        seen: &[Seen],
        size: (f64, f64),
        dt: f64,
        rng: &mut fastrand::Rng,
    ) -> Vec<(BBox, f64)> {
        self.moods.retain(|id, _| seen.iter().any(|s| s.id == *id));
        let mut found = vec![];
        for person in seen {
            let mood = self
                .moods
                .entry(person.id)
                .or_insert_with(|| Mood { whim: Drift::new(rng), errors: [0; 4].map(|_| Drift::new(rng)) });
            let h = person.bbox.h;
            let size_matters = 2.0 * (h / self.small).ln().min(0.7);
            let logit = self.skill - self.cover * (1.0 - person.visible)
                + size_matters
                + self.whims * mood.whim.step(dt, WHIM, rng)
                + 0.5 * normal(rng);
            let (lasting, fresh) = self.errors;
            // Whoever is half covered is hard to place.
            let harder = 1.0 + 1.5 * (1.0 - person.visible);
            let mut error = mood
                .errors
                .each_mut()
                .map(|drift| harder * h * (lasting * drift.step(dt, ERROR, rng) + fresh * normal(rng)));
            // Widths err less than heights do.
            error[2] *= 0.6;
            let b = person.bbox;
            let (w, h) = ((b.w + error[2]).max(4.0), (b.h + error[3]).max(8.0));
            let bbox = BBox::from_center(b.cx() + 0.7 * error[0], b.cy() + 0.7 * error[1], w, h);
            if logit > -1.5 {
                found.push((bbox, score(logit)));
            }
        }
        self.imagine(size, dt, rng, &mut found);
        suppress(found)
    }

    fn imagine(
        &mut self,
        (width, height): (f64, f64),
        dt: f64,
        rng: &mut fastrand::Rng,
        found: &mut Vec<(BBox, f64)>,
    ) {
        const MEAN: f64 = 0.5;
        self.ghosts.iter_mut().for_each(|g| g.left -= dt);
        self.ghosts.retain(|g| g.left > 0.0);
        if rng.f64() < self.false_alarms * dt / MEAN {
            let h = height * (0.05 + 0.4 * rng.f64() * rng.f64());
            let centre = (width * rng.f64(), height * (0.2 + 0.8 * rng.f64()));
            let bbox = BBox::from_center(centre.0, centre.1, 0.4 * h, h);
            self.ghosts.push(Ghost { bbox, left: -2.0 * MEAN * (1.0 - rng.f64()).ln() });
        }
        for Ghost { bbox, .. } in &self.ghosts {
            // Seen about every other frame.
            let logit = -0.5 + normal(rng);
            if logit > -0.5 {
                let mut error = || 0.02 * bbox.h * normal(rng);
                let (cx, cy) = (bbox.cx() + error(), bbox.cy() + error());
                found.push((BBox::from_center(cx, cy, bbox.w, bbox.h), score(logit + 0.5)));
            }
        }
    }
}

/// A score in `[0, 1]` of log-odds.
fn score(logit: f64) -> f64 {
    1.0 / (1.0 + (-(logit + 0.8)).exp())
}

/// Non-maximum suppression.
fn suppress(mut boxes: Vec<(BBox, f64)>) -> Vec<(BBox, f64)> {
    boxes.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.x.total_cmp(&b.0.x)));
    let mut kept: Vec<(BBox, f64)> = vec![];
    for (bbox, score) in boxes {
        if kept.iter().all(|(other, _)| other.iou(&bbox) < SUPPRESSED) {
            kept.push((bbox, score));
        }
    }
    kept
}
