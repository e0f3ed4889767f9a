//! The filter run over recordings: how large its errors are beside what it believes of them.

use super::chi_square;
use super::recording::{Person, Recording};
use crate::track::kalman::BoxFilter;
use crate::track::motion::{measurement_noise, motion, newborn};
use crate::track::{FilterConfig, LifeConfig};

/// What an estimate is held against.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Statistic {
    /// Normalised estimation error squared: the true box, under `H P H'`.
    Nees,
    /// Normalised innovation squared: the measured box, under `H P H' + R`.
    Nis,
}

impl Statistic {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Statistic::Nees => "NEES",
            Statistic::Nis => "NIS",
        }
    }
}

/// How far ahead of its last measurement the filter is asked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Horizon {
    /// Not at all: the estimate just updated. A measurement cannot judge it, it is part of it.
    Update,
    /// A frame.
    Frame,
    /// The first frame after this many seconds, without a measurement between.
    Seconds(f64),
}

/// The horizons that are looked at: a tracker predicts over a frame while all goes well, and over a second
/// and more when someone is hidden.
pub const HORIZONS: [Horizon; 4] =
    [Horizon::Update, Horizon::Frame, Horizon::Seconds(0.5), Horizon::Seconds(1.0)];

impl Horizon {
    /// Its name in a table.
    pub fn name(self) -> String {
        match self {
            Horizon::Update => "update".into(),
            Horizon::Frame => "1 frame".into(),
            Horizon::Seconds(s) => format!("{s} s"),
        }
    }
}

/// Coordinates that share their noise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// `cx, cy`.
    Centre,
    /// `w, h`.
    Size,
}

/// Coordinates of a [`Group`].
pub const GROUP_AXES: usize = 2;

impl Group {
    /// Both.
    pub const ALL: [Group; 2] = [Group::Centre, Group::Size];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Group::Centre => "centre",
            Group::Size => "size",
        }
    }
}

/// One look at the filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Time since the first measurement of the track, s.
    pub age: f64,
    /// Squared normalised error of centre and size, two degrees of freedom each.
    pub squared: [f64; 2],
    /// Logarithm of the determinant of the covariance that normalised it, of centre and size.
    pub log_det: [f64; 2],
}

/// What a run over recordings gave.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measured {
    /// Samples of each of [`HORIZONS`].
    pub samples: [Vec<Sample>; HORIZONS.len()],
    /// With [`Statistic::Nees`], squared normalised innovations after a frame: what holds `R` fast.
    pub innovations: Vec<Sample>,
    /// Squared normalised error of the whole updated state, velocities included, of centre and size: four
    /// degrees of freedom each. Only a simulated world knows true velocities.
    pub states: Vec<[f64; 2]>,
}

/// Between two looks at a person, s: errors that far apart have next to nothing in common, so that the
/// bounds of independent samples hold.
const SPACING: f64 = 1.0;

/// Updates of a track before it is looked at: by then the guess of its first velocity is forgotten.
const SETTLED: u32 = 8;

/// Runs `config`, its noise not adapted to any link, over the recordings: every person is tracked by the
/// detections that are that person's.
pub fn measure(config: &FilterConfig, recordings: &[&Recording], statistic: Statistic) -> Measured {
    let mut measured = Measured::default();
    for recording in recordings {
        for person in &recording.people {
            Run { config, recording, statistic, measured: &mut measured }.follow(person);
        }
    }
    measured
}

/// A live track.
struct Live {
    filter: BoxFilter,
    born: f64,
    seen: f64,
    updates: u32,
    look: f64,
}

/// A copy of a filter that gets no measurement until it is asked.
struct Probe {
    filter: BoxFilter,
    horizon: usize,
    due: usize,
    age: f64,
}

struct Run<'a> {
    config: &'a FilterConfig,
    recording: &'a Recording,
    statistic: Statistic,
    measured: &'a mut Measured,
}

