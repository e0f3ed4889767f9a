//! The camera: from metres to pixels, and who covers whom.

use super::Drift;
use super::street::Person;
use crate::types::BBox;

/// A person as the camera sees it.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Identity.
    pub id: i64,
    /// The whole person, whatever covers it; at least a part lies in the picture.
    pub bbox: BBox,
    /// Share of the box that is in the picture and that nobody nearer covers.
    pub visible: f64,
}

/// A pinhole camera above the ground that looks a little down.
pub struct Camera {
    size: (f64, f64),
    /// Focal length, pixels.
    focal: f64,
    /// Height above the ground, m.
    above: f64,
    /// Row of the horizon.
    horizon: f64,
    /// The ground that people walk on: nearest and farthest, m.
    depth: (f64, f64),
    /// How far it swings, in widths of the picture, and how long a swing takes, s.
    pan: (f64, f64),
    /// How much it shakes, in heights of the picture.
    shake: f64,
    drifts: [Drift; 4],
    offset: (f64, f64),
}

impl Camera {
    /// A camera of a picture of `size` pixels; a third of them move.
    pub fn new(size: (f64, f64), rng: &mut fastrand::Rng) -> Self {
        let moves = rng.f64() < 0.35;
        let above = 1.5 + 4.5 * rng.f64();
        let horizon = size.1 * (if above < 2.5 { 0.3 } else { 0.05 } + 0.2 * rng.f64());
        let focal = size.0 * (0.6 + 0.7 * rng.f64());
        // The nearest has its feet at the lower border.
        let nearest = (focal * above / (size.1 - horizon)).max(3.0);
        Self {
            size,
            focal,
            above,
            horizon,
            depth: (nearest, nearest * (2.5 + 2.5 * rng.f64())),
            pan: (if moves { 0.3 * rng.f64() } else { 0.0 }, 3.0 + 10.0 * rng.f64()),
            shake: if moves { 0.006 * rng.f64() } else { 0.0 },
            drifts: [0; 4].map(|_| Drift::new(rng)),
            offset: (0.0, 0.0),
        }
    }

    /// Width and height of the picture, pixels.
    pub fn size(&self) -> (f64, f64) {
        self.size
    }

    /// `dt` seconds pass.
    pub fn step(&mut self, dt: f64, rng: &mut fastrand::Rng) {
        let [pan, slow, x, y] = &mut self.drifts;
        // The mean of a drift over time is smooth: a hand does not jump.
        slow.0 += (pan.step(dt, self.pan.1, rng) - slow.0) * dt;
        let shake = self.shake * self.size.1;
        let pan = self.pan.0 * self.size.0 * slow.0;
        self.offset = (pan + shake * x.step(dt, 0.2, rng), shake * y.step(dt, 0.2, rng));
    }

    fn project(&self, [right, away]: [f64; 2]) -> (f64, f64, f64) {
        let scale = self.focal / away;
        let (dx, dy) = self.offset;
        (self.size.0 / 2.0 + right * scale + dx, self.horizon + self.above * scale + dy, scale)
    }

    /// Half of the width of the ground in view at a depth, and a margin for what a pan shows, m.
    fn reach(&self, away: f64) -> f64 {
        away * self.size.0 * (0.5 + self.pan.0) / self.focal + 1.0
    }

    /// Whether somebody there may still come into the picture.
    pub fn in_reach(&self, [right, away]: [f64; 2]) -> bool {
        (self.depth.0 - 1.0..=self.depth.1 + 1.0).contains(&away) && right.abs() <= self.reach(away)
    }

    /// Somewhere on the ground.
    pub fn random_place(&self, rng: &mut fastrand::Rng) -> [f64; 2] {
        let away = self.depth.0 + (self.depth.1 - self.depth.0) * rng.f64();
        [self.reach(away) * (2.0 * rng.f64() - 1.0), away]
    }

    /// A place at the border of the ground, and a direction into it.
    pub fn random_entry(&self, rng: &mut fastrand::Rng) -> ([f64; 2], f64) {
        let [right, away] = self.random_place(rng);
        let at = match rng.usize(..4) {
            0 => [right, self.depth.1],
            1 => [right, self.depth.0],
            2 => [self.reach(away), away],
            _ => [-self.reach(away), away],
        };
        let middle = [0.0, 0.5 * (self.depth.0 + self.depth.1)];
        let inwards = (middle[1] - at[1]).atan2(middle[0] - at[0]);
        (at, inwards + (rng.f64() - 0.5) * 2.0)
    }

    /// Whom it sees, in no order that tells anything.
    pub fn look(&self, people: &[Person]) -> Vec<Seen> {
        let (width, height) = self.size;
        let mut all: Vec<(f64, i64, BBox)> = people
            .iter()
            .map(|p| {
                let (x, foot, scale) = self.project(p.at);
                let h = p.height * scale;
                // Legs and arms swing with the steps.
                let w = h * (0.34 + 0.07 * p.gait.sin().abs() * (p.speed / 1.3).min(1.5));
                (p.at[1], p.id, BBox::new(x - w / 2.0, foot - h, w, h))
            })
            .collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut seen = vec![];
        for (i, (_, id, bbox)) in all.iter().enumerate() {
            let Some(inside) = bbox.clipped(width, height) else { continue };
            let visible = visible_share(bbox, &inside, &all[..i]);
            if inside.area() > 0.1 * bbox.area() {
                seen.push(Seen { id: *id, bbox: *bbox, visible });
            }
        }
        seen.sort_by_key(|s| s.id);
        seen
    }
}

/// Share of `bbox` that is inside the picture and not behind `nearer`, on a grid of points; people fill
/// about the middle of their boxes.
fn visible_share(bbox: &BBox, inside: &BBox, nearer: &[(f64, i64, BBox)]) -> f64 {
    const GRID: (usize, usize) = (4, 10);
    let covering: Vec<BBox> = nearer
        .iter()
        .map(|(.., b)| BBox::new(b.x + 0.1 * b.w, b.y, 0.8 * b.w, b.h))
        .filter(|b| b.intersection(bbox) > 0.0)
        .collect();
    let within = |b: &BBox, x: f64, y: f64| x >= b.x && x <= b.right() && y >= b.y && y <= b.bottom();
    let mut free = 0;
    for i in 0..GRID.0 {
        for j in 0..GRID.1 {
            let x = bbox.x + bbox.w * (i as f64 + 0.5) / GRID.0 as f64;
            let y = bbox.y + bbox.h * (j as f64 + 0.5) / GRID.1 as f64;
            free += usize::from(within(inside, x, y) && !covering.iter().any(|b| within(b, x, y)));
        }
    }
    free as f64 / (GRID.0 * GRID.1) as f64
}
