//! Auto-tuning of `Q` and `R` by Bayesian optimisation of the filter's consistency (Chen, Heckman,
//! Julier, Ahmed, "Weak in the NEES?: Auto-tuning Kalman Filters with Bayesian Optimization", FUSION 2018).
//!
//! ```text
//! recordings -> filter run over each person -> squared normalised errors -> cost -> Gaussian process
//! ```
//!
//! Coordinates that share their noise are tuned apart from the others: first the size, since heights
//! scale all noise, then the centre. Each has three numbers: acceleration, walk, measurement.

pub mod chi_square;
mod measure;
pub mod plot;
pub mod recording;
mod search;
pub mod world;

pub use measure::{
    Consistency, Cost, GROUP_AXES, Group, HORIZONS, Horizon, Measured, Sample, Statistic, measure,
};
pub use recording::{Person, Point, Recording};
pub use search::{Search, Trial};
pub use world::World;

use crate::track::FilterConfig;

/// How to tune.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// What the filter is held against.
    pub statistic: Statistic,
    /// What is made small.
    pub cost: Cost,
    /// Share of the largest errors that the cost leaves out, `[0, 1)`.
    pub trim: f64,
    /// The search, for each group.
    pub search: Search,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            statistic: Statistic::Nees,
            cost: Cost::default(),
            trim: 0.0,
            search: Search { evaluations: 240, polish: 0, reach: 12.0, rounds: 4, shrink: 0.3, seed: 1 },
        }
    }
}

/// A filter and what it cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tuned {
    /// The best filter found.
    pub filter: FilterConfig,
    /// Cost of centre and size before.
    pub before: [f64; 2],
    /// Cost of centre and size after.
    pub after: [f64; 2],
}

/// There is nothing to tune on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "no sample to tune on: no one is detected often enough (at least 10 times, and for a second) \
     together with what the detections are held against"
)]
pub struct NoSamples;

/// Tunes the noise of `start` over `recordings`; `tell` hears of every trial.
///
/// # Errors
/// The recordings give no sample.
pub fn tune(
    start: &FilterConfig,
    recordings: &[&Recording],
    settings: &Settings,
    mut tell: impl FnMut(Group, &Trial),
) -> Result<Tuned, NoSamples> {
    let costs = |filter: &FilterConfig| -> Result<[f64; 2], NoSamples> {
        let measured = measure(filter, recordings, settings.statistic);
        let cost = |group| measured.cost(group, settings.cost, settings.trim).ok_or(NoSamples);
        Ok([cost(Group::Centre)?, cost(Group::Size)?])
    };
    let before = costs(start)?;
    let mut filter = *start;
    for group in [Group::Size, Group::Centre] {
        let with = |log: &[f64]| set_noise(&filter, group, log);
        let cost = |log: &[f64]| {
            let measured = measure(&with(log), recordings, settings.statistic);
            measured.cost(group, settings.cost, settings.trim).unwrap_or(f64::MAX)
        };
        let best = settings.search.minimise(&noise(&filter, group), cost, |trial| tell(group, trial));
        filter = with(&best.log);
    }
    Ok(Tuned { filter, before, after: costs(&filter)? })
}

/// Acceleration, walk and measurement noise of a group.
pub fn noise(filter: &FilterConfig, group: Group) -> [f64; 3] {
    match group {
        Group::Centre => [filter.centre_acceleration, filter.centre_walk, filter.centre_measurement],
        Group::Size => [filter.size_acceleration, filter.size_walk, filter.size_measurement],
    }
}

/// `filter` with the noise of a group set to numbers of these logarithms.
fn set_noise(filter: &FilterConfig, group: Group, log: &[f64]) -> FilterConfig {
    let (acceleration, walk, measurement) = (log[0].exp(), log[1].exp(), log[2].exp());
    match group {
        Group::Centre => FilterConfig {
            centre_acceleration: acceleration,
            centre_walk: walk,
            centre_measurement: measurement,
            ..*filter
        },
        Group::Size => FilterConfig {
            size_acceleration: acceleration,
            size_walk: walk,
            size_measurement: measurement,
            ..*filter
        },
    }
}

/// `filter` with its process noise `Q` times `q` and its measurement noise `R` times `r`.
pub fn scaled(filter: &FilterConfig, q: f64, r: f64) -> FilterConfig {
    let (q, r) = (q.sqrt(), r.sqrt());
    FilterConfig {
        centre_acceleration: filter.centre_acceleration * q,
        size_acceleration: filter.size_acceleration * q,
        centre_walk: filter.centre_walk * q,
        size_walk: filter.size_walk * q,
        centre_measurement: filter.centre_measurement * r,
        size_measurement: filter.size_measurement * r,
        ..*filter
    }
}