impl Run<'_> {
    fn follow(&mut self, person: &Person) {
        let lost = LifeConfig::default().lost;
        let times = &self.recording.times;
        let mut live: Option<Live> = None;
        let mut probes: Vec<Probe> = vec![];
        for (i, point) in person.points.iter().enumerate() {
            let frame = person.first + i;
            let time = times[frame];
            let dt = if i == 0 { 0.0 } else { time - times[frame - 1] };
            live = live.filter(|l| time - l.seen <= lost);
            let filters = live.iter_mut().map(|l| &mut l.filter);
            for filter in filters.chain(probes.iter_mut().map(|p| &mut p.filter)) {
                self.advance(filter, dt, self.recording.shifts[frame]);
            }
            probes.retain(|probe| {
                if probe.due == frame {
                    let target = match self.statistic {
                        Statistic::Nees => point.truth,
                        Statistic::Nis => point.measured,
                    };
                    if let Some(target) = target {
                        let sample = self.look(&probe.filter, target, self.statistic, probe.age);
                        self.measured.samples[probe.horizon].push(sample);
                    }
                    if let (Statistic::Nees, Horizon::Frame, Some(z)) =
                        (self.statistic, HORIZONS[probe.horizon], point.measured)
                    {
                        let sample = self.look(&probe.filter, z, Statistic::Nis, probe.age);
                        self.measured.innovations.push(sample);
                    }
                }
                probe.due > frame
            });
            let Some(z) = point.measured else { continue };
            match &mut live {
                None => {
                    let filter = newborn(self.config, z);
                    live = Some(Live { filter, born: time, seen: time, updates: 1, look: time });
                }
                Some(l) => {
                    let r = measurement_noise(self.config, height(&l.filter), 1.0);
                    l.filter.update(z, r);
                    (l.seen, l.updates) = (time, l.updates + 1);
                    if l.updates < SETTLED || time < l.look {
                        continue;
                    }
                    l.look = time + SPACING;
                    let age = time - l.born;
                    for (horizon, ahead) in HORIZONS.iter().enumerate() {
                        let due = match ahead {
                            Horizon::Update => {
                                if let (Statistic::Nees, Some(truth)) = (self.statistic, point.truth) {
                                    let sample = self.look(&l.filter, truth, self.statistic, age);
                                    self.measured.samples[horizon].push(sample);
                                }
                                if let (Some(truth), Some(velocity)) = (point.truth, point.velocity) {
                                    self.measured.states.push(state_squared(&l.filter, truth, velocity));
                                }
                                continue;
                            }
                            Horizon::Frame => frame + 1,
                            // Half a nanosecond of slack: sums of frame times are not exact.
                            Horizon::Seconds(s) => times.partition_point(|t| *t < time + s - 5e-10),
                        };
                        probes.push(Probe { filter: l.filter, horizon, due, age });
                    }
                }
            }
        }
    }

    fn advance(&self, filter: &mut BoxFilter, dt: f64, shift: [f64; 2]) {
        filter.predict(&motion(self.config, dt, height(filter), 1.0));
        filter.axes[0].x[0] += shift[0];
        filter.axes[1].x[0] += shift[1];
    }

    /// The filter's box held against `target`.
    fn look(&self, filter: &BoxFilter, target: [f64; 4], statistic: Statistic, age: f64) -> Sample {
        let r = match statistic {
            Statistic::Nees => [0.0; 4],
            Statistic::Nis => measurement_noise(self.config, height(filter), 1.0),
        };
        let (x, p) = (filter.position(), filter.variances());
        let squared = |i: usize| (target[i] - x[i]).powi(2) / (p[i] + r[i]);
        let log = |i: usize| (p[i] + r[i]).ln();
        Sample {
            age,
            squared: [squared(0) + squared(1), squared(2) + squared(3)],
            log_det: [log(0) + log(1), log(2) + log(3)],
        }
    }
}

/// Height that the tracker scales noise by.
fn height(filter: &BoxFilter) -> f64 {
    filter.position()[3].max(1.0)
}

