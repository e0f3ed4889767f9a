//! Whether a track's box shows its object now: a small network that decides what is output.
//!
//! A matched box may be a false alarm, and a box that was not matched for a moment may still cover a
//! person whom the detector missed. Rules by time alone get both wrong now and then. The network sees
//! how the track has lived and who stands before it; it sees neither place, size, speed nor detection
//! score, which differ from camera to camera.
//!
//! | index | value |
//! | --- | --- |
//! | 0 | seconds since the last match |
//! | 1 | `min(hits, 100)` |
//! | 2 | `ln(1 + hits)` |
//! | 3 | share of the frames since birth in which it was matched |
//! | 4 | distance of the box to the picture's border in widths of the box, -1 to 3 |
//! | 5 | largest IoU with a matched, believed track |
//! | 6 | largest share of the box that a matched, believed track covers whose foot is lower |
//! | 7 | running mean of the innovations' length, heights |
//! | 8 | 1 when matched now |
//! | 9 | `ln(std_x / h)` of the filter |
//! | 10 | seconds for which it has been matched in every frame, at most 2 |
//! | 11 | link probability of the last match |
//! | 12 | `ln(1 + seconds since birth)` |
//! | 13 | share of the believed tracks that the detector finds here |
//! | 14 | share of the births that are confirmed here |

use std::fmt;
use std::str::FromStr;

use super::record::DetectorRecord;
use super::tracklet::Tracklet;
use crate::types::BBox;

/// Values that the network sees of a track.
pub const EXISTENCE_FEATURES: usize = 15;

/// Normalised values are clipped at this many standard deviations.
const CLIP: f32 = 4.0;

/// Widest layer: what a box passes through stays on the stack.
const MAX_WIDTH: usize = 64;
/// A wrong file must not ask for memory without end.
const MAX_LAYERS: usize = 8;

/// One fully connected layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Dense {
    /// `[inputs, outputs]`, row-major.
    pub weights: Vec<f32>,
    /// `[outputs]`.
    pub bias: Vec<f32>,
}

/// A multilayer perceptron over z-scored values, `tanh` between its layers, a logit at its end.
#[derive(Clone, Debug, PartialEq)]
pub struct ExistenceHead {
    mean: [f32; EXISTENCE_FEATURES],
    scale: [f32; EXISTENCE_FEATURES],
    layers: Vec<Dense>,
}

/// What is no network.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HeadError {
    /// A layer that does not fit.
    #[error("layer {layer}: {reason}")]
    Layer {
        /// Counted from 0.
        layer: usize,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A text that is no network.
    #[error("value {at}: {reason}")]
    Text {
        /// Counted from 0.
        at: usize,
        /// What is wrong with it.
        reason: &'static str,
    },
}

impl ExistenceHead {
    /// A network of `layers` over `(value - mean) * scale`.
    ///
    /// # Errors
    /// Layers that do not fit each other, do not end in one output, or hold a number that is not finite.
    pub fn new(
        mean: [f32; EXISTENCE_FEATURES],
        scale: [f32; EXISTENCE_FEATURES],
        layers: Vec<Dense>,
    ) -> Result<Self, HeadError> {
        let mut width = EXISTENCE_FEATURES;
        for (layer, Dense { weights, bias }) in layers.iter().enumerate() {
            let wrong = |reason| Err(HeadError::Layer { layer, reason });
            if bias.is_empty() || weights.len() != width * bias.len() {
                return wrong("its weights do not fit the layer before it and its own bias");
            }
            if bias.len() > MAX_WIDTH {
                return wrong("it is wider than 64");
            }
            if !weights.iter().chain(bias).all(|v| v.is_finite()) {
                return wrong("it holds a number that is not finite");
            }
            width = bias.len();
        }
        if layers.is_empty() || width != 1 {
            return Err(HeadError::Layer { layer: layers.len(), reason: "the last must have one output" });
        }
        if !mean.iter().chain(&scale).all(|v| v.is_finite()) {
            return Err(HeadError::Layer { layer: 0, reason: "a mean or scale is not finite" });
        }
        Ok(Self { mean, scale, layers })
    }

    /// Subtracted from the values.
    pub fn mean(&self) -> &[f32; EXISTENCE_FEATURES] {
        &self.mean
    }

    /// Multiplied with them.
    pub fn scale(&self) -> &[f32; EXISTENCE_FEATURES] {
        &self.scale
    }

    /// The layers, the first one first.
    pub fn layers(&self) -> &[Dense] {
        &self.layers
    }

