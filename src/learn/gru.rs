//! The GRU and its gradient by back-propagation through time, on batches of sequences.
//!
//! Eq. GRU of the paper, the reset gate before the matrix product (`x` rows, weights on the right):
//!
//! ```text
//! r = sigmoid(x W_r + h U_r + b_r)
//! z = sigmoid(x W_z + h U_z + b_z)
//! c = tanh(x W_c + (r * h) U_c + b_c)
//! h' = (1 - z) * h + z * c
//! P = sigmoid(h' . v + v0)            after the last step, the candidate
//! ```

use std::ops::Range;

use super::activate::{sigmoid, sigmoid_all, tanh_all};
use super::gemm::{View, gemm};
use crate::track::{Features, HISTORY};

/// Steps of a sequence: the history, then the candidate.
const STEPS: usize = HISTORY + 1;

/// Sizes of a [`Gru`] and where its parts lie in the parameter vector.
///
/// The parts, in order, row-major, for observations of `S` values and candidates of `C`: `W` history
/// `[S, 3 H]`, `W` candidate `[C, 3 H]`, `U [H, 3 H]`, `b [3 H]`, `v [H]`, `v0 [1]`; the columns of a gate
/// block are `r`, `z`, `c`. [`Features::Literal`] has one `W` for all steps, as the paper has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GruShape {
    /// What it reads.
    pub features: Features,
    /// Width of the hidden state.
    pub hidden: usize,
}

impl GruShape {
    fn gates(self) -> usize {
        3 * self.hidden
    }

    /// Whether history and candidate are multiplied by the same `W`.
    pub fn shares_w(self) -> bool {
        matches!(self.features, Features::Literal { .. })
    }

    /// `W` of a history step.
    pub fn w_history(self) -> Range<usize> {
        0..self.features.step() * self.gates()
    }

    /// `W` of the candidate.
    pub fn w_candidate(self) -> Range<usize> {
        let start = if self.shares_w() { 0 } else { self.w_history().end };
        start..start + self.features.candidate() * self.gates()
    }

    /// `U`.
    pub fn u(self) -> Range<usize> {
        let start = self.w_candidate().end;
        start..start + self.hidden * self.gates()
    }

    /// `b`.
    pub fn b(self) -> Range<usize> {
        let start = self.u().end;
        start..start + self.gates()
    }

    /// `v`.
    pub fn v(self) -> Range<usize> {
        let start = self.b().end;
        start..start + self.hidden
    }

    /// Index of `v0`.
    pub fn v0(self) -> usize {
        self.v().end
    }

    /// Number of parameters.
    pub fn parameters(self) -> usize {
        self.v0() + 1
    }
}

/// The network: its shape and its parameters in the order that [`GruShape`] says.
#[derive(Clone, Debug, PartialEq)]
pub struct Gru {
    /// Sizes.
    pub shape: GruShape,
    /// `[shape.parameters()]`.
    pub theta: Vec<f32>,
}

/// Sequences of one gradient step, the longest history first.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// `[sum of rows per step, S]`: for each step all sequences that have begun.
    x_history: Vec<f32>,
    /// `[sequences, C]`.
    x_candidate: Vec<f32>,
    /// First row of each step in the concatenation over steps, and the end.
    rows: [usize; STEPS + 1],
    /// The caller's number of each sequence.
    order: Vec<u32>,
}