/// `e' P^-1 e` of centre and size with their velocities.
fn state_squared(filter: &BoxFilter, truth: [f64; 4], velocity: [f64; 4]) -> [f64; 2] {
    let axis = |i: usize| {
        let e = nalgebra::Vector2::new(truth[i], velocity[i]) - filter.axes[i].x;
        let P = &filter.axes[i].P;
        let det = P.determinant();
        (P[(1, 1)] * e[0] * e[0] - 2.0 * P[(0, 1)] * e[0] * e[1] + P[(0, 0)] * e[1] * e[1]) / det
    };
    [axis(0) + axis(1), axis(2) + axis(3)]
}

/// Mean of some squared normalised errors beside what it must be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Consistency {
    /// Degrees of freedom of a sample: what its mean is when the filter is consistent.
    pub n: usize,
    /// Samples.
    pub count: usize,
    /// Their mean.
    pub mean: f64,
    /// 95 % of such means lie between these when the filter is consistent.
    pub bounds: (f64, f64),
    /// Mean without the largest share, over what that is for chi-square: 1 when all but the tail is as it
    /// must be.
    pub bulk: f64,
}

impl Consistency {
    /// Of `values` of `n` degrees of freedom, of which `bulk` leaves out the largest share `trim`; `None`
    /// for no values.
    pub fn of(n: usize, values: Vec<f64>, trim: f64) -> Option<Self> {
        let count = values.len();
        if count == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / count as f64;
        Some(Self { n, count, mean, bounds: chi_square::mean_bounds(n, count), bulk: bulk(n, values, trim) })
    }

    /// Whether the mean lies within its bounds.
    pub fn holds(&self) -> bool {
        (self.bounds.0..=self.bounds.1).contains(&self.mean)
    }
}

/// [`Consistency::bulk`] of some values, at least one.
fn bulk(n: usize, mut values: Vec<f64>, trim: f64) -> f64 {
    // Sorted all through, so that the sum is always taken in the same order.
    values.sort_unstable_by(f64::total_cmp);
    let kept = ((values.len() as f64 * (1.0 - trim)).ceil() as usize).clamp(1, values.len());
    values[..kept].iter().sum::<f64>() / kept as f64 / chi_square::trimmed_mean(n, trim)
}

impl Measured {
    /// Consistency of a group at a horizon.
    pub fn group(&self, horizon: usize, group: Group, trim: f64) -> Option<Consistency> {
        let values = self.samples[horizon].iter().map(|s| s.squared[group as usize]).collect();
        Consistency::of(GROUP_AXES, values, trim)
    }

    /// Consistency of the whole box at a horizon.
    pub fn all(&self, horizon: usize, trim: f64) -> Option<Consistency> {
        let values = self.samples[horizon].iter().map(|s| s.squared.iter().sum()).collect();
        Consistency::of(2 * GROUP_AXES, values, trim)
    }

    /// Consistency of the whole state, velocities included, where they are known: `n = 8`.
    pub fn state(&self, trim: f64) -> Option<Consistency> {
        let values = self.states.iter().map(|s| s.iter().sum()).collect();
        Consistency::of(4 * GROUP_AXES, values, trim)
    }

    /// What is to be made small for a group; `None` for no samples. See [`Cost`].
    pub fn cost(&self, group: Group, cost: Cost, trim: f64) -> Option<f64> {
        let with_innovations = (cost == Cost::Consistency).then_some(&self.innovations);
        let parts: Vec<f64> = self
            .samples
            .iter()
            .chain(with_innovations)
            .filter(|samples| !samples.is_empty())
            .map(|samples| {
                let values = samples.iter().map(|s| s.squared[group as usize]).collect();
                let log_det = samples.iter().map(|s| s.log_det[group as usize]).sum::<f64>();
                // The surrogate needs a number, and beyond a factor of 10^4 all is equally bad.
                let ratio = bulk(GROUP_AXES, values, trim).clamp(1e-4, 1e4);
                match cost {
                    Cost::Consistency => ratio.ln().abs(),
                    Cost::Likelihood => 0.5 * (ratio + log_det / (samples.len() * GROUP_AXES) as f64),
                }
            })
            .collect();
        match cost {
            _ if parts.is_empty() => None,
            Cost::Consistency => Some(parts.iter().sum()),
            Cost::Likelihood => Some(parts.iter().sum::<f64>() / parts.len() as f64),
        }
    }
}

