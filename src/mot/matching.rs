//! One-to-one matching of the boxes of a frame, with scipy's choice among equals.
//!
//! Truth files hold the same box twice here and there (a pedestrian and a static person in
//! MOT17-05), and then two matchings have the same total. Which one is taken shows in the figures: it
//! decides whether a result is dropped as a distractor's. TrackEval takes what scipy's
//! `linear_sum_assignment` returns, and so does [`crate::track::assign`].

use super::matrix::Matrix;
use crate::track::assign::assign;

/// Pairs `(row, col)` in the order of the rows, `min(rows, cols)` of them, with the greatest sum of
/// scores; among equals those that scipy takes.
pub(super) fn best_pairs(scores: &Matrix) -> Vec<(usize, usize)> {
    let cost: Vec<f64> = scores.values.iter().map(|v| -v).collect();
    let columns = assign(&cost, scores.rows, scores.cols);
    columns.into_iter().enumerate().filter_map(|(row, col)| Some((row, col?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix(rows: usize, cols: usize, values: &[i32]) -> Matrix {
        Matrix { rows, cols, values: values.iter().map(|v| f64::from(*v)).collect() }
    }

    /// Expected pairs: `scipy.optimize.linear_sum_assignment(matrix, maximize=True)` of scipy 1.17.1.
    #[test]
    fn breaks_ties_as_scipy_does() {
        for (rows, cols, values, expected) in [
            (3, 3, &[1, 1, 1, 1, 1, 1, 1, 1, 1][..], vec![(0, 0), (1, 1), (2, 2)]),
            (2, 4, &[0, 0, 0, 0, 0, 0, 0, 0][..], vec![(0, 0), (1, 1)]),
            (4, 2, &[0, 0, 0, 0, 0, 0, 0, 0][..], vec![(0, 0), (1, 1)]),
            (3, 3, &[1, 1, 0, 1, 0, 1, 1, 0, 1][..], vec![(0, 1), (1, 2), (2, 0)]),
            (3, 3, &[0, 0, 0, 1, 0, 0, 0, 0, 0][..], vec![(0, 1), (1, 0), (2, 2)]),
            (
                4,
                4,
                &[0, 1, 0, 1, 1, 0, 0, 0, 0, 1, 0, 1, 1, 1, 0, 0][..],
                vec![(0, 1), (1, 0), (2, 3), (3, 2)],
            ),
            (
                4,
                4,
                &[1, 0, 1, 1, 1, 0, 1, 1, 1, 0, 0, 1, 0, 0, 0, 1][..],
                vec![(0, 0), (1, 2), (2, 3), (3, 1)],
            ),
            (
                4,
                4,
                &[0, 2, 1, 0, 1, 2, 2, 2, 0, 0, 2, 2, 2, 0, 0, 1][..],
                vec![(0, 1), (1, 2), (2, 3), (3, 0)],
            ),
            (
                4,
                4,
                &[1, 1, 2, 0, 1, 0, 0, 2, 0, 0, 0, 0, 0, 2, 1, 1][..],
                vec![(0, 2), (1, 3), (2, 0), (3, 1)],
            ),
            (3, 5, &[0, 1, 1, 0, 0, 0, 0, 1, 1, 1, 0, 1, 1, 0, 1][..], vec![(0, 1), (1, 2), (2, 4)]),
            (3, 5, &[0, 0, 1, 1, 0, 1, 1, 0, 0, 1, 1, 1, 0, 0, 1][..], vec![(0, 2), (1, 0), (2, 1)]),
            (5, 3, &[0, 1, 1, 0, 0, 1, 0, 1, 1, 1, 1, 0, 1, 0, 0][..], vec![(0, 1), (1, 2), (3, 0)]),
            (5, 3, &[1, 1, 0, 0, 1, 1, 1, 1, 0, 0, 1, 0, 0, 0, 0][..], vec![(0, 0), (1, 2), (2, 1)]),
            (
                5,
                5,
                &[0, 2, 2, 1, 0, 2, 0, 1, 0, 2, 2, 2, 1, 2, 1, 2, 0, 0, 1, 2, 1, 2, 2, 1, 1][..],
                vec![(0, 1), (1, 0), (2, 3), (3, 4), (4, 2)],
            ),
            (
                5,
                5,
                &[1, 1, 1, 1, 2, 2, 0, 1, 1, 0, 0, 2, 1, 1, 1, 1, 2, 1, 2, 1, 0, 0, 2, 1, 0][..],
                vec![(0, 4), (1, 0), (2, 1), (3, 3), (4, 2)],
            ),
            (
                4,
                6,
                &[2, 2, 0, 0, 2, 1, 1, 0, 0, 2, 2, 2, 1, 0, 0, 1, 2, 0, 1, 1, 1, 1, 2, 0][..],
                vec![(0, 0), (1, 3), (2, 4), (3, 1)],
            ),
            (
                4,
                6,
                &[2, 2, 2, 0, 1, 1, 0, 0, 2, 0, 2, 0, 1, 1, 0, 2, 1, 2, 0, 1, 1, 1, 0, 2][..],
                vec![(0, 0), (1, 2), (2, 3), (3, 5)],
            ),
            (
                6,
                4,
                &[1, 2, 0, 1, 0, 2, 1, 1, 2, 1, 2, 2, 1, 1, 0, 2, 2, 2, 1, 0, 2, 0, 2, 0][..],
                vec![(0, 1), (2, 0), (3, 3), (5, 2)],
            ),
            (
                6,
                4,
                &[0, 0, 1, 0, 0, 0, 2, 0, 0, 1, 0, 2, 2, 1, 1, 1, 2, 1, 0, 2, 0, 2, 1, 2][..],
                vec![(1, 2), (2, 3), (3, 0), (5, 1)],
            ),
            (
                6,
                6,
                &[
                    0, 0, 1, 1, 0, 0, 0, 1, 0, 0, 1, 1, 0, 1, 0, 1, 1, 1, 1, 0, 1, 0, 1, 0, 0, 0, 1, 1, 0, 0,
                    0, 1, 1, 0, 1, 1,
                ][..],
                vec![(0, 2), (1, 1), (2, 4), (3, 0), (4, 3), (5, 5)],
            ),
            (
                6,
                6,
                &[
                    0, 0, 1, 1, 0, 1, 1, 1, 1, 1, 1, 0, 1, 1, 1, 0, 0, 1, 0, 1, 1, 0, 0, 1, 1, 1, 1, 1, 0, 0,
                    1, 0, 0, 0, 0, 0,
                ][..],
                vec![(0, 2), (1, 4), (2, 1), (3, 5), (4, 3), (5, 0)],
            ),
            (
                5,
                7,
                &[
                    1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 1, 0, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1,
                    0, 0, 0, 1, 0,
                ][..],
                vec![(0, 5), (1, 2), (2, 3), (3, 0), (4, 1)],
            ),
            (
                5,
                7,
                &[
                    0, 0, 0, 0, 0, 1, 0, 1, 1, 0, 0, 1, 0, 1, 0, 1, 0, 0, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 0,
                    1, 1, 1, 0, 0,
                ][..],
                vec![(0, 5), (1, 0), (2, 1), (3, 3), (4, 2)],
            ),
            (
                7,
                5,
                &[
                    1, 1, 1, 0, 0, 1, 0, 0, 1, 1, 0, 1, 1, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1, 0,
                    1, 0, 0, 0, 1,
                ][..],
                vec![(0, 0), (1, 3), (2, 1), (3, 2), (6, 4)],
            ),
            (
                7,
                5,
                &[
                    0, 1, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 1, 0, 1, 1, 0, 0, 1, 0, 0, 1, 1, 0, 1, 0, 0, 1, 1,
                    0, 0, 0, 1, 1,
                ][..],
                vec![(0, 1), (1, 3), (3, 0), (4, 2), (5, 4)],
            ),
        ] {
            assert_eq!(best_pairs(&matrix(rows, cols, values)), expected, "{rows} x {cols} {values:?}");
        }
    }
}
