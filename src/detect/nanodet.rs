//! NanoDet (and NanoDet-Plus exports of the same shape): `[A, C + 44]`, class scores already sigmoid,
//! then the distances to left, top, right and bottom as distributions over 0..=10 strides
//! (Generalised Focal Loss, Li et al. 2020).

use super::decode::{Level, Wanted};
use super::nms::Candidate;

const BINS: usize = 11;
/// Values beside the classes.
pub(super) const EXTRA: usize = 4 * BINS;

pub(super) fn decode(
    output: &[f32],
    grid: impl Iterator<Item = Level>,
    wanted: &Wanted,
    found: &mut Vec<Candidate>,
) {
    let classes = wanted.classes.len();
    let mut rows = output.chunks_exact(classes + EXTRA);
    for level in grid {
        for (column, row) in level.points() {
            let Some(values) = rows.next() else { return };
            let (scores, distances) = values.split_at(classes);
            let Some((class, score)) = wanted.best(scores.iter().copied()) else { continue };
            let mut distance = [0.0; 4];
            for (distance, logits) in distance.iter_mut().zip(distances.chunks_exact(BINS)) {
                *distance = expectation(logits) * level.stride;
            }
            let (x, y) = ((column + 0.5) * level.stride, (row + 0.5) * level.stride);
            let [left, top, right, bottom] = distance;
            found.push(Candidate { corners: [x - left, y - top, x + right, y + bottom], score, class });
        }
    }
}

/// The mean of the distribution that the logits give over 0, 1, …
fn expectation(logits: &[f32]) -> f32 {
    let most = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let (mut sum, mut weighted) = (0.0, 0.0);
    for (bin, logit) in logits.iter().enumerate() {
        let weight = (logit - most).exp();
        sum += weight;
        weighted += weight * bin as f32;
    }
    weighted / sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_around_one_point() {
        // A 16x8 input with stride 8: two points. The second sees class 1.
        let level = Level { stride: 8.0, columns: 2, rows: 1 };
        let mut output = vec![0.0; 2 * (2 + EXTRA)];
        let point = &mut output[2 + EXTRA..];
        point[..2].copy_from_slice(&[0.3, 0.8]);
        // Distributions sure of 1, 0, halfway between 2 and 3, and 10 strides.
        for (side, bins) in [vec![1], vec![0], vec![2, 3], vec![10]].into_iter().enumerate() {
            for bin in bins {
                point[2 + side * BINS + bin] = 50.0;
            }
        }
        let all = Wanted { threshold: 0.5, classes: vec![true, true] };
        let mut found = vec![];
        decode(&output, [level].into_iter(), &all, &mut found);
        assert_eq!(found.len(), 1);
        let Candidate { corners, score, class } = found[0];
        assert_eq!((score, class), (0.8, 1));
        for (value, expected) in corners.into_iter().zip([12.0 - 8.0, 4.0, 12.0 + 20.0, 4.0 + 80.0]) {
            assert!((value - expected).abs() < 1e-4, "{corners:?}");
        }

        let only_first = Wanted { threshold: 0.25, classes: vec![true, false] };
        found.clear();
        decode(&output, [level].into_iter(), &only_first, &mut found);
        assert_eq!(found.iter().map(|c| (c.class, c.score)).collect::<Vec<_>>(), [(0, 0.3)]);
    }
}
