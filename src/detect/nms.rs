//! Non-maximum suppression: one box an object.

/// A box that a decoder found: corners `[x0, y0, x1, y1]` in pixels of the input.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Candidate {
    pub corners: [f32; 4],
    pub score: f32,
    pub class: u16,
}

/// Keeps the best of each group of boxes of one class that overlap by more than `iou`, greedily from
/// the highest score down. What is left is in the order of falling scores (equals keep their order).
pub(super) fn suppress(candidates: &mut Vec<Candidate>, iou: f32) {
    candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut kept = 0;
    for index in 0..candidates.len() {
        let candidate = candidates[index];
        let better = &candidates[..kept];
        if better.iter().all(|b| b.class != candidate.class || overlap(b.corners, candidate.corners) <= iou) {
            candidates[kept] = candidate;
            kept += 1;
        }
    }
    candidates.truncate(kept);
}

/// Intersection over union.
fn overlap(a: [f32; 4], b: [f32; 4]) -> f32 {
    let width = a[2].min(b[2]) - a[0].max(b[0]);
    let height = a[3].min(b[3]) - a[1].max(b[1]);
    if width <= 0.0 || height <= 0.0 {
        return 0.0;
    }
    let area = |c: [f32; 4]| (c[2] - c[0]) * (c[3] - c[1]);
    let both = width * height;
    both / (area(a) + area(b) - both)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn candidate(x: f32, score: f32, class: u16) -> Candidate {
        Candidate { corners: [x, 0.0, x + 10.0, 20.0], score, class }
    }

    #[test]
    fn the_best_of_a_group_stays() {
        let mut found = vec![
            candidate(1.0, 0.5, 0),
            candidate(0.0, 0.9, 0),
            candidate(0.5, 0.7, 1),
            candidate(30.0, 0.6, 0),
            candidate(4.0, 0.8, 0), // overlaps the best by 6/14 only
        ];
        suppress(&mut found, 0.5);
        let scores: Vec<f32> = found.iter().map(|c| c.score).collect();
        assert_eq!(scores, [0.9, 0.8, 0.7, 0.6]);
    }

    proptest! {
        #[test]
        fn no_two_overlap_and_nothing_else_goes(
            boxes in prop::collection::vec((0f32..50.0, 0f32..50.0, 1f32..30.0, 1f32..30.0, 0f32..1.0, 0u16..2), 0..40)
        ) {
            let all: Vec<Candidate> = boxes
                .iter()
                .map(|&(x, y, w, h, score, class)| Candidate { corners: [x, y, x + w, y + h], score, class })
                .collect();
            let mut kept = all.clone();
            suppress(&mut kept, 0.4);
            for (i, a) in kept.iter().enumerate() {
                for b in &kept[..i] {
                    prop_assert!(a.class != b.class || overlap(a.corners, b.corners) <= 0.4);
                    prop_assert!(b.score >= a.score);
                }
            }
            for gone in all.iter().filter(|c| !kept.contains(c)) {
                prop_assert!(kept.iter().any(|k| k.class == gone.class
                    && k.score >= gone.score
                    && overlap(k.corners, gone.corners) > 0.4));
            }
        }
    }
}
