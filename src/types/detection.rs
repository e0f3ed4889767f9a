//! What a detector and a ReID model say about one frame.

use std::sync::Arc;

use super::{BBox, ClassId};

/// One detected object of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// Where, in pixels of the frame.
    pub bbox: BBox,
    /// The detector's score, in `[0, 1]`.
    pub score: f64,
    /// The detector's class; 0 is a person.
    pub class: ClassId,
}

impl Detection {
    /// A person at `bbox` with `score`.
    pub fn person(bbox: BBox, score: f64) -> Self {
        Self { bbox, score, class: ClassId::PERSON }
    }
}

/// An L2-normalised appearance vector of one detection. Its width is the ReID model's. Clones share it.
#[derive(Clone, Debug, PartialEq)]
pub struct Embedding(Arc<[f32]>);

impl Embedding {
    /// Normalises `values` to unit length. A vector without a usable length (zero, not finite)
    /// gives `None`: the detection then has no appearance.
    pub fn normalised(mut values: Vec<f32>) -> Option<Self> {
        let norm = values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        if !norm.is_finite() || norm < 1e-12 {
            return None;
        }
        values.iter_mut().for_each(|v| *v = (f64::from(*v) / norm) as f32);
        Some(Self(values.into()))
    }

    /// The values, unit length.
    pub fn as_slice(&self) -> &[f32] {
        &self.0
    }

    /// Cosine similarity in `[-1, 1]`; zero when the widths differ.
    pub fn cosine(&self, other: &Embedding) -> f64 {
        if self.0.len() != other.0.len() {
            return 0.0;
        }
        f64::from(self.0.iter().zip(&*other.0).map(|(a, b)| a * b).sum::<f32>())
    }

    /// Moves this embedding towards `other` by `weight` in `[0, 1]` and normalises it again.
    pub fn blend(&mut self, other: &Embedding, weight: f32) {
        if self.0.len() != other.0.len() {
            *self = other.clone();
            return;
        }
        let mixed = self.0.iter().zip(&*other.0).map(|(a, b)| a + (b - a) * weight).collect();
        if let Some(mixed) = Self::normalised(mixed) {
            *self = mixed;
        }
    }
}
