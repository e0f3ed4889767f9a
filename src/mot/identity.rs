//! Identity measures (Ristani et al. 2016, "Performance Measures and a Data Set for Multi-Target,
//! Multi-Camera Tracking").

use super::matrix::Matrix;
use super::preprocess::Scene;
use crate::track::assign::assign;

/// Counts under the one matching of truth identities to tracks that is best over the whole sequence.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Identity {
    /// Boxes of matched identities that overlap by one half.
    pub tp: u64,
    /// Truth boxes that do not.
    pub fn_: u64,
    /// Result boxes that do not.
    pub fp: u64,
}

impl Identity {
    /// `2 IDTP / (truth boxes + result boxes)`.
    pub fn idf1(&self) -> f64 {
        self.tp as f64 / (self.tp as f64 + 0.5 * (self.fp + self.fn_) as f64).max(1.0)
    }

    /// `IDTP / result boxes`.
    pub fn idp(&self) -> f64 {
        self.tp as f64 / (self.tp + self.fp).max(1) as f64
    }

    /// `IDTP / truth boxes`.
    pub fn idr(&self) -> f64 {
        self.tp as f64 / (self.tp + self.fn_).max(1) as f64
    }

    pub(super) fn of(scene: &Scene) -> Self {
        // An unmatched identity costs all its boxes and a matched pair never more than its two halves
        // unmatched, so the least cost is the greatest sum of shared boxes. Tracks that share none
        // cannot add to it and get no column.
        const NONE: usize = usize::MAX;
        let mut column = vec![NONE; scene.track_counts.len()];
        let mut columns = 0;
        let shared = || {
            scene.frames.iter().flat_map(|frame| {
                let hit = |i: usize| frame.similarity.values[i] >= 0.5;
                let cols = frame.similarity.cols;
                let at = move |i| (frame.truth[i / cols], frame.tracks[i % cols]);
                (0..frame.similarity.values.len()).filter(move |&i| hit(i)).map(at)
            })
        };
        for (_, track) in shared() {
            if column[track] == NONE {
                column[track] = columns;
                columns += 1;
            }
        }
        let mut boxes = Matrix::zeros(scene.truth_counts.len(), columns);
        for (truth, track) in shared() {
            boxes[(truth, column[track])] += 1.0;
        }
        // Only the total counts, so it does not matter which of equal matchings is found.
        let cost: Vec<f64> = boxes.values.iter().map(|v| -v).collect();
        let picked = assign(&cost, boxes.rows, boxes.cols);
        let shared = picked.into_iter().enumerate().filter_map(|(truth, col)| Some(boxes[(truth, col?)]));
        let tp = shared.sum::<f64>() as u64;
        Self { tp, fn_: scene.truth_boxes() - tp, fp: scene.track_boxes() - tp }
    }

    pub(super) fn combine<'a>(parts: impl Iterator<Item = &'a Identity>) -> Self {
        parts.fold(Self::default(), |a, b| Self { tp: a.tp + b.tp, fn_: a.fn_ + b.fn_, fp: a.fp + b.fp })
    }
}
