//! Adam (Kingma and Ba 2015) and its learning-rate schedule.

use serde::{Deserialize, Serialize};

/// Warm-up, then half a cosine down to zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Learning rate at the end of the warm-up.
    pub peak: f32,
    /// Steps of the linear rise.
    pub warm_up: usize,
    /// Steps of the whole run.
    pub steps: usize,
}

impl Schedule {
    /// Learning rate of step `step`, counted from 0.
    pub fn rate(&self, step: usize) -> f32 {
        if step < self.warm_up {
            return self.peak * (step + 1) as f32 / self.warm_up as f32;
        }
        let done = (step - self.warm_up) as f32 / (self.steps - self.warm_up).max(1) as f32;
        self.peak * 0.5 * (1.0 + (std::f32::consts::PI * done.min(1.0)).cos())
    }
}

/// Running moments of every parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Adam {
    mean: Vec<f32>,
    square: Vec<f32>,
    steps: i32,
}

impl Adam {
    /// For `parameters` parameters.
    pub fn new(parameters: usize) -> Self {
        Self { mean: vec![0.0; parameters], square: vec![0.0; parameters], steps: 0 }
    }

    /// Moves `theta` against `gradient` with learning rate `rate`.
    pub fn step(&mut self, theta: &mut [f32], gradient: &[f32], rate: f32) {
        const MEAN: f32 = 0.9;
        const SQUARE: f32 = 0.999;
        self.steps += 1;
        let unbias_mean = 1.0 / (1.0 - MEAN.powi(self.steps));
        let unbias_square = 1.0 / (1.0 - SQUARE.powi(self.steps));
        for (((theta, g), mean), square) in
            theta.iter_mut().zip(gradient).zip(&mut self.mean).zip(&mut self.square)
        {
            *mean += (1.0 - MEAN) * (g - *mean);
            *square += (1.0 - SQUARE) * (g * g - *square);
            *theta -= rate * (*mean * unbias_mean) / ((*square * unbias_square).sqrt() + 1e-8);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schedule_rises_then_falls_to_zero() {
        let schedule = Schedule { peak: 0.4, warm_up: 10, steps: 110 };
        let rates: Vec<f32> = (0..=110).map(|s| schedule.rate(s)).collect();
        assert!(rates[..10].windows(2).all(|w| w[0] < w[1]));
        assert!(rates[10..].windows(2).all(|w| w[0] >= w[1]));
        assert!((rates[9] - 0.4).abs() < 1e-6 && (rates[60] - 0.2).abs() < 1e-6 && rates[110].abs() < 1e-6);
    }

    #[test]
    fn finds_the_minimum_of_a_bowl_with_unequal_axes() {
        let mut theta = [3.0f32, -2.0];
        let mut adam = Adam::new(2);
        let schedule = Schedule { peak: 0.1, warm_up: 5, steps: 400 };
        for step in 0..400 {
            let gradient = [2.0 * (theta[0] - 1.0), 200.0 * (theta[1] - 0.5)];
            adam.step(&mut theta, &gradient, schedule.rate(step));
        }
        assert!((theta[0] - 1.0).abs() < 1e-2 && (theta[1] - 0.5).abs() < 1e-2, "{theta:?}");
    }
}
