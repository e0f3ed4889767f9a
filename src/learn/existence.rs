//! Training the existence head on what the tracker itself puts out.
//!
//! The tracker runs as it does in the service, without a head. Every box of a confirmed track, matched or
//! coasted, is an example: a positive when it overlaps a person of the truth by half or more, one to one,
//! matched boxes first. Boxes on what the benchmark does not count (people on vehicles, reflections) are
//! left out.

use super::activate::sigmoid;
use super::adam::{Adam, Schedule};
use super::dataset::{LabelledFrame, LabelledSequence};
use crate::mot::Row;
use crate::track::existence::Scene;
use crate::track::{
    Dense, EXISTENCE_FEATURES, ExistenceHead, FrameInput, LinkRequest, Tracker, TrackerConfig,
};
use crate::types::BBox;

/// Least IoU of a box that shows a person.
const MATCH_IOU: f64 = 0.5;

/// MOT16's and MOT17's classes on which a box counts neither as right nor as wrong: person on a vehicle,
/// static person, distractor, reflection.
const NEUTRAL: [i32; 4] = [2, 7, 8, 12];

/// Boxes that the tracker could put out, and whether they should be.
#[derive(Clone, Debug, Default)]
pub struct Boxes {
    features: Vec<[f32; EXISTENCE_FEATURES]>,
    labels: Vec<f32>,
}

impl Boxes {
    /// Number of boxes.
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// Share of positives.
    pub fn positive_share(&self) -> f64 {
        self.labels.iter().map(|l| f64::from(*l)).sum::<f64>() / self.len().max(1) as f64
    }

    /// Tracks `sequence` with `config` and `score`, and adds its boxes. `truth` is that of its frames, the
    /// first one numbered 1.
    pub fn collect(
        &mut self,
        sequence: &LabelledSequence,
        truth: &[Row],
        config: &TrackerConfig,
        mut score: impl FnMut(&LinkRequest) -> Vec<f32>,
    ) {
        let mut people: Vec<Vec<BBox>> = vec![vec![]; sequence.frames.len()];
        let mut neutral = people.clone();
        for row in truth {
            let counted = row.conf != 0.0 && row.class.is_none_or(|class| class == 1);
            let to = match row.class {
                _ if counted => &mut people,
                Some(class) if NEUTRAL.contains(&class) => &mut neutral,
                _ => continue,
            };
            if let Some(frame) = to.get_mut((row.frame as usize).wrapping_sub(1)) {
                frame.push(row.bbox);
            }
        }
        let (width, height) = (sequence.width, sequence.height);
        let mut tracker = Tracker::new(config.clone());
        let mut request = LinkRequest::default();
        for ((frame, people), neutral) in sequence.frames.iter().zip(&people).zip(&neutral) {
            let LabelledFrame { time, detections, embeddings, .. } = frame;
            let input = FrameInput { time: *time, width, height, detections, embeddings, shift: None };
            tracker.predict(input, &mut request);
            let links = if request.is_empty() { vec![] } else { score(&request) };
            if tracker.update(&links).is_err() {
                continue;
            }
            let scene = Scene::new(tracker.tracks(), (width, height), tracker.record());
            let believed = tracker.tracks().iter().enumerate().filter(|(_, track)| track.confirmed);
            let (shown, values): (Vec<(BBox, bool)>, Vec<_>) =
                believed.map(|(index, track)| ((track.bbox(), track.matched), scene.features(index))).unzip();
            for ((right, values), (bbox, _)) in labels(&shown, people).into_iter().zip(values).zip(&shown) {
                if right || neutral.iter().all(|n| n.iou(bbox) < MATCH_IOU) {
                    self.features.push(values);
                    self.labels.push(f32::from(u8::from(right)));
                }
            }
        }
    }
}

/// Whether each box (and whether it was matched) shows a person.
fn labels(shown: &[(BBox, bool)], people: &[BBox]) -> Vec<bool> {
    let mut right = vec![false; shown.len()];
    let mut taken = vec![false; people.len()];
    for matched in [true, false] {
        let mut pairs: Vec<(f64, usize, usize)> = vec![];
        for (index, (bbox, _)) in shown.iter().enumerate().filter(|(_, (_, m))| *m == matched) {
            pairs.extend(people.iter().enumerate().map(|(person, p)| (p.iou(bbox), index, person)));
        }
        pairs.retain(|(iou, ..)| *iou >= MATCH_IOU);
        pairs.sort_by(|a, b| b.0.total_cmp(&a.0));
        for (_, index, person) in pairs {
            if !right[index] && !taken[person] {
                (right[index], taken[person]) = (true, true);
            }
        }
    }
    right
}

