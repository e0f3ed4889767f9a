//! YOLOX: `[A, 5 + C]` on a grid: centre offset in strides, log of the size in strides, objectness
//! and class scores, both already sigmoid (Ge et al. 2021).

use super::decode::{Level, Wanted};
use super::nms::Candidate;

/// Values beside the classes.
pub(super) const EXTRA: usize = 5;

pub(super) fn decode(
    output: &[f32],
    grid: impl Iterator<Item = Level>,
    wanted: &Wanted,
    found: &mut Vec<Candidate>,
) {
    let mut rows = output.chunks_exact(wanted.classes.len() + EXTRA);
    for level in grid {
        for (column, row) in level.points() {
            let Some(values) = rows.next() else { return };
            let objectness = values[4];
            // A class score is at most 1.
            if objectness < wanted.threshold {
                continue;
            }
            let scores = values[EXTRA..].iter().map(|score| score * objectness);
            let Some((class, score)) = wanted.best(scores) else { continue };
            let (x, y) = ((column + values[0]) * level.stride, (row + values[1]) * level.stride);
            let (w, h) = (values[2].exp() * level.stride, values[3].exp() * level.stride);
            let corners = [x - w / 2.0, y - h / 2.0, x + w / 2.0, y + h / 2.0];
            found.push(Candidate { corners, score, class });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_on_the_second_level() {
        let grid = [Level { stride: 8.0, columns: 2, rows: 2 }, Level { stride: 16.0, columns: 1, rows: 1 }];
        let mut output = vec![0.0; 5 * 6];
        output[4 * 6..].copy_from_slice(&[0.25, 0.5, 2f32.ln(), 4f32.ln(), 0.9, 0.8]);
        let wanted = Wanted { threshold: 0.5, classes: vec![true] };
        let mut found = vec![];
        decode(&output, grid.into_iter(), &wanted, &mut found);
        assert_eq!(found.len(), 1);
        let Candidate { corners, score, class } = found[0];
        assert_eq!(class, 0);
        assert!((score - 0.72).abs() < 1e-6);
        for (value, expected) in corners.into_iter().zip([4.0 - 16.0, 8.0 - 32.0, 4.0 + 16.0, 8.0 + 32.0]) {
            assert!((value - expected).abs() < 1e-4, "{corners:?}");
        }
        let strict = Wanted { threshold: 0.75, classes: vec![true] };
        found.clear();
        decode(&output, grid.into_iter(), &strict, &mut found);
        assert!(found.is_empty());
    }
}