    /// The values as the layers see them.
    pub fn normalise(&self, features: &[f32; EXISTENCE_FEATURES]) -> [f32; EXISTENCE_FEATURES] {
        std::array::from_fn(|i| ((features[i] - self.mean[i]) * self.scale[i]).clamp(-CLIP, CLIP))
    }

    /// Log-odds that the box shows its object.
    pub fn logit(&self, features: &[f32; EXISTENCE_FEATURES]) -> f32 {
        let (mut values, mut next) = ([0.0; MAX_WIDTH], [0.0; MAX_WIDTH]);
        values[..EXISTENCE_FEATURES].copy_from_slice(&self.normalise(features));
        for (depth, Dense { weights, bias }) in self.layers.iter().enumerate() {
            let next = &mut next[..bias.len()];
            next.copy_from_slice(bias);
            for (value, row) in values.iter().zip(weights.chunks_exact(bias.len())) {
                next.iter_mut().zip(row).for_each(|(sum, weight)| *sum += value * weight);
            }
            if depth + 1 < self.layers.len() {
                next.iter_mut().for_each(|value| *value = value.tanh());
            }
            values[..bias.len()].copy_from_slice(next);
        }
        values[0]
    }
}

/// Numbers apart by blanks: the layers' widths from the input on, 0, then means, scales, and each
/// layer's weights and bias. Reading it gives the same network to the bit.
impl fmt::Display for ExistenceHead {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{EXISTENCE_FEATURES}")?;
        self.layers.iter().try_for_each(|layer| write!(f, " {}", layer.bias.len()))?;
        write!(f, " 0")?;
        let layers = self.layers.iter().flat_map(|layer| layer.weights.iter().chain(&layer.bias));
        self.mean.iter().chain(&self.scale).chain(layers).try_for_each(|value| write!(f, " {value}"))
    }
}

impl FromStr for ExistenceHead {
    type Err = HeadError;

    fn from_str(text: &str) -> Result<Self, HeadError> {
        let mut words = text.split_whitespace().enumerate();
        let mut widths = vec![];
        loop {
            let (at, word) = words.next().ok_or(HeadError::Text { at: 0, reason: "the text ends early" })?;
            match word.parse::<usize>() {
                Ok(0) => break,
                Ok(width) if width <= MAX_WIDTH && widths.len() <= MAX_LAYERS => widths.push(width),
                _ => return Err(HeadError::Text { at, reason: "no width of a layer" }),
            }
        }
        if widths.first() != Some(&EXISTENCE_FEATURES) {
            return Err(HeadError::Text { at: 0, reason: "the network is for other features" });
        }
        let mut take = |count: usize| -> Result<Vec<f32>, HeadError> {
            let values = words
                .by_ref()
                .take(count)
                .map(|(at, word)| word.parse().map_err(|_| HeadError::Text { at, reason: "no number" }));
            let values = values.collect::<Result<Vec<f32>, _>>()?;
            if values.len() < count {
                return Err(HeadError::Text { at: values.len(), reason: "the text ends early" });
            }
            Ok(values)
        };
        let mut each = [[0.0; EXISTENCE_FEATURES]; 2];
        for row in &mut each {
            row.copy_from_slice(&take(EXISTENCE_FEATURES)?);
        }
        let layers = widths
            .windows(2)
            .map(|pair| Ok(Dense { weights: take(pair[0] * pair[1])?, bias: take(pair[1])? }));
        let layers = layers.collect::<Result<Vec<_>, HeadError>>()?;
        if let Some((at, _)) = words.next() {
            return Err(HeadError::Text { at, reason: "the text goes on behind the network" });
        }
        Self::new(each[0], each[1], layers)
    }
}

/// The tracks of a frame whose matches have been applied, seen together.
pub struct Scene<'a> {
    tracks: &'a [Tracklet],
    boxes: Vec<BBox>,
    /// Tracks that may cover others: matched and believed.
    solid: Vec<usize>,
    size: (f64, f64),
    record: DetectorRecord,
}

impl<'a> Scene<'a> {
    /// `tracks` in a picture of `size` (width, height), of a camera whose detector has this `record`.
    pub fn new(tracks: &'a [Tracklet], size: (f64, f64), record: DetectorRecord) -> Self {
        let solid = (0..tracks.len()).filter(|&i| tracks[i].matched && tracks[i].confirmed).collect();
        Self { tracks, boxes: tracks.iter().map(Tracklet::bbox).collect(), solid, size, record }
    }

