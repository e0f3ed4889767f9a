//! Boxes by their place along the picture's width: a track looks at those within its reach, not at all.

use crate::types::BBox;

/// Boxes, each with a number of its owner's choice, sorted by the centre's x.
#[derive(Clone, Debug, Default)]
pub struct Nearby {
    /// Centre's x, number, box.
    sorted: Vec<(f64, usize, BBox)>,
    widest: f64,
}

impl Nearby {
    /// Takes other boxes and keeps the memory.
    pub fn fill(&mut self, boxes: impl Iterator<Item = (usize, BBox)>) {
        self.sorted.clear();
        self.sorted.extend(boxes.map(|(number, bbox)| (bbox.cx(), number, bbox)));
        self.sorted.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        self.widest = self.sorted.iter().map(|(.., bbox)| bbox.w).fold(0.0, f64::max);
    }

    /// Number of boxes.
    pub fn len(&self) -> usize {
        self.sorted.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.sorted.is_empty()
    }

    /// Writes the numbers of all boxes whose centre is at most `reach` (pixels, horizontally) from `x` to
    /// `numbers`, which is emptied first; in increasing order.
    pub fn within(&self, x: f64, reach: f64, numbers: &mut Vec<usize>) {
        numbers.clear();
        numbers.extend(self.slice(x, reach).iter().map(|(_, number, _)| *number));
        numbers.sort_unstable();
    }

    /// As [`Nearby::within`] of all boxes that may overlap `bbox`.
    pub fn touching(&self, bbox: &BBox, numbers: &mut Vec<usize>) {
        self.within(bbox.cx(), self.touch(bbox), numbers);
    }

    /// Every box that may overlap `bbox`, by x.
    pub fn boxes_touching(&self, bbox: &BBox) -> impl Iterator<Item = (usize, &BBox)> {
        self.slice(bbox.cx(), self.touch(bbox)).iter().map(|(_, number, bbox)| (*number, bbox))
    }

    /// How far from the centre of `bbox` the centre of a box may be that overlaps it; a little more, for rounding.
    fn touch(&self, bbox: &BBox) -> f64 {
        (bbox.w + self.widest) * 0.5 + 1e-6 * (1.0 + bbox.cx().abs())
    }

    fn slice(&self, x: f64, reach: f64) -> &[(f64, usize, BBox)] {
        let start = self.sorted.partition_point(|(cx, ..)| *cx < x - reach);
        let end = self.sorted.partition_point(|(cx, ..)| *cx <= x + reach);
        &self.sorted[start..end.max(start)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn boxes() -> impl Strategy<Value = Vec<BBox>> {
        let one = (-50.0f64..500.0, 0.0f64..100.0, 1.0f64..80.0, 1.0f64..80.0);
        prop::collection::vec(one.prop_map(|(x, y, w, h)| BBox::new(x, y, w, h)), 0..30)
    }

    proptest! {
        #[test]
        fn nothing_that_overlaps_is_missed(all in boxes(), probe in boxes()) {
            let mut nearby = Nearby::default();
            nearby.fill(all.iter().copied().enumerate());
            let mut found = vec![];
            for bbox in &probe {
                nearby.touching(bbox, &mut found);
                prop_assert!(found.windows(2).all(|pair| pair[0] < pair[1]));
                for (i, other) in all.iter().enumerate() {
                    prop_assert!(other.iou(bbox) == 0.0 || found.contains(&i));
                }
                nearby.within(bbox.x, 40.0, &mut found);
                let right: Vec<usize> =
                    (0..all.len()).filter(|i| (all[*i].cx() - bbox.x).abs() <= 40.0).collect();
                prop_assert_eq!(&found, &right);
                nearby.within(bbox.x, f64::INFINITY, &mut found);
                prop_assert_eq!(found.len(), all.len());
            }
        }
    }
}
