//! Link probabilities from explicit features without ONNX Runtime: the exported graph, in Rust.

use super::{ExplicitModel, Run, encode, logit, sigmoid};
use crate::track::association::explicit::COSTS;
use crate::track::{CANDIDATE_FEATURES, HISTORY, LinkRequest, STEP_FEATURES};

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

    /// The weights `lambda` of a track, given its raw history `[length, STEP_FEATURES]`.
    pub fn weights(&mut self, history: &[f32]) -> [f64; COSTS] {
        encode(self.model.shape, &self.theta, &self.model.normalised(history), &mut self.run);
        self.run.weights
    }

    /// Writes the link probability of every pair of `request` into `probabilities`, which is emptied
    /// first.
    ///
    /// # Panics
    /// When the request's parts disagree in length or a pair names a track that is not there.
    pub fn score(&mut self, request: &LinkRequest, probabilities: &mut Vec<f32>) {
        assert_eq!(request.candidates.len(), request.pairs.len() * CANDIDATE_FEATURES);
        let weights: Vec<_> = request
            .histories
            .chunks_exact(HISTORY * STEP_FEATURES)
            .zip(&request.lengths)
            .map(|(rows, length)| self.weights(&rows[..*length as usize * STEP_FEATURES]))
            .collect();
        probabilities.clear();
        for (pair, candidate) in request.pairs.iter().zip(request.candidates.chunks_exact(CANDIDATE_FEATURES))
        {
            self.run.weights = weights[pair.track as usize];
            let features = self.model.features(candidate);
            let logit = logit(self.model.shape, &self.theta, &self.run, &features);
            probabilities.push(sigmoid(logit) as f32);
        }
    }
}
