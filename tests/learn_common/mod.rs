//! Synthetic link requests whose labels depend on the history and the candidate.

use gakp::learn::{Examples, LinkModel};
use gakp::track::{Features, HISTORY, LinkRequest, Pair};

/// One of each kind; the last is the paper's spatial features alone.
pub const FEATURES: [Features; 4] = [
    Features::Relative,
    Features::Appearance { embedding: 7 },
    Features::Literal { embedding: 9 },
    Features::Literal { embedding: 0 },
];

fn normal(rng: &mut fastrand::Rng) -> f32 {
    (0..12).map(|_| rng.f32()).sum::<f32>() - 6.0
}

/// A request of random features on different scales, histories of every length.
pub fn request(features: Features, tracks: usize, pairs: usize, rng: &mut fastrand::Rng) -> LinkRequest {
    let mut request = LinkRequest { features, ..LinkRequest::default() };
    for t in 0..tracks {
        let length = 1 + t % HISTORY;
        request.lengths.push(length as i32);
        for step in 0..HISTORY {
            for feature in 0..features.step() {
                let value = normal(rng) * (feature + 1) as f32 * 0.3 + feature as f32;
                request.histories.push(if step < length { value } else { 0.0 });
            }
        }
    }
    for p in 0..pairs {
        request.pairs.push(Pair { track: rng.u32(0..tracks as u32), detection: p as u32 });
        for feature in 0..features.candidate() {
            request.candidates.push(normal(rng) * (feature + 1) as f32 * 0.2 - feature as f32);
        }
    }
    request
}

/// Whether the candidate agrees with what the track did first: only a network that carries the
/// state from the history's first step to the candidate can tell.
pub fn label(request: &LinkRequest, pair: usize) -> bool {
    let first = request.histories[request.pairs[pair].track as usize * HISTORY * request.features.step() + 3];
    let candidate = request.candidates[pair * request.features.candidate() + 3];
    (first - 3.0) * (candidate + 3.0) > 0.0
}

/// Examples of `requests` random requests.
pub fn examples(features: Features, requests: usize, rng: &mut fastrand::Rng) -> Examples {
    let mut examples = Examples::of(features);
    for _ in 0..requests {
        let request = request(features, 7, 20, rng);
        examples.push(&request, |pair| Some((label(&request, pair), 0.5 + rng.f32())));
    }
    examples
}

/// An untrained model with biases that are not zero.
pub fn model(hidden: usize, examples: &Examples, rng: &mut fastrand::Rng) -> LinkModel {
    let mut model = LinkModel::random(hidden, examples, rng);
    model.gru.theta.iter_mut().for_each(|v| *v += 0.1 * (rng.f32() - 0.5));
    model
}
