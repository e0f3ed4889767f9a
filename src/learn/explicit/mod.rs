//! Explicit features whose weights a recurrent network predicts (Eq. cost_function).
//!
//! ```text
//! h      = GRU over the track's history                      (Eq. GRU)
//! lambda = softplus(h V + v)                                 positive weights
//! P      = sigmoid(b - sum_k lambda_k s_k f_k)               f: squared features, s: fixed scales
//! ```
//!
//! The paper minimises the cost of right pairs alone, which all weights at zero would do best; here
//! the cross-entropy of right and wrong pairs is minimised. The features are those of
//! [`crate::track::association::explicit`]. All is in f64, one example at a time: the network is small,
//! and a test holds this very code against finite differences.

mod fit;
mod scorer;

pub use fit::{fit_explicit, logits_explicit};
pub use scorer::ExplicitScorer;

use std::ops::Range;

use super::examples::Examples;
use super::model::Normaliser;
use crate::track::Features;
use crate::track::association::explicit::{BOX_COSTS, COSTS, costs};

/// Sizes of the network and where its parts lie in the parameter vector.
///
/// The parts, in order, row-major, for observations of `S` values and `K` costs: `W [S, 3 H]`,
/// `U [H, 3 H]`, `b [3 H]`, `V [H, K]`, `v [K]`, the bias of the logit `[1]`; the columns of a gate block
/// are `r`, `z`, `c`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ExplicitShape {
    /// What it reads; not [`Features::Literal`], whose rows lack what the costs are made of.
    pub features: Features,
    /// Width of the hidden state.
    pub hidden: usize,
}

impl ExplicitShape {
    fn gates(self) -> usize {
        3 * self.hidden
    }

    /// Number of costs that are weighed: without `df` where appearance is not seen.
    pub fn costs(self) -> usize {
        if self.features.see_appearance() { COSTS } else { BOX_COSTS }
    }

    /// `W`.
    pub fn w(self) -> Range<usize> {
        0..self.features.step() * self.gates()
    }

    /// `U`.
    pub fn u(self) -> Range<usize> {
        let start = self.w().end;
        start..start + self.hidden * self.gates()
    }

    /// `b`.
    pub fn b(self) -> Range<usize> {
        let start = self.u().end;
        start..start + self.gates()
    }

    /// `V`.
    pub fn v(self) -> Range<usize> {
        let start = self.b().end;
        start..start + self.hidden * self.costs()
    }

    /// `v`.
    pub fn v0(self) -> Range<usize> {
        let start = self.v().end;
        start..start + self.costs()
    }

    /// Index of the logit's bias.
    pub fn bias(self) -> usize {
        self.v0().end
    }

    /// Number of parameters.
    pub fn parameters(self) -> usize {
        self.bias() + 1
    }
}

/// The network with its normalisation.
#[derive(Clone, Debug, PartialEq)]
pub struct ExplicitModel {
    /// Of the history's steps.
    pub history: Normaliser,
    /// The scales `s` of the squared features: one over their mean for right pairs.
    pub scale: [f32; COSTS],
    /// Sizes.
    pub shape: ExplicitShape,
    /// `[shape.parameters()]`.
    pub theta: Vec<f32>,
}

impl ExplicitModel {
    /// A network of random parameters whose scales fit `examples`; it reads what these are made of.
    pub fn random(hidden: usize, examples: &Examples, rng: &mut fastrand::Rng) -> Self {
        let shape = ExplicitShape { features: examples.features(), hidden };
        let mut theta = vec![0.0; shape.parameters()];
        let mut fill = |range: Range<usize>, bound: f32| {
            theta[range].iter_mut().for_each(|v| *v = (rng.f32() * 2.0 - 1.0) * bound);
        };
        let state = 1.0 / (shape.hidden as f32).sqrt();
        fill(shape.w(), (1.0 / shape.features.step() as f32).sqrt());
        fill(shape.u(), state);
        fill(shape.v(), state);
        // Right pairs start with P = 0.5: weights of 0.5 each against a bias of 2.
        theta[shape.v0()].fill(-0.43);
        theta[shape.bias()] = 2.0;
        let mut sum = [0.0f64; COSTS];
        let mut count = 0.0;
        for (row, label) in examples.candidates().zip(examples.labels()) {
            if *label > 0.5 {
                costs(row).iter().zip(&mut sum).for_each(|(cost, sum)| *sum += f64::from(*cost));
                count += 1.0;
            }
        }
        let scale = sum.map(|sum| if sum > 1e-6 * count { (count / sum) as f32 } else { 1.0 });
        let history = Normaliser::measure(shape.features.step(), examples.history_steps());
        Self { history, scale, shape, theta }
    }

    /// Scaled squared features of a candidate row.
    pub fn features(&self, candidate: &[f32]) -> [f64; COSTS] {
        let found = costs(candidate);
        std::array::from_fn(|i| f64::from(found[i]) * f64::from(self.scale[i]))
    }

    /// The history as the network takes it.
    pub fn normalised(&self, history: &[f32]) -> Vec<f64> {
        let mut rows = history.to_vec();
        rows.chunks_exact_mut(self.history.mean.len()).for_each(|row| self.history.apply(row));
        rows.into_iter().map(f64::from).collect()
    }

