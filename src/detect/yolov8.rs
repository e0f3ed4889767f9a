//! YOLOv8 and its kin: `[4 + C, A]`, channels first: centre and size in input pixels, then class
//! scores, already sigmoid.

use super::decode::Wanted;
use super::nms::Candidate;

/// Values beside the classes.
pub(super) const EXTRA: usize = 4;

pub(super) fn decode(output: &[f32], points: usize, wanted: &Wanted, found: &mut Vec<Candidate>) {
    if points == 0 {
        return;
    }
    let (boxes, scores) = output.split_at(EXTRA * points);
    let first = found.len();
    // Class by class, as the memory lies; a point's better class replaces the one before.
    let mut at = vec![usize::MAX; points];
    for (class, row) in scores.chunks_exact(points).enumerate() {
        if !wanted.classes[class] {
            continue;
        }
        for (point, &score) in row.iter().enumerate() {
            if score < wanted.threshold {
                continue;
            }
            let class = class as u16;
            if at[point] == usize::MAX {
                at[point] = found.len();
                let [x, y, w, h] = [0, 1, 2, 3].map(|axis| boxes[axis * points + point]);
                let corners = [x - w / 2.0, y - h / 2.0, x + w / 2.0, y + h / 2.0];
                found.push(Candidate { corners, score, class });
            } else if score > found[at[point]].score {
                let better = &mut found[at[point]];
                (better.score, better.class) = (score, class);
            }
        }
    }
    debug_assert!(found.len() - first <= points);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_better_class_of_each_point() {
        // Three points, two classes: rows are cx, cy, w, h, class 0, class 1.
        #[rustfmt::skip]
        let output = [
            10.0, 20.0, 30.0,
            11.0, 21.0, 31.0,
             4.0,  6.0,  8.0,
             2.0,  2.0,  2.0,
             0.9,  0.1,  0.6,
             0.2,  0.1,  0.7,
        ];
        let wanted = Wanted { threshold: 0.5, classes: vec![true, true] };
        let mut found = vec![];
        decode(&output, 3, &wanted, &mut found);
        assert_eq!(
            found,
            [
                Candidate { corners: [8.0, 10.0, 12.0, 12.0], score: 0.9, class: 0 },
                Candidate { corners: [26.0, 30.0, 34.0, 32.0], score: 0.7, class: 1 },
            ]
        );
        let second = Wanted { threshold: 0.1, classes: vec![false, true] };
        found.clear();
        decode(&output, 3, &second, &mut found);
        assert_eq!(found.iter().map(|c| c.class).collect::<Vec<_>>(), [1, 1, 1]);
    }
}
