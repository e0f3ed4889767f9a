//! Link probabilities from explicit features without ONNX Runtime: the exported graph, in Rust.

use super::{ExplicitModel, Run, encode, logit, sigmoid};
use crate::track::association::explicit::COSTS;
use crate::track::{HISTORY, LinkRequest};

/// Scores link requests: the weights of each track once, then a sum of four for each pair.
#[derive(Clone, Debug)]
pub struct ExplicitScorer {
    model: ExplicitModel,
    theta: Vec<f64>,
    run: Run,
}

impl ExplicitScorer {
    /// A scorer of `model`.
    pub fn new(model: ExplicitModel) -> Self {
        Self { theta: model.theta64(), model, run: Run::default() }
    }

    /// The weights `lambda` of a track, given its raw history.
    pub fn weights(&mut self, history: &[f32]) -> [f64; COSTS] {
        encode(self.model.shape, &self.theta, &self.model.normalised(history), &mut self.run);
        self.run.weights
    }

    /// Writes the link probability of every pair of `request` into `probabilities`, which is emptied
    /// first.
    ///
    /// # Panics
    /// When the request's parts disagree in length, a pair names a track that is not there, or its features
    /// are others than the model's.
    pub fn score(&mut self, request: &LinkRequest, probabilities: &mut Vec<f32>) {
        probabilities.clear();
        if request.is_empty() {
            return;
        }
        let features = self.model.shape.features;
        assert_eq!(request.features, features, "what the model reads");
        let [step, candidate] = [features.step(), features.candidate()];
        assert_eq!(request.candidates.len(), request.pairs.len() * candidate);
        let weights: Vec<_> = request
            .histories
            .chunks_exact(HISTORY * step)
            .zip(&request.lengths)
            .map(|(rows, length)| self.weights(&rows[..*length as usize * step]))
            .collect();
        for (pair, candidate) in request.pairs.iter().zip(request.candidates.chunks_exact(candidate)) {
            self.run.weights = weights[pair.track as usize];
            let features = self.model.features(candidate);
            let logit = logit(self.model.shape, &self.theta, &self.run, &features);
            probabilities.push(sigmoid(logit) as f32);
        }
    }
}