impl Batch {
    /// Takes sequences, given as (history rows, candidate) by `get` for each of `chosen`; a history
    /// is `[length, S]`, length `1..=HISTORY`, `S` the width that `features` give it.
    ///
    /// Sequences end together and begin when their history does. Sorted by length, those that have
    /// begun are the first rows of every step: nothing is masked, nothing computed in vain.
    pub fn gather<'a>(
        &mut self,
        features: Features,
        chosen: &[u32],
        get: impl Fn(u32) -> (&'a [f32], &'a [f32]),
    ) {
        let width = features.step();
        self.order.clear();
        self.order.extend_from_slice(chosen);
        self.order.sort_by_key(|i| std::cmp::Reverse(get(*i).0.len()));
        self.x_history.clear();
        self.x_candidate.clear();
        for step in 0..HISTORY {
            self.rows[step] = self.x_history.len() / width;
            for i in &self.order {
                let (history, _) = get(*i);
                let length = history.len() / width;
                let Some(at) = (step + length).checked_sub(HISTORY) else { break };
                self.x_history.extend_from_slice(&history[at * width..(at + 1) * width]);
            }
        }
        self.rows[HISTORY] = self.x_history.len() / width;
        self.rows[STEPS] = self.rows[HISTORY] + self.order.len();
        for i in &self.order {
            self.x_candidate.extend_from_slice(get(*i).1);
        }
    }

    /// The caller's number of each row.
    pub fn order(&self) -> &[u32] {
        &self.order
    }
}

/// What the forward pass leaves for the backward pass, and its memory.
#[derive(Clone, Debug, Default)]
pub struct Tape {
    /// `[rows, 3 H]`: r, z, c after their activations.
    gates: Vec<f32>,
    /// `[rows, H]`: state before the step.
    before: Vec<f32>,
    /// `[rows, H]`: r * state before.
    reset: Vec<f32>,
    /// `[sequences, H]`: state after the candidate.
    last: Vec<f32>,
    /// `[sequences]`.
    logits: Vec<f32>,
    d_gates: Vec<f32>,
    d_state: Vec<f32>,
    d_reset: Vec<f32>,
}

impl Tape {
    /// Logit of every row of the batch.
    pub fn logits(&self) -> &[f32] {
        &self.logits
    }
}

impl Gru {
    /// Random parameters: uniform in `1 / sqrt(H)` for what the state multiplies and in
    /// `sqrt(3 / inputs)` for what the inputs do, biases zero.
    pub fn random(shape: GruShape, rng: &mut fastrand::Rng) -> Self {
        let mut theta = vec![0.0; shape.parameters()];
        let mut fill = |range: Range<usize>, bound: f32| {
            theta[range].iter_mut().for_each(|v| *v = (rng.f32() * 2.0 - 1.0) * bound);
        };
        let state = 1.0 / (shape.hidden as f32).sqrt();
        fill(shape.w_history(), (1.0 / shape.features.step() as f32).sqrt());
        if !shape.shares_w() {
            fill(shape.w_candidate(), (1.0 / shape.features.candidate() as f32).sqrt());
        }
        fill(shape.u(), state);
        fill(shape.v(), state);
        Self { shape, theta }
    }

    /// One part of the parameters.
    pub fn part(&self, range: Range<usize>) -> &[f32] {
        &self.theta[range]
    }