    /// The parameters in f64.
    pub fn theta64(&self) -> Vec<f64> {
        self.theta.iter().map(|v| f64::from(*v)).collect()
    }
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// `ln(1 + e^x)`, finite for every x.
fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// What the forward pass leaves for the backward pass, and its memory.
#[derive(Clone, Debug, Default)]
pub struct Run {
    /// `[length, 3 H]`: r, z, c after their activations.
    gates: Vec<f64>,
    /// `[length + 1, H]`: states before each step, and the last.
    states: Vec<f64>,
    /// Before softplus.
    raw: [f64; COSTS],
    /// The weights `lambda`; 0 for a cost that is not weighed.
    pub weights: [f64; COSTS],
}

/// `y += x A` for a row-major `A` of `x.len()` rows `stride` apart; `y` is the first columns.
fn add_product(x: &[f64], a: &[f64], stride: usize, y: &mut [f64]) {
    for (x, row) in x.iter().zip(a.chunks(stride)) {
        y.iter_mut().zip(row).for_each(|(y, a)| *y += x * a);
    }
}

/// Encodes a normalised history; `run.weights` are the weights of its track.
pub fn encode(shape: ExplicitShape, theta: &[f64], history: &[f64], run: &mut Run) {
    let (h, g) = (shape.hidden, shape.gates());
    let (w, u) = (&theta[shape.w()], &theta[shape.u()]);
    run.gates.clear();
    run.states.clear();
    run.states.resize(h, 0.0);
    let mut reset = vec![0.0; h];
    for x in history.chunks_exact(shape.features.step()) {
        let at = run.gates.len();
        run.gates.extend_from_slice(&theta[shape.b()]);
        let gates = &mut run.gates[at..];
        let before = run.states.len() - h;
        add_product(x, w, g, gates);
        let (rz, c) = gates.split_at_mut(2 * h);
        add_product(&run.states[before..], u, g, rz);
        rz.iter_mut().for_each(|v| *v = sigmoid(*v));
        for i in 0..h {
            reset[i] = rz[i] * run.states[before + i];
        }
        add_product(&reset, &u[2 * h..], g, c);
        c.iter_mut().for_each(|v| *v = v.tanh());
        for i in 0..h {
            let state = run.states[before + i];
            run.states.push(state + rz[h + i] * (c[i] - state));
        }
    }
    let costs = shape.costs();
    run.raw[..costs].copy_from_slice(&theta[shape.v0()]);
    add_product(&run.states[run.states.len() - h..], &theta[shape.v()], costs, &mut run.raw[..costs]);
    run.weights = [0.0; COSTS];
    run.weights.iter_mut().zip(&run.raw[..costs]).for_each(|(weight, raw)| *weight = softplus(*raw));
}

/// Logit of a pair whose scaled features are `features`.
pub fn logit(shape: ExplicitShape, theta: &[f64], run: &Run, features: &[f64; COSTS]) -> f64 {
    theta[shape.bias()] - run.weights.iter().zip(features).map(|(weight, f)| weight * f).sum::<f64>()
}

/// Adds to `gradient` that of a loss whose derivative by the logit is `d_logit`; `run` is [`encode`]'s
/// for the same history and parameters.
pub fn backward(
    shape: ExplicitShape,
    theta: &[f64],
    (history, features): (&[f64], &[f64; COSTS]),
    run: &Run,
    d_logit: f64,
    gradient: &mut [f64],
) {
    let (h, g) = (shape.hidden, shape.gates());
    let u = &theta[shape.u()];
    gradient[shape.bias()] += d_logit;
    let d_raw: [f64; COSTS] = std::array::from_fn(|k| -d_logit * features[k] * sigmoid(run.raw[k]));
    gradient[shape.v0()].iter_mut().zip(&d_raw).for_each(|(g, d)| *g += d);
    let (width, costs) = (shape.features.step(), shape.costs());
    let steps = history.len() / width;
    let last = &run.states[steps * h..];
    let v = &theta[shape.v()];
    let mut d_state = vec![0.0; h];
    for i in 0..h {
        for k in 0..costs {
            d_state[i] += v[i * costs + k] * d_raw[k];
            gradient[shape.v().start + i * costs + k] += last[i] * d_raw[k];
        }
    }
    let mut d_gates = vec![0.0; g];
    for step in (0..steps).rev() {
        let before = &run.states[step * h..(step + 1) * h];
        let (rz, c) = run.gates[step * g..(step + 1) * g].split_at(2 * h);
        let (r, z) = rz.split_at(h);
        for i in 0..h {
            d_gates[2 * h + i] = d_state[i] * z[i] * (1.0 - c[i] * c[i]);
            d_gates[h + i] = d_state[i] * (c[i] - before[i]) * z[i] * (1.0 - z[i]);
            d_state[i] *= 1.0 - z[i];
        }
        for i in 0..h {
            let row = &u[i * g..(i + 1) * g];
            let d_reset: f64 = row[2 * h..].iter().zip(&d_gates[2 * h..]).map(|(u, d)| u * d).sum();
            d_state[i] += d_reset * r[i];
            d_gates[i] = d_reset * before[i] * r[i] * (1.0 - r[i]);
        }
        for i in 0..h {
            let row = &u[i * g..(i + 1) * g];
            d_state[i] += row[..2 * h].iter().zip(&d_gates).map(|(u, d)| u * d).sum::<f64>();
            let d_u = &mut gradient[shape.u()][i * g..(i + 1) * g];
            for (j, (d_u, d)) in d_u.iter_mut().zip(&d_gates).enumerate() {
                *d_u += d * before[i] * if j < 2 * h { 1.0 } else { r[i] };
            }
        }
        let x = &history[step * width..(step + 1) * width];
        for (x, d_w) in x.iter().zip(gradient[shape.w()].chunks_exact_mut(g)) {
            d_w.iter_mut().zip(&d_gates).for_each(|(d_w, d)| *d_w += x * d);
        }
        gradient[shape.b()].iter_mut().zip(&d_gates).for_each(|(b, d)| *b += d);
    }
}
