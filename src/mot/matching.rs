//! One-to-one matching of the boxes of a frame, with scipy's choice among equals.
//!
//! Truth files hold the same box twice here and there (a pedestrian and a static person in
//! MOT17-05), and then two matchings have the same total. Which one is taken shows in the figures: it
//! decides whether a result is dropped as a distractor's. TrackEval takes what scipy's
//! `linear_sum_assignment` returns, so this solver follows scipy's order of search, where
//! [`crate::track::assign`] promises no order. Sums that are rounded differently would break ties
//! differently too: the order of the floating-point operations below is part of the contract.

use super::matrix::Matrix;

/// Pairs `(row, col)` in the order of the rows, `min(rows, cols)` of them, with the greatest sum of
/// scores; among equals those that scipy takes.
pub(super) fn best_pairs(scores: &Matrix) -> Vec<(usize, usize)> {
    let Matrix { rows, cols, ref values } = *scores;
    if rows <= cols {
        let cost: Vec<f64> = values.iter().map(|v| -v).collect();
        return solve(&cost, rows, cols).into_iter().enumerate().collect();
    }
    let cost: Vec<f64> = (0..rows * cols).map(|i| -scores[(i % rows, i / rows)]).collect();
    let mut pairs: Vec<_> =
        solve(&cost, cols, rows).into_iter().enumerate().map(|(col, row)| (row, col)).collect();
    pairs.sort_unstable();
    pairs
}

const NONE: usize = usize::MAX;

/// Column of every row at the least total cost, for `rows <= cols`: shortest augmenting paths (Crouse
/// 2016) with the columns looked at from the last to the first.
fn solve(cost: &[f64], rows: usize, cols: usize) -> Vec<usize> {
    let mut u = vec![0.0; rows];
    let mut v = vec![0.0; cols];
    let mut col_of = vec![NONE; rows];
    let mut row_of = vec![NONE; cols];
    let mut shortest = vec![0.0; cols];
    let mut from_row = vec![NONE; cols];
    // Columns that the search has not reached, then those that it has, the latest first.
    let mut columns: Vec<usize> = Vec::with_capacity(cols);
    for start in 0..rows {
        shortest.fill(f64::INFINITY);
        columns.clear();
        columns.extend((0..cols).rev());
        let mut open = cols;
        let (mut row, mut length) = (start, 0.0);
        let sink = loop {
            let (mut at, mut least) = (0, f64::INFINITY);
            for (i, &col) in columns[..open].iter().enumerate() {
                let reduced = length + cost[row * cols + col] - u[row] - v[col];
                if reduced < shortest[col] {
                    shortest[col] = reduced;
                    from_row[col] = row;
                }
                // Among equals a free column ends the search, the last one looked at.
                if shortest[col] < least || (shortest[col] == least && row_of[col] == NONE) {
                    least = shortest[col];
                    at = i;
                }
            }
            length = least;
            let col = columns[at];
            open -= 1;
            columns.swap(at, open);
            if row_of[col] == NONE {
                break col;
            }
            row = row_of[col];
        };
        u[start] += length;
        for &col in &columns[open..] {
            if row_of[col] != NONE {
                u[row_of[col]] += length - shortest[col];
            }
            v[col] -= length - shortest[col];
        }
        let mut col = sink;
        loop {
            let row = from_row[col];
            row_of[col] = row;
            std::mem::swap(&mut col_of[row], &mut col);
            if row == start {
                break;
            }
        }
    }
    col_of
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::assign::assign;
    use proptest::prelude::*;

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

    proptest! {
        #[test]
        fn total_is_the_assignment_problems((rows, cols, values) in (0usize..8, 0usize..8).prop_flat_map(|(r, c)| {
            (Just(r), Just(c), prop::collection::vec(-3i32..6, r * c))
        })) {
            let scores = matrix(rows, cols, &values);
            let pairs = best_pairs(&scores);
            prop_assert_eq!(pairs.len(), rows.min(cols));
            let mut used: Vec<_> = pairs.iter().map(|pair| pair.1).collect();
            used.sort_unstable();
            used.dedup();
            prop_assert_eq!(used.len(), pairs.len());
            prop_assert!(pairs.windows(2).all(|pair| pair[0].0 < pair[1].0));
            let cost: Vec<f64> = scores.values.iter().map(|v| -v).collect();
            let best: f64 = assign(&cost, rows, cols).iter().enumerate()
                .filter_map(|(r, c)| c.map(|c| scores[(r, c)])).sum();
            let total: f64 = pairs.iter().map(|&at| scores[at]).sum();
            prop_assert!((total - best).abs() < 1e-9, "{} is not {}", total, best);
        }
    }
}
