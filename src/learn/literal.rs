//! The association as the paper prints it: every pair from the start, one value at a time, in f64.
//!
//! Slow on purpose. It shares no code with the batched forward pass, so that tests can hold the two
//! against each other.

use super::model::{CLIP, LinkModel, Normaliser};
use crate::track::{HISTORY, LinkRequest};

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

fn normalised(normaliser: &Normaliser, row: &[f32]) -> Vec<f64> {
    let z = |(i, x): (usize, &f32)| {
        (f64::from(*x) - f64::from(normaliser.mean[i])) * f64::from(normaliser.scale[i])
    };
    row.iter().enumerate().map(z).map(|z| z.clamp(-f64::from(CLIP), f64::from(CLIP))).collect()
}

/// One step: `theta` and its layout as [`super::GruShape`] says, `w` the start of the input's rows.
fn step(theta: &[f64], hidden: usize, (w, u, b): (usize, usize, usize), x: &[f64], h: &[f64]) -> Vec<f64> {
    let gates = 3 * hidden;
    let pre = |column: usize, state: &dyn Fn(usize) -> f64| {
        let inputs: f64 = x.iter().enumerate().map(|(i, x)| x * theta[w + i * gates + column]).sum();
        let states: f64 = (0..hidden).map(|i| state(i) * theta[u + i * gates + column]).sum();
        inputs + states + theta[b + column]
    };
    let r: Vec<f64> = (0..hidden).map(|j| sigmoid(pre(j, &|i| h[i]))).collect();
    let z: Vec<f64> = (0..hidden).map(|j| sigmoid(pre(hidden + j, &|i| h[i]))).collect();
    let c: Vec<f64> = (0..hidden).map(|j| pre(2 * hidden + j, &|i| r[i] * h[i]).tanh()).collect();
    (0..hidden).map(|j| (1.0 - z[j]) * h[j] + z[j] * c[j]).collect()
}

/// Logit of one sequence of normalised inputs under parameters `theta`.
pub fn logit(model: &LinkModel, theta: &[f64], history: &[Vec<f64>], candidate: &[f64]) -> f64 {
    let (shape, hidden) = (model.gru.shape, model.gru.shape.hidden);
    let (u, b) = (shape.u().start, shape.b().start);
    let mut h = vec![0.0; hidden];
    for x in history {
        h = step(theta, hidden, (shape.w_history().start, u, b), x, &h);
    }
    h = step(theta, hidden, (shape.w_candidate().start, u, b), candidate, &h);
    h.iter().zip(&theta[shape.v()]).map(|(h, v)| h * v).sum::<f64>() + theta[shape.v0()]
}

/// Link probability of pair `pair` of `request`.
pub fn probability(model: &LinkModel, request: &LinkRequest, pair: usize) -> f64 {
    let theta: Vec<f64> = model.gru.theta.iter().map(|v| f64::from(*v)).collect();
    let track = request.pairs[pair].track as usize;
    let width = model.history.mean.len();
    let rows = &request.histories[track * HISTORY * width..];
    let history: Vec<Vec<f64>> = rows
        .chunks_exact(width)
        .take(request.lengths[track] as usize)
        .map(|row| normalised(&model.history, row))
        .collect();
    let width = model.candidate.mean.len();
    let candidate = normalised(&model.candidate, &request.candidates[pair * width..(pair + 1) * width]);
    sigmoid(logit(model, &theta, &history, &candidate))
}
