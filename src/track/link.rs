//! What the core asks of a link scorer: the probability that a detection continues a track.

use super::features::Features;

/// Observations of a track that a scorer sees, the oldest first (paper: sequence length 7 with the
/// candidate).
pub const HISTORY: usize = 6;

/// One gated pair: an index into the request's histories and one into the frame's detections.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Pair {
    /// Row of [`LinkRequest::histories`].
    pub track: u32,
    /// Index of the detection.
    pub detection: u32,
}

/// The gated pairs of one frame of one camera. Histories are given once a track, not once a pair.
///
/// Features are raw; the scorer normalises them. Row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LinkRequest {
    /// What the rows are.
    pub features: Features,
    /// `[tracks, HISTORY, features.step()]`: each track's observations packed from index 0 on, the
    /// oldest first; rows past its length are zero.
    pub histories: Vec<f32>,
    /// `[tracks]`: valid observations, `1..=HISTORY`.
    pub lengths: Vec<i32>,
    /// `[pairs, features.candidate()]`.
    pub candidates: Vec<f32>,
    /// `[pairs]`.
    pub pairs: Vec<Pair>,
}

impl LinkRequest {
    /// Whether there is nothing to score. A scorer is never called with an empty request.
    pub fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }

    /// Empties the request; what its rows are, and its memory, stay.
    pub fn clear(&mut self) {
        self.histories.clear();
        self.lengths.clear();
        self.candidates.clear();
        self.pairs.clear();
    }

    /// Number of tracks with a history.
    pub fn tracks(&self) -> usize {
        self.lengths.len()
    }
}
