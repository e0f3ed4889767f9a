//! A dense table of truth boxes by track boxes, and their overlaps.

use std::ops::{Index, IndexMut};

use crate::types::BBox;

/// Row-major `rows x cols`.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Matrix {
    pub rows: usize,
    pub cols: usize,
    pub values: Vec<f64>,
}

impl Matrix {
    pub fn zeros(rows: usize, cols: usize) -> Self {
        Self { rows, cols, values: vec![0.0; rows * cols] }
    }

    /// The rows and columns that are to be kept, in their order.
    pub fn select(&self, rows: &[usize], cols: &[usize]) -> Self {
        let values =
            rows.iter().flat_map(|&r| cols.iter().map(move |&c| (r, c))).map(|at| self[at]).collect();
        Self { rows: rows.len(), cols: cols.len(), values }
    }

    /// Every value passed through `f`, which also gets its place.
    pub fn map(&self, f: impl Fn((usize, usize), f64) -> f64) -> Self {
        let at = |i| (i / self.cols, i % self.cols);
        Self { values: self.values.iter().enumerate().map(|(i, v)| f(at(i), *v)).collect(), ..*self }
    }
}

impl Index<(usize, usize)> for Matrix {
    type Output = f64;

    fn index(&self, (row, col): (usize, usize)) -> &f64 {
        &self.values[row * self.cols + col]
    }
}

impl IndexMut<(usize, usize)> for Matrix {
    fn index_mut(&mut self, (row, col): (usize, usize)) -> &mut f64 {
        &mut self.values[row * self.cols + col]
    }
}

/// IoU of every pair.
///
/// Computed from the corners like TrackEval does, not by [`BBox::iou`]: `(x + w) - x` may differ from
/// `w` in the last bit, which decides at thresholds such as an IoU of exactly one half.
pub(super) fn overlaps(truth: &[BBox], tracks: &[BBox]) -> Matrix {
    let mut out = Matrix::zeros(truth.len(), tracks.len());
    let area = |b: &BBox| (b.right() - b.x) * (b.bottom() - b.y);
    for (row, a) in truth.iter().enumerate() {
        for (col, b) in tracks.iter().enumerate() {
            let w = (a.right().min(b.right()) - a.x.max(b.x)).max(0.0);
            let h = (a.bottom().min(b.bottom()) - a.y.max(b.y)).max(0.0);
            let union = area(a) + area(b) - w * h;
            if area(a) > f64::EPSILON && area(b) > f64::EPSILON && union > f64::EPSILON {
                out[(row, col)] = w * h / union;
            }
        }
    }
    out
}
