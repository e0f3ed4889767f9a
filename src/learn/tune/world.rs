//! A simulated world that obeys the filter's own model: the noise is known, and so is the truth.

use super::recording::{Person, Point, Recording};
use crate::learn::dataset::normal;
use crate::track::FilterConfig;
use crate::track::motion::{measurement_noise, motion};

/// People whose boxes move and are measured as a [`FilterConfig`] says.
#[derive(Clone, Debug, PartialEq)]
pub struct World {
    /// The noise.
    pub filter: FilterConfig,
    /// How many people.
    pub people: usize,
    /// How long each of them is seen, s.
    pub seconds: f64,
    /// Frames a second.
    pub frame_rate: f64,
    /// Chance, each frame, that a person is detected.
    pub detected: f64,
    /// Chance, each frame, that a person is not detected for up to a second.
    pub hidden: f64,
    /// Seed of everything random.
    pub seed: u64,
}

impl Default for World {
    fn default() -> Self {
        Self {
            filter: FilterConfig {
                centre_acceleration: 0.6,
                centre_walk: 0.15,
                centre_measurement: 0.04,
                size_acceleration: 0.08,
                size_walk: 0.06,
                size_measurement: 0.05,
                ..FilterConfig::default()
            },
            people: 400,
            seconds: 10.0,
            frame_rate: 25.0,
            detected: 0.9,
            hidden: 0.005,
            seed: 1,
        }
    }
}

/// A person ends when the box gets narrower than this, pixels.
const NARROWEST: f64 = 4.0;

impl World {
    /// Lets the world run.
    pub fn record(&self) -> Recording {
        let mut rng = fastrand::Rng::with_seed(self.seed);
        let frames = (self.seconds * self.frame_rate).round().max(1.0) as usize;
        let people = (0..self.people).map(|_| self.person(frames, &mut rng)).collect();
        Recording {
            name: "simulated".into(),
            group: "simulated".into(),
            times: (0..frames).map(|i| i as f64 / self.frame_rate).collect(),
            shifts: vec![[0.0; 2]; frames],
            people,
        }
    }

    fn person(&self, frames: usize, rng: &mut fastrand::Rng) -> Person {
        let dt = 1.0 / self.frame_rate;
        let height = 60.0 + 240.0 * rng.f64();
        let mut position = [1000.0 * rng.f64(), 500.0 * rng.f64(), 0.5 * height, height];
        let births = [self.filter.birth_centre_velocity, self.filter.birth_size_velocity];
        let mut velocity: [f64; 4] = std::array::from_fn(|i| births[i / 2] * height * normal(rng));
        let mut points = vec![];
        let mut hidden_until = 0.0;
        for frame in 0..frames {
            let time = frame as f64 * dt;
            if frame > 0 {
                let motion = motion(&self.filter, dt, position[3], 1.0);
                for i in 0..4 {
                    let [p, v] = draw(&motion[i].Q, rng);
                    let F = motion[i].F;
                    position[i] += F[(0, 1)] * velocity[i] + p;
                    velocity[i] = F[(1, 1)] * velocity[i] + v;
                }
            }
            if position[2] < NARROWEST || position[3] < NARROWEST {
                break;
            }
            if time >= hidden_until && rng.f64() < self.hidden {
                hidden_until = time + rng.f64();
            }
            // The first frame is a birth: a person begins by being seen.
            let seen = frame == 0 || (time >= hidden_until && rng.f64() < self.detected);
            let r = measurement_noise(&self.filter, position[3], 1.0);
            let noisy: [f64; 4] = std::array::from_fn(|i| position[i] + r[i].sqrt() * normal(rng));
            points.push(Point {
                measured: seen.then_some(noisy),
                truth: Some(position),
                velocity: Some(velocity),
            });
        }
        Person { first: 0, points }
    }
}

/// A draw of covariance `Q`, by its Cholesky factor.
fn draw(Q: &nalgebra::Matrix2<f64>, rng: &mut fastrand::Rng) -> [f64; 2] {
    let a = Q[(0, 0)].sqrt();
    let b = if a > 0.0 { Q[(0, 1)] / a } else { 0.0 };
    let c = (Q[(1, 1)] - b * b).max(0.0).sqrt();
    let (x, y) = (normal(rng), normal(rng));
    [a * x, b * x + c * y]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_seed_is_the_same_world() {
        let world = World { people: 3, seconds: 2.0, ..World::default() };
        assert_eq!(world.record(), world.record());
        assert_ne!(world.record(), World { seed: 2, ..world }.record());
    }

    #[test]
    fn draws_have_the_covariance_asked_for() {
        let Q = nalgebra::Matrix2::new(4.0, 1.5, 1.5, 1.0);
        let mut rng = fastrand::Rng::with_seed(3);
        let mut sum = nalgebra::Matrix2::zeros();
        let count = 40_000;
        for _ in 0..count {
            let d = nalgebra::Vector2::from(draw(&Q, &mut rng));
            sum += d * d.transpose();
        }
        assert!((sum / f64::from(count) - Q).norm() < 0.1, "{sum}");
    }

    #[test]
    fn measurements_are_as_noisy_as_the_world_says() {
        let world = World { people: 50, ..World::default() };
        let mut squares = [0.0; 4];
        let mut count = 0.0;
        for point in world.record().people.iter().flat_map(|p| &p.points) {
            if let (Some(z), Some(x)) = (point.measured, point.truth) {
                let r = measurement_noise(&world.filter, x[3], 1.0);
                (0..4).for_each(|i| squares[i] += (z[i] - x[i]).powi(2) / r[i]);
                count += 1.0;
            }
        }
        for sum in squares {
            assert!((sum / count - 1.0).abs() < 0.05, "{}", sum / count);
        }
    }
}