    /// Logits of every sequence of `batch` into `tape`.
    pub fn forward(&self, batch: &Batch, tape: &mut Tape) {
        let (shape, h, g) = (self.shape, self.shape.hidden, self.shape.gates());
        let [step_width, candidate_width] = [shape.features.step(), shape.features.candidate()];
        let sequences = batch.order.len();
        let [history, total] = [batch.rows[HISTORY], batch.rows[STEPS]];
        tape.gates.clear();
        (0..total).for_each(|_| tape.gates.extend_from_slice(self.part(shape.b())));
        tape.before.clear();
        tape.before.resize(total * h, 0.0);
        tape.reset.resize(total * h, 0.0);
        tape.last.resize(sequences * h, 0.0);

        // The inputs of all steps at once; only the state is sequential.
        let (of_history, of_candidate) = tape.gates.split_at_mut(history * g);
        let (x, w) = (View::rows(&batch.x_history, step_width), View::rows(self.part(shape.w_history()), g));
        gemm((history, step_width, g), x, w, 1.0, of_history, g);
        let (x, w) =
            (View::rows(&batch.x_candidate, candidate_width), View::rows(self.part(shape.w_candidate()), g));
        gemm((sequences, candidate_width, g), x, w, 1.0, of_candidate, g);

        let u = self.part(shape.u());
        for step in 0..STEPS {
            let (start, end) = (batch.rows[step], batch.rows[step + 1]);
            let rows = end - start;
            let gates = &mut tape.gates[start * g..end * g];
            let (upto, beyond) = tape.before.split_at_mut(end * h);
            let before = &upto[start * h..];
            let reset = &mut tape.reset[start * h..end * h];
            gemm((rows, h, 2 * h), View::rows(before, h), View::rows(u, g), 1.0, gates, g);
            for ((gates, before), reset) in
                gates.chunks_exact_mut(g).zip(before.chunks_exact(h)).zip(reset.chunks_exact_mut(h))
            {
                sigmoid_all(&mut gates[..2 * h]);
                for ((reset, r), before) in reset.iter_mut().zip(&gates[..h]).zip(before) {
                    *reset = r * before;
                }
            }
            if rows > 0 {
                gemm(
                    (rows, h, h),
                    View::rows(reset, h),
                    View::rows(&u[2 * h..], g),
                    1.0,
                    &mut gates[2 * h..],
                    g,
                );
            }
            let after = if step + 1 < STEPS { &mut beyond[..rows * h] } else { &mut tape.last[..] };
            for ((gates, before), after) in
                gates.chunks_exact_mut(g).zip(before.chunks_exact(h)).zip(after.chunks_exact_mut(h))
            {
                let (rz, c) = gates.split_at_mut(2 * h);
                tanh_all(c);
                for (((after, before), z), c) in after.iter_mut().zip(before).zip(&rz[h..]).zip(&*c) {
                    *after = before + z * (c - before);
                }
            }
        }
        let (v, v0) = (self.part(shape.v()), self.theta[shape.v0()]);
        tape.logits.clear();
        tape.logits.extend(
            tape.last.chunks_exact(h).map(|last| last.iter().zip(v).map(|(a, b)| a * b).sum::<f32>() + v0),
        );
    }

