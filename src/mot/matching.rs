//! One-to-one matching of the boxes of a frame.

use super::matrix::Matrix;
use crate::track::assign::assign;

/// Pairs `(row, col)` in the order of the rows, `min(rows, cols)` of them, with the greatest sum of
/// scores.
pub(super) fn best_pairs(scores: &Matrix) -> Vec<(usize, usize)> {
    let Matrix { rows, cols, values } = scores;
    let cost: Vec<f64> = values.iter().map(|v| -v).collect();
    let picked = assign(&cost, *rows, *cols);
    picked.into_iter().enumerate().filter_map(|(row, col)| Some((row, col?))).collect()
}
