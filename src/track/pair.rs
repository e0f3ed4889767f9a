//! A gated pair of track and detection, and how alike they look.

use super::gate::PairGeometry;
use super::tracklet::Tracklet;
use crate::types::{BBox, Detection, Embedding};

/// Cosine of two people's embeddings: deep ReID networks give 0.4 to 0.5.
pub const STRANGERS: f64 = 0.4;

/// What is known of a gated pair.
#[derive(Clone, Copy, Debug)]
pub struct PairView<'a> {
    /// The track, predicted to the detection's time.
    pub track: &'a Tracklet,
    /// Its predicted box.
    pub predicted: &'a BBox,
    /// The detection.
    pub detection: &'a Detection,
    /// The detection's embedding.
    pub embedding: Option<&'a Embedding>,
    /// What the gate measured.
    pub geometry: &'a PairGeometry,
}

impl PairView<'_> {
    /// Cosine similarity of the track's mean embedding and the detection's, where both have one.
    pub fn cosine(&self) -> Option<f64> {
        Some(self.track.appearance.as_ref()?.cosine(self.embedding?))
    }

    /// How alike they look, `[0, 1]`: 0 at [`STRANGERS`] and below, 1 for equal embeddings.
    pub fn likeness(&self) -> Option<f64> {
        self.cosine().map(|cosine| ((cosine - STRANGERS) / (1.0 - STRANGERS)).clamp(0.0, 1.0))
    }
}