/// How to train a head.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadFit {
    /// Width of the two hidden layers.
    pub hidden: usize,
    /// Passes over the boxes.
    pub epochs: usize,
    /// Boxes a gradient step.
    pub batch: usize,
    /// Highest learning rate of Adam.
    pub rate: f32,
    /// Seed of the initial weights and of the order of boxes.
    pub seed: u64,
}

impl Default for HeadFit {
    fn default() -> Self {
        Self { hidden: 12, epochs: 12, batch: 256, rate: 0.005, seed: 1 }
    }
}

/// Trains a head on `boxes` by binary cross-entropy. The same boxes and settings give the same
/// bits.
///
/// # Panics
/// When there is no box, or a setting is zero.
pub fn fit_head(boxes: &Boxes, settings: &HeadFit) -> ExistenceHead {
    assert!(!boxes.is_empty() && settings.batch > 0 && settings.hidden > 0 && settings.epochs > 0);
    let mut rng = fastrand::Rng::with_seed(settings.seed);
    let (mean, scale) = z_score(&boxes.features);
    let widths = [EXISTENCE_FEATURES, settings.hidden, settings.hidden, 1];
    let layers = widths.windows(2).map(|pair| {
        let bound = 1.7 / (pair[0] as f32).sqrt();
        let weights = (0..pair[0] * pair[1]).map(|_| (rng.f32() * 2.0 - 1.0) * bound).collect();
        Dense { weights, bias: vec![0.0; pair[1]] }
    });
    let mut layers: Vec<Dense> = layers.collect();
    let head = |layers: &[Dense]| {
        ExistenceHead::new(mean, scale, layers.to_vec()).expect("training keeps weights finite")
    };
    let inputs: Vec<_> = {
        let start = head(&layers);
        boxes.features.iter().map(|values| start.normalise(values)).collect()
    };
    let parameters = layers.iter().map(|layer| layer.weights.len() + layer.bias.len()).sum();
    let mut adam = Adam::new(parameters);
    let steps = settings.epochs * boxes.len().div_ceil(settings.batch);
    let schedule = Schedule { peak: settings.rate, warm_up: steps / 20 + 1, steps };
    let mut order: Vec<usize> = (0..boxes.len()).collect();
    let (mut theta, mut gradient) = (flat(&layers), vec![0.0; parameters]);
    let mut activations = vec![];
    let mut step = 0;
    for _ in 0..settings.epochs {
        rng.shuffle(&mut order);
        for batch in order.chunks(settings.batch) {
            gradient.fill(0.0);
            for &i in batch {
                let logit = forward(&layers, &inputs[i], &mut activations);
                let slope = (sigmoid(logit) - boxes.labels[i]) / batch.len() as f32;
                backward(&layers, &activations, slope, &mut gradient);
            }
            adam.step(&mut theta, &gradient, schedule.rate(step));
            unflatten(&theta, &mut layers);
            step += 1;
        }
    }
    head(&layers)
}

fn z_score(rows: &[[f32; EXISTENCE_FEATURES]]) -> ([f32; EXISTENCE_FEATURES], [f32; EXISTENCE_FEATURES]) {
    let count = rows.len() as f64;
    let mean: [f64; EXISTENCE_FEATURES] =
        std::array::from_fn(|i| rows.iter().map(|row| f64::from(row[i])).sum::<f64>() / count);
    let scale = std::array::from_fn(|i| {
        let variance = rows.iter().map(|row| (f64::from(row[i]) - mean[i]).powi(2)).sum::<f64>() / count;
        if variance > 1e-8 { (1.0 / variance.sqrt()) as f32 } else { 1.0 }
    });
    (mean.map(|v| v as f32), scale)
}

fn flat(layers: &[Dense]) -> Vec<f32> {
    layers.iter().flat_map(|layer| layer.weights.iter().chain(&layer.bias)).copied().collect()
}

fn unflatten(theta: &[f32], layers: &mut [Dense]) {
    let mut rest = theta;
    for Dense { weights, bias } in layers {
        for part in [weights, bias] {
            let (own, others) = rest.split_at(part.len());
            part.copy_from_slice(own);
            rest = others;
        }
    }
}