    /// Adds to `gradient` the gradient of a loss whose derivative by the logit of row `i` is
    /// `d_logits[i]`. `tape` is [`Gru::forward`]'s for the same batch and parameters.
    ///
    /// # Panics
    /// When `d_logits` or `gradient` has a wrong length.
    pub fn backward(&self, batch: &Batch, tape: &mut Tape, d_logits: &[f32], gradient: &mut [f32]) {
        let (shape, h, g) = (self.shape, self.shape.hidden, self.shape.gates());
        assert_eq!(d_logits.len(), batch.order.len(), "one derivative a sequence");
        assert_eq!(gradient.len(), shape.parameters(), "one gradient a parameter");
        let [history, total] = [batch.rows[HISTORY], batch.rows[STEPS]];
        let [step_width, candidate_width] = [shape.features.step(), shape.features.candidate()];
        let sequences = batch.order.len();
        tape.d_gates.resize(total * g, 0.0);
        tape.d_reset.resize(sequences * h, 0.0);
        tape.d_state.clear();
        for (d, last) in d_logits.iter().zip(tape.last.chunks_exact(h)) {
            tape.d_state.extend(self.part(shape.v()).iter().map(|v| d * v));
            for (gradient, last) in gradient[shape.v()].iter_mut().zip(last) {
                *gradient += d * last;
            }
            gradient[shape.v0()] += d;
        }

        let u = self.part(shape.u());
        for step in (0..STEPS).rev() {
            let (start, end) = (batch.rows[step], batch.rows[step + 1]);
            let rows = end - start;
            if rows == 0 {
                break;
            }
            let gates = &tape.gates[start * g..end * g];
            let before = &tape.before[start * h..end * h];
            let d_gates = &mut tape.d_gates[start * g..end * g];
            // Sequences that begin later lie beyond `rows`: their state before is a constant.
            let d_state = &mut tape.d_state[..rows * h];
            let d_reset = &mut tape.d_reset[..rows * h];
            for row in 0..rows {
                let (r_z, c) = gates[row * g..(row + 1) * g].split_at(2 * h);
                let z = &r_z[h..];
                let (d_rz, d_c) = d_gates[row * g..(row + 1) * g].split_at_mut(2 * h);
                let d_z = &mut d_rz[h..];
                let before = &before[row * h..(row + 1) * h];
                let d_state = &mut d_state[row * h..(row + 1) * h];
                for i in 0..h {
                    d_c[i] = d_state[i] * z[i] * (1.0 - c[i] * c[i]);
                    d_z[i] = d_state[i] * (c[i] - before[i]) * z[i] * (1.0 - z[i]);
                    d_state[i] *= 1.0 - z[i];
                }
            }
            let u_c = View::transposed(&u[2 * h..], g);
            gemm((rows, h, h), View::rows(&d_gates[2 * h..], g), u_c, 0.0, d_reset, h);
            for row in 0..rows {
                let r = &gates[row * g..row * g + h];
                let d_r = &mut d_gates[row * g..row * g + h];
                let before = &before[row * h..(row + 1) * h];
                let d_reset = &d_reset[row * h..(row + 1) * h];
                let d_state = &mut d_state[row * h..(row + 1) * h];
                for i in 0..h {
                    d_state[i] += d_reset[i] * r[i];
                    d_r[i] = d_reset[i] * before[i] * r[i] * (1.0 - r[i]);
                }
            }
            gemm((rows, 2 * h, h), View::rows(d_gates, g), View::transposed(u, g), 1.0, d_state, h);
        }

        let d_gates = &tape.d_gates[..total * g];
        let (of_history, of_candidate) = d_gates.split_at(history * g);
        let x = View::transposed(&batch.x_history, step_width);
        gemm(
            (step_width, history, g),
            x,
            View::rows(of_history, g),
            1.0,
            &mut gradient[shape.w_history()],
            g,
        );
        let x = View::transposed(&batch.x_candidate, candidate_width);
        let d_w = &mut gradient[shape.w_candidate()];
        gemm((candidate_width, sequences, g), x, View::rows(of_candidate, g), 1.0, d_w, g);
        let d_u = &mut gradient[shape.u()];
        gemm((h, total, 2 * h), View::transposed(&tape.before, h), View::rows(d_gates, g), 1.0, d_u, g);
        if total > 0 {
            let d_c = View::rows(&d_gates[2 * h..], g);
            gemm((h, total, h), View::transposed(&tape.reset, h), d_c, 1.0, &mut d_u[2 * h..], g);
        }
        let d_b = &mut gradient[shape.b()];
        for row in d_gates.chunks_exact(g) {
            d_b.iter_mut().zip(row).for_each(|(b, d)| *b += d);
        }
    }

    /// Weighted binary cross-entropy of one batch, summed, and its gradient added to `gradient`,
    /// both times `scale`. `target` gives (label, weight) for a caller's number.
    pub fn loss(
        &self,
        batch: &Batch,
        tape: &mut Tape,
        target: impl Fn(u32) -> (f32, f32),
        scale: f32,
        gradient: &mut [f32],
    ) -> f64 {
        self.forward(batch, tape);
        let mut loss = 0.0;
        let mut d_logits = Vec::with_capacity(batch.order.len());
        for (i, logit) in batch.order.iter().zip(&tape.logits) {
            let (label, weight) = target(*i);
            d_logits.push((sigmoid(*logit) - label) * weight * scale);
            loss += f64::from(weight * scale) * cross_entropy(*logit, label);
        }
        self.backward(batch, tape, &d_logits, gradient);
        loss
    }
}

/// Binary cross-entropy of a logit against a label in `[0, 1]`, in nats; finite for every logit.
pub(super) fn cross_entropy(logit: f32, label: f32) -> f64 {
    let (x, y) = (f64::from(logit), f64::from(label));
    x.max(0.0) - x * y + (-x.abs()).exp().ln_1p()
}
