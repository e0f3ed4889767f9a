//! What a link model is: how its inputs are normalised, and the network.

use super::examples::Examples;
use super::gru::{Gru, GruShape};
use crate::track::Features;

/// Normalised inputs are clipped at this many standard deviations.
pub const CLIP: f32 = 6.0;

/// Z-score of each feature, clipped: `clamp((x - mean) * scale, -CLIP, CLIP)`.
#[derive(Clone, Debug, PartialEq)]
pub struct Normaliser {
    /// Subtracted.
    pub mean: Vec<f32>,
    /// Multiplied: one over the standard deviation.
    pub scale: Vec<f32>,
}

impl Normaliser {
    /// Leaves `width` features as they are, but for the clip.
    pub fn identity(width: usize) -> Self {
        Self { mean: vec![0.0; width], scale: vec![1.0; width] }
    }

    /// Mean and standard deviation of `rows`, each `width` wide. A feature that hardly varies (a
    /// flag) keeps the scale 1.
    pub fn measure<'a>(width: usize, rows: impl Iterator<Item = &'a [f32]>) -> Self {
        let mut sum = vec![0.0f64; width];
        let mut square = vec![0.0f64; width];
        let mut count = 0.0f64;
        for row in rows {
            for ((sum, square), x) in sum.iter_mut().zip(&mut square).zip(row) {
                *sum += f64::from(*x);
                *square += f64::from(*x).powi(2);
            }
            count += 1.0;
        }
        let count = count.max(1.0);
        let mut found = Self::identity(width);
        for i in 0..width {
            let mean = sum[i] / count;
            let std = (square[i] / count - mean * mean).max(0.0).sqrt();
            found.mean[i] = mean as f32;
            if std > 1e-4 {
                found.scale[i] = (1.0 / std) as f32;
            }
        }
        found
    }

    /// Normalises one row in place.
    pub fn apply(&self, row: &mut [f32]) {
        for ((x, mean), scale) in row.iter_mut().zip(&self.mean).zip(&self.scale) {
            *x = ((*x - mean) * scale).clamp(-CLIP, CLIP);
        }
    }
}

/// A link model. History steps and candidates are normalised apart: an innovation of a matched
/// observation is a tenth of a rival's, and on a common scale it would vanish. Where both are
/// multiplied by one `W` they are normalised together.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkModel {
    /// Of the history's steps.
    pub history: Normaliser,
    /// Of the candidates.
    pub candidate: Normaliser,
    /// The network over normalised inputs.
    pub gru: Gru,
}

impl LinkModel {
    /// A network of random parameters whose normalisers fit `examples`; it reads what these are made of.
    pub fn random(hidden: usize, examples: &Examples, rng: &mut fastrand::Rng) -> Self {
        let features = examples.features();
        let shape = GruShape { features, hidden };
        let steps = || examples.history_steps();
        let (history, candidate) = if shape.shares_w() {
            let all = Normaliser::measure(features.step(), steps().chain(examples.candidates()));
            (all.clone(), all)
        } else {
            (
                Normaliser::measure(features.step(), steps()),
                Normaliser::measure(features.candidate(), examples.candidates()),
            )
        };
        Self { history, candidate, gru: Gru::random(shape, rng) }
    }

    /// What it reads.
    pub fn features(&self) -> Features {
        self.gru.shape.features
    }

    /// `examples` with normalised features.
    pub fn normalise(&self, examples: &Examples) -> Examples {
        let mut normalised = examples.clone();
        normalised.map_inputs(|row| self.history.apply(row), |row| self.candidate.apply(row));
        normalised
    }
}
