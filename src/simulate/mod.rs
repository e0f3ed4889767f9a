//! A seeded world of pedestrians as MOTChallenge sequences: truth and detections that nobody holds rights to.
//!
//! ```text
//! street (metres) -> camera (pixels, occlusion) -> detector (misses, noise, false alarms) -> rows
//! ```
//!
//! People walk alone and in groups, stop, turn and leave; a camera looks at them from above, still, panning
//! or shaking; a detector misses the covered, the small and at times anybody, its errors last for several
//! frames. `gakp simulate` writes it, `gakp tune`, `train`, `track` and `eval` take it like any footage. The
//! same seed gives the same rows.

mod camera;
mod detector;
mod street;

use crate::mot::{Row, SequenceInfo};
use camera::Camera;
use detector::Detector;
use street::Street;

/// One sequence of the world.
#[derive(Clone, Debug, PartialEq)]
pub struct Simulated {
    /// Name, picture and rate.
    pub info: SequenceInfo,
    /// Truth: every person in the picture, with what part of it can be seen.
    pub truth: Vec<Row>,
    /// What a detector says.
    pub detections: Vec<Row>,
}

/// Standard normal.
fn normal(rng: &mut fastrand::Rng) -> f64 {
    // Box and Muller; 1 - U is never zero.
    (-2.0 * (1.0 - rng.f64()).ln()).sqrt() * (std::f64::consts::TAU * rng.f64()).cos()
}

/// A stationary random process of variance 1 whose memory fades with a time constant.
#[derive(Clone, Copy, Debug)]
struct Drift(f64);

impl Drift {
    fn new(rng: &mut fastrand::Rng) -> Self {
        Self(normal(rng))
    }

    /// Its value `dt` seconds later, `memory` being the time constant.
    fn step(&mut self, dt: f64, memory: f64, rng: &mut fastrand::Rng) -> f64 {
        let kept = (-dt / memory).exp();
        self.0 = kept * self.0 + (1.0 - kept * kept).sqrt() * normal(rng);
        self.0
    }
}

/// The sequence of `seed`, `seconds` long. The seed chooses everything: rate, picture, camera, crowd, and how good the
/// detector is.
pub fn simulate(name: &str, seconds: f64, seed: u64) -> Simulated {
    let mut rng = fastrand::Rng::with_seed(seed);
    let frame_rate = [10.0, 14.0, 20.0, 25.0, 30.0][rng.usize(..5)];
    let (width, height) = [(640, 480), (1280, 720), (1920, 1080)][rng.usize(..3)];
    let length = (seconds * frame_rate).round().max(1.0) as u32;
    let info = SequenceInfo { name: name.into(), frame_rate, length, width, height };
    let mut camera = Camera::new((f64::from(width), f64::from(height)), &mut rng);
    let mut street = Street::new(&camera, &mut rng);
    let mut detector = Detector::new(&mut rng);
    let (mut truth, mut detections) = (vec![], vec![]);
    for frame in 1..=length {
        let dt = 1.0 / frame_rate;
        camera.step(dt, &mut rng);
        street.step(dt, &camera, &mut rng);
        let seen = camera.look(street.people());
        for person in &seen {
            truth.push(Row {
                frame,
                id: person.id,
                bbox: person.bbox,
                conf: 1.0,
                class: Some(1),
                visibility: Some(person.visible),
            });
        }
        for (bbox, score) in detector.detect(&seen, camera.size(), dt, &mut rng) {
            let (class, visibility) = (None, None);
            detections.push(Row { frame, id: -1, bbox, conf: score, class, visibility });
        }
    }
    Simulated { info, truth, detections }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn the_same_seed_is_the_same_world_and_another_is_not() {
        let world = simulate("a", 5.0, 3);
        assert_eq!(world, simulate("a", 5.0, 3));
        assert_ne!(world.truth, simulate("a", 5.0, 4).truth);
    }

    #[test]
    fn people_move_as_people_do() {
        for seed in 0..12 {
            let world = simulate("a", 20.0, seed);
            let mut last: BTreeMap<i64, (u32, crate::types::BBox)> = BTreeMap::new();
            let (mut speeds, mut lives) = (vec![], BTreeMap::<i64, u32>::new());
            for row in &world.truth {
                assert!(row.bbox.is_valid() && row.visibility.is_some_and(|v| (0.0..=1.0).contains(&v)));
                *lives.entry(row.id).or_default() += 1;
                if let Some((frame, before)) = last.insert(row.id, (row.frame, row.bbox)) {
                    // Who has left the picture may come back into it.
                    if frame + 1 != row.frame {
                        continue;
                    }
                    let moved = (row.bbox.cx() - before.cx()).hypot(row.bbox.bottom() - before.bottom());
                    speeds.push(moved / row.bbox.h * world.info.frame_rate);
                }
            }
            speeds.sort_by(f64::total_cmp);
            let [median, most] = [speeds[speeds.len() / 2], speeds[speeds.len() * 99 / 100]];
            assert!(
                (0.1..1.5).contains(&median) && most < 6.0,
                "seed {seed}: {median} and {most} heights a second"
            );
            assert!(lives.len() > 3, "seed {seed}: {} people", lives.len());
        }
    }

    #[test]
    fn the_detector_finds_most_who_can_be_seen_and_few_who_cannot() {
        let (mut clear, mut covered, mut wrong, mut all) = ([0, 0], [0, 0], 0, 0);
        for seed in 0..12 {
            let world = simulate("a", 20.0, seed);
            let found = |row: &Row| {
                let of_frame = world.detections.iter().filter(|d| d.frame == row.frame);
                { of_frame }.any(|d| d.conf > 0.55 && d.bbox.iou(&row.bbox) > 0.5)
            };
            for row in &world.truth {
                let visible = row.visibility.unwrap_or(0.0);
                let count = if visible > 0.9 { &mut clear } else { &mut covered };
                if !(0.2..=0.9).contains(&visible) {
                    count[usize::from(found(row))] += 1;
                }
            }
            for d in &world.detections {
                all += 1;
                let near = world.truth.iter().filter(|t| t.frame == d.frame);
                wrong += usize::from(!{ near }.any(|t| t.bbox.iou(&d.bbox) > 0.3));
                assert!(d.bbox.is_valid() && (0.0..=1.0).contains(&d.conf));
            }
        }
        let share = |[missed, found]: [i32; 2]| f64::from(found) / f64::from(missed + found);
        assert!(share(clear) > 0.55 && share(clear) < 0.98, "{clear:?}");
        assert!(share(covered) < 0.35, "{covered:?}");
        let false_alarms = wrong as f64 / all as f64;
        assert!(false_alarms > 0.005 && false_alarms < 0.2, "{false_alarms}");
    }
}
