//! Bayesian optimisation over a few positive numbers.
//!
//! The `optimizer` crate's Gaussian process (Matern 5/2, expected improvement) looks for the minimum in
//! a box around the best point so far. The box shrinks from round to round: the process draws its
//! candidates at random, so that its grain is a share of the box. Where more trials are given for it, the same
//! crate's CMA-ES, which learns the direction of a valley, goes on from there: the likelihood is flat between
//! acceleration and walk.

use std::collections::HashMap;

use optimizer::parameter::{FloatParam, ParamValue, Parameter};
use optimizer::sampler::cma_es::CmaEsSampler;
use optimizer::sampler::gp::GpSampler;
use optimizer::{Direction, Study};

/// How to search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Search {
    /// Trials of the Gaussian process, the start included.
    pub evaluations: usize,
    /// Trials of the evolution strategy after them.
    pub polish: usize,
    /// Half width of the first box, as a factor on the start.
    pub reach: f64,
    /// Rounds.
    pub rounds: usize,
    /// Half width of a round's box in logarithms, over that of the round before.
    pub shrink: f64,
    /// Seed.
    pub seed: u64,
}

/// Half width of the evolution strategy's box and its first step, in logarithms.
const POLISH_BOX: (f64, f64) = (1.0, 0.15);

/// A point and its cost.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// Logarithms of the numbers.
    pub log: Vec<f64>,
    /// Cost.
    pub cost: f64,
}

/// Values of one trial of `study`; `fixed` is taken where it is given, the sampler's choice otherwise.
fn ask(study: &Study<f64>, axes: &[FloatParam], fixed: Option<&[f64]>) -> (optimizer::Trial, Vec<f64>) {
    if let Some(fixed) = fixed {
        let values = axes.iter().zip(fixed).map(|(axis, v)| (axis.id(), ParamValue::Float(*v)));
        study.enqueue(values.collect::<HashMap<_, _>>());
    }
    let mut trial = study.ask();
    let suggest = |axis: &FloatParam| axis.suggest(&mut trial).expect("an axis of a box is asked for once");
    let log = axes.iter().map(suggest).collect();
    (trial, log)
}

impl Search {
    /// The best point near `start` (positive numbers); `cost` is given logarithms. `tell` hears of every
    /// trial. The same search of the same cost goes the same way.
    pub fn minimise(
        &self,
        start: &[f64],
        mut cost: impl FnMut(&[f64]) -> f64,
        mut tell: impl FnMut(&Trial),
    ) -> Trial {
        let log: Vec<f64> = start.iter().map(|v| v.ln()).collect();
        let mut best = Trial { cost: cost(&log), log };
        tell(&best);
        let trials = self.evaluations - 1;
        let mut known = vec![best.clone()];
        let mut half = self.reach.ln();
        for round in 0..self.rounds {
            let centre = best.log.clone();
            let axes: Vec<FloatParam> = centre.iter().map(|c| FloatParam::new(c - half, c + half)).collect();
            let sampler = GpSampler::builder()
                .seed(self.seed.wrapping_add(round as u64))
                .n_startup_trials(if round == 0 { 3 * axes.len() } else { axes.len() + 1 })
                .noise_variance(1e-4)
                .build();
            let study: Study<f64> = Study::with_sampler(Direction::Minimize, sampler);
            let inside = |t: &&Trial| t.log.iter().zip(&centre).all(|(v, c)| (v - c).abs() <= half);
            for trial in known.iter().filter(inside) {
                let (asked, _) = ask(&study, &axes, Some(&trial.log));
                study.tell(asked, Ok::<_, String>(trial.cost));
            }
            let from = trials * round / self.rounds;
            let to = trials * (round + 1) / self.rounds;
            for _ in from..to {
                let (asked, log) = ask(&study, &axes, None);
                let trial = Trial { cost: cost(&log), log };
                study.tell(asked, Ok::<_, String>(trial.cost));
                tell(&trial);
                if trial.cost < best.cost {
                    best = trial.clone();
                }
                known.push(trial);
            }
            half *= self.shrink;
        }
        let (half, step) = POLISH_BOX;
        let axes: Vec<FloatParam> = best.log.iter().map(|c| FloatParam::new(c - half, c + half)).collect();
        let sampler = CmaEsSampler::builder().sigma0(step).seed(self.seed).build();
        let study: Study<f64> = Study::with_sampler(Direction::Minimize, sampler);
        for _ in 0..self.polish {
            let (asked, log) = ask(&study, &axes, None);
            let trial = Trial { cost: cost(&log), log };
            study.tell(asked, Ok::<_, String>(trial.cost));
            tell(&trial);
            if trial.cost < best.cost {
                best = trial;
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_a_minimum_far_from_the_start_and_the_same_one_again() {
        let search = Search { evaluations: 80, polish: 0, reach: 30.0, rounds: 4, shrink: 0.35, seed: 5 };
        // Kinks, and a valley: the first two numbers' product is better known than each of them.
        let cost =
            |x: &[f64]| (x[0] + x[1] - 1.0).abs() + 0.3 * (x[0] - x[1] + 2.0).abs() + (x[2] + 1.5).abs();
        let mut told = 0;
        let best = search.minimise(&[1.0, 1.0, 1.0], cost, |_| told += 1);
        assert_eq!(told, 80);
        assert!(best.cost < 0.2, "{best:?}");
        for (found, expected) in best.log.iter().zip([-0.5, 1.5, -1.5]) {
            assert!((found - expected).abs() < 0.25, "{best:?}");
        }
        assert_eq!(search.minimise(&[1.0, 1.0, 1.0], cost, |_| ()), best);
        let polished = Search { polish: 120, ..search };
        let better = polished.minimise(&[1.0, 1.0, 1.0], cost, |_| ());
        assert!(better.cost < 0.01 && better.cost < best.cost, "{better:?}");
        assert_eq!(polished.minimise(&[1.0, 1.0, 1.0], cost, |_| ()), better);
    }
}
