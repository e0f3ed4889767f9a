//! Assignment: the Hungarian problem by shortest augmenting paths (Jonker-Volgenant's scheme,
//! Crouse 2016, "On implementing 2D rectangular assignment algorithms").

/// Solves the rectangular assignment problem: picks `min(rows, cols)` entries, one a row and column
/// at most, with the least total cost. `cost` is row-major `rows x cols` and must be finite.
///
/// Returns for every row its column (`None` where rows outnumber columns). Among equal totals it takes
/// the one that scipy's `linear_sum_assignment` takes: the figures of `mot` depend on that, so the order
/// of the search and of the floating-point operations is part of the contract. Time `O(rows^2 cols)` for
/// `rows <= cols`.
///
/// # Panics
/// When `cost.len() != rows * cols`.
pub fn assign(cost: &[f64], rows: usize, cols: usize) -> Vec<Option<usize>> {
    assert_eq!(cost.len(), rows * cols, "cost matrix of {rows} x {cols}");
    debug_assert!(cost.iter().all(|c| c.is_finite()), "costs are finite");
    if rows > cols {
        let transposed: Vec<f64> =
            (0..cols).flat_map(|c| (0..rows).map(move |r| (r, c))).map(|(r, c)| cost[r * cols + c]).collect();
        let mut col_of = vec![None; rows];
        for (c, r) in assign(&transposed, cols, rows).into_iter().enumerate() {
            if let Some(r) = r {
                col_of[r] = Some(c);
            }
        }
        return col_of;
    }
    const FREE: usize = usize::MAX;
    let mut row_price = vec![0.0; rows];
    let mut col_price = vec![0.0; cols];
    let mut col_of = vec![FREE; rows];
    let mut row_of = vec![FREE; cols];
    let mut shortest = vec![0.0; cols];
    let mut from_row = vec![FREE; cols];
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
                let reduced = length + cost[row * cols + col] - row_price[row] - col_price[col];
                if reduced < shortest[col] {
                    shortest[col] = reduced;
                    from_row[col] = row;
                }
                // Among equals a free column ends the search, the last one looked at.
                if shortest[col] < least || (shortest[col] == least && row_of[col] == FREE) {
                    least = shortest[col];
                    at = i;
                }
            }
            length = least;
            let col = columns[at];
            open -= 1;
            columns.swap(at, open);
            if row_of[col] == FREE {
                break col;
            }
            row = row_of[col];
        };
        row_price[start] += length;
        for &col in &columns[open..] {
            if row_of[col] != FREE {
                row_price[row_of[col]] += length - shortest[col];
            }
            col_price[col] -= length - shortest[col];
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
    col_of.into_iter().map(|c| (c != FREE).then_some(c)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn total(cost: &[f64], cols: usize, picked: &[Option<usize>]) -> f64 {
        picked.iter().enumerate().filter_map(|(r, c)| c.map(|c| cost[r * cols + c])).sum()
    }

    /// Least total by trying every assignment.
    fn brute_force(cost: &[f64], rows: usize, cols: usize) -> f64 {
        fn go(cost: &[f64], rows: usize, cols: usize, row: usize, used: &mut [bool], skips: usize) -> f64 {
            if row == rows {
                return 0.0;
            }
            let mut best = f64::INFINITY;
            if skips > 0 {
                best = go(cost, rows, cols, row + 1, used, skips - 1);
            }
            for col in 0..cols {
                if !used[col] {
                    used[col] = true;
                    best = best.min(cost[row * cols + col] + go(cost, rows, cols, row + 1, used, skips));
                    used[col] = false;
                }
            }
            best
        }
        go(cost, rows, cols, 0, &mut vec![false; cols], rows.saturating_sub(cols))
    }

    proptest! {
        #[test]
        fn equals_brute_force((rows, cols, cost) in (0usize..6, 0usize..6).prop_flat_map(|(r, c)| {
            (Just(r), Just(c), prop::collection::vec((-20i32..20).prop_map(f64::from), r * c))
        })) {
            let picked = assign(&cost, rows, cols);
            prop_assert_eq!(picked.iter().flatten().count(), rows.min(cols));
            let mut columns: Vec<_> = picked.iter().flatten().collect();
            columns.sort();
            columns.dedup();
            prop_assert_eq!(columns.len(), rows.min(cols));
            if rows > 0 && cols > 0 {
                prop_assert!((total(&cost, cols, &picked) - brute_force(&cost, rows, cols)).abs() < 1e-9);
            }
        }
    }
}
