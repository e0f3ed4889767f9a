//! Link probabilities without ONNX Runtime: the exported graph, in Rust.

use super::activate::{sigmoid, sigmoid_all, tanh_all};
use super::gemm::{View, gemm};
use super::model::LinkModel;
use crate::track::{HISTORY, LinkRequest};

/// Scores link requests. Each track's history is encoded once, each candidate projected once; only
/// the last step is pairwise.
#[derive(Clone, Debug)]
pub struct GruScorer {
    model: LinkModel,
    /// Normalised histories `[T, HISTORY, S]`.
    x: Vec<f32>,
    /// Input part of the gates.
    gates: Vec<f32>,
    /// States `[T, H]`.
    state: Vec<f32>,
    /// `r * h`, rows `H` wide.
    reset: Vec<f32>,
    /// State part of r and z of the last step, `[T, 2 H]`.
    from_state: Vec<f32>,
}

impl GruScorer {
    /// A scorer of `model`.
    pub fn new(model: LinkModel) -> Self {
        let empty = Vec::new;
        Self { model, x: empty(), gates: empty(), state: empty(), reset: empty(), from_state: empty() }
    }

    /// The model.
    pub fn model(&self) -> &LinkModel {
        &self.model
    }

    /// Writes the link probability of every pair of `request` into `probabilities`, which is
    /// emptied first. An empty request gives none.
    ///
    /// # Panics
    /// When the request's parts disagree in length, a pair names a track that is not there, or its features
    /// are others than the model's.
    pub fn score(&mut self, request: &LinkRequest, probabilities: &mut Vec<f32>) {
        let (tracks, pairs) = (request.tracks(), request.pairs.len());
        probabilities.clear();
        if request.is_empty() {
            return;
        }
        let features = self.model.features();
        assert_eq!(request.features, features, "what the model reads");
        assert_eq!(request.histories.len(), tracks * HISTORY * features.step(), "one history a track");
        assert_eq!(request.candidates.len(), pairs * features.candidate(), "one candidate a pair");
        let width = features.candidate();
        self.encode(request);
        let gru = &self.model.gru;
        let (shape, h, g) = (gru.shape, gru.shape.hidden, 3 * gru.shape.hidden);
        let u = gru.part(shape.u());
        self.from_state.resize(tracks * 2 * h, 0.0);
        gemm(
            (tracks, h, 2 * h),
            View::rows(&self.state, h),
            View::rows(u, g),
            0.0,
            &mut self.from_state,
            2 * h,
        );

        self.x.clear();
        self.x.extend_from_slice(&request.candidates);
        self.x.chunks_exact_mut(width).for_each(|row| self.model.candidate.apply(row));
        self.gates.clear();
        (0..pairs).for_each(|_| self.gates.extend_from_slice(gru.part(shape.b())));
        let (x, w) = (View::rows(&self.x, width), View::rows(gru.part(shape.w_candidate()), g));
        gemm((pairs, width, g), x, w, 1.0, &mut self.gates, g);
        self.reset.resize(pairs * h, 0.0);
        for ((gates, reset), pair) in
            self.gates.chunks_exact_mut(g).zip(self.reset.chunks_exact_mut(h)).zip(&request.pairs)
        {
            let track = pair.track as usize;
            let from_state = &self.from_state[track * 2 * h..(track + 1) * 2 * h];
            gates.iter_mut().zip(from_state).for_each(|(gate, s)| *gate += s);
            sigmoid_all(&mut gates[..2 * h]);
            let state = &self.state[track * h..(track + 1) * h];
            reset.iter_mut().zip(&gates[..h]).zip(state).for_each(|((reset, r), s)| *reset = r * s);
        }
        let u_c = View::rows(&u[2 * h..], g);
        gemm((pairs, h, h), View::rows(&self.reset, h), u_c, 1.0, &mut self.gates[2 * h..], g);
        let (v, v0) = (gru.part(shape.v()), gru.theta[shape.v0()]);
        for (gates, pair) in self.gates.chunks_exact_mut(g).zip(&request.pairs) {
            let state = &self.state[pair.track as usize * h..][..h];
            let (rz, c) = gates.split_at_mut(2 * h);
            tanh_all(c);
            let mut logit = v0;
            for (((s, z), c), v) in state.iter().zip(&rz[h..]).zip(&*c).zip(v) {
                logit += (s + z * (c - s)) * v;
            }
            probabilities.push(sigmoid(logit));
        }
    }

    /// States of all tracks after their histories.
    fn encode(&mut self, request: &LinkRequest) {
        let tracks = request.tracks();
        let gru = &self.model.gru;
        let (shape, h, g) = (gru.shape, gru.shape.hidden, 3 * gru.shape.hidden);
        let u = gru.part(shape.u());
        let wide = HISTORY * g;
        let width = shape.features.step();
        self.x.clear();
        self.x.extend_from_slice(&request.histories);
        self.x.chunks_exact_mut(width).for_each(|row| self.model.history.apply(row));
        self.gates.clear();
        (0..tracks * HISTORY).for_each(|_| self.gates.extend_from_slice(gru.part(shape.b())));
        let (x, w) = (View::rows(&self.x, width), View::rows(gru.part(shape.w_history()), g));
        gemm((tracks * HISTORY, width, g), x, w, 1.0, &mut self.gates, g);
        self.state.clear();
        self.state.resize(tracks * h, 0.0);
        self.reset.resize(tracks * h, 0.0);
        for step in 0..HISTORY {
            // Row `t` of this step's gates begins at `t * wide` from here.
            let gates = &mut self.gates[step * g..];
            gemm((tracks, h, 2 * h), View::rows(&self.state, h), View::rows(u, g), 1.0, gates, wide);
            for (t, (state, reset)) in
                self.state.chunks_exact(h).zip(self.reset.chunks_exact_mut(h)).enumerate()
            {
                let rz = &mut gates[t * wide..t * wide + 2 * h];
                sigmoid_all(rz);
                reset.iter_mut().zip(&rz[..h]).zip(state).for_each(|((reset, r), s)| *reset = r * s);
            }
            let (reset, u_c) = (View::rows(&self.reset, h), View::rows(&u[2 * h..], g));
            gemm((tracks, h, h), reset, u_c, 1.0, &mut gates[2 * h..], wide);
            for (t, state) in self.state.chunks_exact_mut(h).enumerate() {
                if step as i32 >= request.lengths[t] {
                    continue;
                }
                let (rz, c) = gates[t * wide..t * wide + g].split_at_mut(2 * h);
                tanh_all(c);
                for ((state, z), c) in state.iter_mut().zip(&rz[h..]).zip(&*c) {
                    *state += z * (c - *state);
                }
            }
        }
    }
}