/// What tuning makes small, over all [`HORIZONS`]. `m` is the mean squared normalised error over its
/// degrees of freedom, the largest share left out where that is asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Cost {
    /// The mean negative log-likelihood of what the filter is held against, in nats a coordinate and up to a
    /// constant: `(m + mean ln det / n) / 2`. Where a common factor on `Q` and `R` is best, the mean of `m` over the
    /// horizons is 1: consistency is part of it. The rest is how small the true errors are, which
    /// tells one consistent filter from another.
    #[default]
    Likelihood,
    /// `J = |ln m|` of Chen et al., added up over the horizons, and with [`Statistic::Nees`] over the
    /// innovation of the next frame as well. One horizon alone leaves a valley: for every `R` there is a `Q` that
    /// makes one mean right.
    Consistency,
}

impl Cost {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Cost::Likelihood => "likelihood",
            Cost::Consistency => "consistency",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::world::World;
    use super::*;

    fn check(measured: &Measured, expected: bool) {
        for horizon in 0..HORIZONS.len() {
            for group in Group::ALL {
                if let Some(found) = measured.group(horizon, group, 0.0) {
                    assert_eq!(found.holds(), expected, "{horizon} {group:?} {found:?}");
                }
            }
        }
    }

    #[test]
    fn the_filter_of_the_world_is_consistent_and_no_other() {
        let world = World { people: 1000, ..World::default() };
        let recording = world.record();
        for statistic in [Statistic::Nees, Statistic::Nis] {
            let right = measure(&world.filter, &[&recording], statistic);
            check(&right, true);
            let state = right.state(0.0).expect("the world knows velocities");
            assert!(state.holds() && state.n == 8, "{state:?}");
            let wrong = FilterConfig {
                centre_measurement: world.filter.centre_measurement * 1.5,
                size_measurement: world.filter.size_measurement * 1.5,
                ..world.filter
            };
            let wrong = measure(&wrong, &[&recording], statistic);
            for cost in [Cost::Likelihood, Cost::Consistency] {
                let of = |measured: &Measured| measured.cost(Group::Centre, cost, 0.0).expect("samples");
                assert!(of(&wrong) > of(&right) + 0.01, "{cost:?}: {} {}", of(&wrong), of(&right));
            }
            assert!(!wrong.group(1, Group::Centre, 0.0).expect("samples").holds());
        }
    }

    #[test]
    fn nis_needs_no_truth_and_nees_no_measurement_at_the_end() {
        let world = World { people: 5, ..World::default() };
        let mut recording = world.record();
        for point in recording.people.iter_mut().flat_map(|p| &mut p.points) {
            (point.truth, point.velocity) = (None, None);
        }
        let nis = measure(&world.filter, &[&recording], Statistic::Nis);
        assert!(nis.samples[0].is_empty() && nis.states.is_empty());
        assert!(nis.samples[1..].iter().all(|s| !s.is_empty()));
        let nees = measure(&world.filter, &[&recording], Statistic::Nees);
        assert_eq!((nees.cost(Group::Size, Cost::Likelihood, 0.0), nees.all(1, 0.0)), (None, None));
    }

    #[test]
    fn trimming_takes_the_largest_away() {
        let values = vec![1.0, 1e9, 3.0, 2.0];
        let found = Consistency::of(2, values.clone(), 0.25).expect("values");
        assert!((found.bulk * chi_square::trimmed_mean(2, 0.25) - 2.0).abs() < 1e-12, "{found:?}");
        assert!(!found.holds() && found.mean > 2e8);
        let whole = Consistency::of(2, values, 0.0).expect("values");
        assert!((whole.bulk * 2.0 - whole.mean).abs() < 1e-6);
    }
}
