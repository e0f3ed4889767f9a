//! People on the ground, in metres.

use super::camera::Camera;
use super::{Drift, normal};

/// Speed at which people like to walk, and how much they differ, m/s.
const WALK: (f64, f64) = (1.25, 0.3);
/// How fast they come up to speed, s.
const HASTE: f64 = 0.7;
/// Stops a second of walking, and the mean length of one, s.
const STOPS: (f64, f64) = (0.02, 5.0);

/// One person.
#[derive(Clone, Debug)]
pub struct Person {
    /// Identity, from 1, never used again.
    pub id: i64,
    /// Place on the ground: to the right of the camera and away from it, m.
    pub at: [f64; 2],
    /// Height, m.
    pub height: f64,
    /// Phase of the steps, radians.
    pub gait: f64,
    /// Speed, m/s.
    pub speed: f64,
    velocity: [f64; 2],
    /// Where it goes: direction (radians) and speed, and how the direction drifts.
    heading: f64,
    pace: f64,
    wander: Drift,
    /// Seconds that it still stands.
    standing: f64,
    /// Who it walks with, and where beside them.
    leader: Option<(i64, [f64; 2])>,
}

/// The people, and who comes next.
pub struct Street {
    people: Vec<Person>,
    next: i64,
    /// How many there should be.
    crowd: f64,
    /// How many of them come in groups.
    groups: f64,
}

impl Street {
    /// A street already full of people.
    pub fn new(camera: &Camera, rng: &mut fastrand::Rng) -> Self {
        let crowd = 4.0 * (10.0f64).powf(rng.f64());
        let mut street = Self { people: vec![], next: 1, crowd, groups: 0.5 * rng.f64() };
        while (street.people.len() as f64) < crowd {
            let at = camera.random_place(rng);
            street.arrive(at, rng.f64() * std::f64::consts::TAU, rng);
        }
        street
    }

    /// Everybody.
    pub fn people(&self) -> &[Person] {
        &self.people
    }

    /// A person, or a group of two or three, comes walking at `at`.
    fn arrive(&mut self, at: [f64; 2], heading: f64, rng: &mut fastrand::Rng) {
        let size = if rng.f64() < self.groups { 2 + rng.usize(..2) } else { 1 };
        let pace = (WALK.0 + WALK.1 * normal(rng)).clamp(0.4, 3.0);
        // One in forty runs.
        let pace = if rng.f64() < 0.025 { pace * 2.2 } else { pace };
        let first = self.next;
        for member in 0..size {
            let beside = [0.6 * member as f64 + 0.1 * normal(rng), 0.25 * normal(rng)];
            let velocity = [heading.cos() * pace, heading.sin() * pace];
            self.people.push(Person {
                id: self.next,
                at: [at[0] + beside[0], at[1] + beside[1]],
                height: (1.7 + 0.09 * normal(rng)).clamp(1.1, 2.0),
                gait: rng.f64() * std::f64::consts::TAU,
                speed: pace,
                velocity,
                heading,
                pace,
                wander: Drift::new(rng),
                standing: 0.0,
                leader: (member > 0).then_some((first, beside)),
            });
            self.next += 1;
        }
    }

    /// `dt` seconds pass.
    pub fn step(&mut self, dt: f64, camera: &Camera, rng: &mut fastrand::Rng) {
        let leaders: Vec<(i64, [f64; 2], [f64; 2])> =
            self.people.iter().filter(|p| p.leader.is_none()).map(|p| (p.id, p.at, p.velocity)).collect();
        for person in &mut self.people {
            person.walk(dt, &leaders, rng);
        }
        self.people.retain(|p| camera.in_reach(p.at));
        // As many come as are missing, within some seconds.
        let missing = self.crowd - self.people.len() as f64;
        if missing > 0.0 && rng.f64() < dt * missing.min(4.0) {
            let (at, heading) = camera.random_entry(rng);
            self.arrive(at, heading, rng);
        }
    }
}

impl Person {
    fn walk(&mut self, dt: f64, leaders: &[(i64, [f64; 2], [f64; 2])], rng: &mut fastrand::Rng) {
        self.standing = (self.standing - dt).max(0.0);
        if self.standing == 0.0 && rng.f64() < STOPS.0 * dt {
            self.standing = -STOPS.1 * (1.0 - rng.f64()).ln();
            if rng.f64() < 0.3 {
                self.heading += std::f64::consts::PI * (rng.f64() - 0.5) * 2.0;
            }
        }
        self.heading += 0.25 * self.wander.step(dt, 2.0, rng) * dt;
        let leader = self.leader.and_then(|(id, beside)| {
            leaders.iter().find(|(of, ..)| *of == id).map(|(_, at, velocity)| (at, velocity, beside))
        });
        let wanted = match leader {
            // Whoever walks with somebody makes for the place beside them.
            Some((at, velocity, beside)) => {
                [0, 1].map(|i| velocity[i] + (at[i] + beside[i] - self.at[i]).clamp(-1.0, 1.0))
            }
            None if self.standing > 0.0 => [0.0; 2],
            None => [self.heading.cos() * self.pace, self.heading.sin() * self.pace],
        };
        let share = 1.0 - (-dt / HASTE).exp();
        for ((velocity, at), wanted) in self.velocity.iter_mut().zip(&mut self.at).zip(wanted) {
            *velocity += share * (wanted - *velocity);
            *at += *velocity * dt;
        }
        self.speed = self.velocity[0].hypot(self.velocity[1]);
        // Two steps are about 1.4 m.
        self.gait += std::f64::consts::TAU * self.speed * dt / 1.4;
    }
}