/// The logit; `activations` takes the input of every layer.
fn forward(layers: &[Dense], input: &[f32], activations: &mut Vec<Vec<f32>>) -> f32 {
    activations.resize(layers.len(), vec![]);
    activations[0].clear();
    activations[0].extend_from_slice(input);
    for (depth, Dense { weights, bias }) in layers.iter().enumerate() {
        let mut sums = bias.clone();
        for (value, row) in activations[depth].iter().zip(weights.chunks_exact(bias.len())) {
            sums.iter_mut().zip(row).for_each(|(sum, weight)| *sum += value * weight);
        }
        if depth + 1 == layers.len() {
            return sums[0];
        }
        activations[depth + 1] = sums.iter().map(|sum| sum.tanh()).collect();
    }
    0.0
}

/// Adds the gradient of a loss whose derivative by the logit is `slope`.
fn backward(layers: &[Dense], activations: &[Vec<f32>], slope: f32, gradient: &mut [f32]) {
    let mut end = gradient.len();
    let mut slopes = vec![slope];
    for (depth, Dense { weights, bias }) in layers.iter().enumerate().rev() {
        let start = end - weights.len() - bias.len();
        let (of_weights, of_bias) = gradient[start..end].split_at_mut(weights.len());
        of_bias.iter_mut().zip(&slopes).for_each(|(g, slope)| *g += slope);
        let mut before = Vec::with_capacity(activations[depth].len());
        let rows = weights.chunks_exact(bias.len()).zip(of_weights.chunks_exact_mut(bias.len()));
        for (value, (row, of_row)) in activations[depth].iter().zip(rows) {
            of_row.iter_mut().zip(&slopes).for_each(|(g, slope)| *g += value * slope);
            let sum: f32 = row.iter().zip(&slopes).map(|(weight, slope)| weight * slope).sum();
            // Of tanh; the input has no slope that anyone asks for.
            before.push(sum * (1.0 - value * value));
        }
        (slopes, end) = (before, start);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradient_equals_finite_differences() {
        let mut rng = fastrand::Rng::with_seed(3);
        let mut random = |count: usize| (0..count).map(|_| rng.f32() - 0.5).collect::<Vec<f32>>();
        let mut layers = vec![
            Dense { weights: random(5 * 4), bias: random(4) },
            Dense { weights: random(4), bias: random(1) },
        ];
        let input = random(5);
        let mut activations = vec![];
        forward(&layers, &input, &mut activations);
        let mut gradient = vec![0.0; 29];
        backward(&layers, &activations, 1.0, &mut gradient);
        let theta = flat(&layers);
        for i in 0..theta.len() {
            let mut at = |delta: f32| {
                let mut moved = theta.clone();
                moved[i] += delta;
                unflatten(&moved, &mut layers);
                forward(&layers, &input, &mut vec![])
            };
            let slope = (at(1e-2) - at(-1e-2)) / 2e-2;
            assert!((slope - gradient[i]).abs() < 1e-3, "{i}: {slope} is not {}", gradient[i]);
        }
    }

    #[test]
    fn a_matched_box_comes_before_a_coasted_one() {
        let person = |x: f64| BBox::new(x, 0.0, 40.0, 100.0);
        let shown = [(person(0.0), false), (person(5.0), true), (person(300.0), true)];
        assert_eq!(labels(&shown, &[person(0.0)]), [false, true, false]);
        assert_eq!(labels(&shown, &[person(0.0), person(4.0)]), [true, true, false]);
    }

    #[test]
    fn learns_a_rule() {
        let mut rng = fastrand::Rng::with_seed(5);
        let mut boxes = Boxes::default();
        for _ in 0..4000 {
            let values: [f32; EXISTENCE_FEATURES] = std::array::from_fn(|_| rng.f32());
            boxes.labels.push(f32::from(u8::from(values[0] + values[7] > 1.0)));
            boxes.features.push(values);
        }
        let settings = HeadFit { epochs: 20, ..HeadFit::default() };
        let head = fit_head(&boxes, &settings);
        let right = boxes.features.iter().zip(&boxes.labels);
        let right = right.filter(|(values, label)| (head.logit(values) > 0.0) == (**label > 0.5)).count();
        assert!(right > 3900, "{right} of 4000");
        assert_eq!(fit_head(&boxes, &settings), head);
    }
}