    /// The values of a track, by its index.
    pub fn features(&self, index: usize) -> [f32; EXISTENCE_FEATURES] {
        let (track, b) = (&self.tracks[index], &self.boxes[index]);
        let (mut overlap, mut covered) = (0.0f64, 0.0f64);
        for other in self.solid.iter().filter(|other| **other != index).map(|other| &self.boxes[*other]) {
            let common = b.intersection(other);
            if common > 0.0 {
                overlap = overlap.max(common / (b.area() + other.area() - common));
                if other.bottom() > b.bottom() {
                    covered = covered.max(common / b.area());
                }
            }
        }
        let hits = f64::from(track.hits);
        let (width, height) = self.size;
        let border = b.x.min(b.y).min(width - b.right()).min(height - b.bottom()) / b.w;
        let streak = track.matched_since.map_or(0.0, |since| track.time.since(since));
        [
            track.missed_for(),
            hits.min(100.0),
            hits.ln_1p(),
            hits / f64::from(track.frames),
            border.clamp(-1.0, 3.0),
            overlap,
            covered,
            track.mean_innovation,
            f64::from(u8::from(track.matched)),
            (track.filter.variances()[0].sqrt() / b.h).ln(),
            streak.min(2.0),
            track.link,
            track.time.since(track.born).ln_1p(),
            self.record.recall(),
            self.record.precision(),
        ]
        .map(|v| v as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn computes_what_it_says() {
        // tanh(2 x0 - x8) * 3 + 0.5, over (x - 1) * 0.5 of the first value.
        let mut weights = vec![0.0; EXISTENCE_FEATURES];
        (weights[0], weights[8]) = (2.0, -1.0);
        let layers = vec![Dense { weights, bias: vec![0.0] }, Dense { weights: vec![3.0], bias: vec![0.5] }];
        let (mut mean, mut scale) = ([0.0; EXISTENCE_FEATURES], [1.0; EXISTENCE_FEATURES]);
        (mean[0], scale[0]) = (1.0, 0.5);
        let head = ExistenceHead::new(mean, scale, layers).unwrap();
        let mut x = [0.0; EXISTENCE_FEATURES];
        (x[0], x[8]) = (1.5, 1.0);
        assert!((head.logit(&x) - (3.0 * (0.5f32 - 1.0).tanh() + 0.5)).abs() < 1e-6);
        assert_eq!(head.to_string().parse::<ExistenceHead>().unwrap(), head);
        // Beyond the clip nothing changes.
        x[0] = 100.0;
        assert!((head.logit(&x) - (3.0 * (8.0f32 - 1.0).tanh() + 0.5)).abs() < 1e-6);
    }

    #[test]
    fn layers_must_fit() {
        let new = |layers| ExistenceHead::new([0.0; EXISTENCE_FEATURES], [1.0; EXISTENCE_FEATURES], layers);
        let first =
            |outputs| Dense { weights: vec![0.0; EXISTENCE_FEATURES * outputs], bias: vec![0.0; outputs] };
        for (layers, expected) in [
            (vec![], "one output"),
            (vec![first(2)], "one output"),
            (vec![first(2), Dense { weights: vec![0.0], bias: vec![0.0] }], "do not fit"),
            (vec![first(65)], "wider than 64"),
            (vec![Dense { weights: vec![f32::NAN; EXISTENCE_FEATURES], bias: vec![0.0] }], "not finite"),
        ] {
            let error = new(layers).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
        assert!(new(vec![first(1)]).is_ok());
    }

    #[test]
    fn texts_that_are_no_network_are_refused() {
        let zeros = "0 ".repeat(2 * EXISTENCE_FEATURES + EXISTENCE_FEATURES + 1);
        for (text, expected) in [
            (String::new(), "ends early"),
            (format!("{EXISTENCE_FEATURES} x"), "value 1: no width"),
            (format!("12 1 0 {zeros}"), "other features"),
            (format!("{EXISTENCE_FEATURES} 1 0 1 2 3"), "ends early"),
            (format!("{EXISTENCE_FEATURES} 1 0 {zeros} 7"), "goes on"),
            (format!("{EXISTENCE_FEATURES} 2 0 {zeros} {zeros}"), "goes on"),
            (format!("{EXISTENCE_FEATURES} 1 0 b {zeros}"), "value 3: no number"),
        ] {
            let error = text.parse::<ExistenceHead>().unwrap_err().to_string();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
        assert!(format!("{EXISTENCE_FEATURES} 1 0 {zeros}").parse::<ExistenceHead>().is_ok());
    }
}
