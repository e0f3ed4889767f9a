//! Boxes by their place along the picture's width: a track looks at those within its reach, not at all.

use crate::types::BBox;

/// Boxes, each with a number of its owner's choice, sorted by the centre's x.
#[derive(Clone, Debug, Default)]
pub struct Nearby {
    /// Centre, number, box.
    sorted: Vec<([f64; 2], usize, BBox)>,
    /// The greatest width and the greatest height.
    largest: [f64; 2],
}

impl Nearby {
    /// Takes other boxes and keeps the memory.
    pub fn fill(&mut self, boxes: impl Iterator<Item = (usize, BBox)>) {
        self.sorted.clear();
        self.sorted.extend(boxes.map(|(number, bbox)| ([bbox.cx(), bbox.cy()], number, bbox)));
        self.sorted.sort_unstable_by(|a, b| a.0[0].total_cmp(&b.0[0]).then(a.1.cmp(&b.1)));
        self.largest = self
            .sorted
            .iter()
            .fold([0.0; 2], |[w, h], (.., bbox)| [f64::max(w, bbox.w), f64::max(h, bbox.h)]);
    }

    /// Number of boxes.
    pub fn len(&self) -> usize {
        self.sorted.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.sorted.is_empty()
    }

    /// Every box whose centre is at most `reach` from `centre`, `[x, y]`, pixels; by x.
    pub fn within(&self, centre: [f64; 2], reach: [f64; 2]) -> impl Iterator<Item = (usize, &BBox)> {
        let [x, y] = centre;
        let start = self.sorted.partition_point(|([cx, _], ..)| *cx < x - reach[0]);
        let near = self.sorted[start..].iter().take_while(move |([cx, _], ..)| *cx <= x + reach[0]);
        near.filter(move |([_, cy], ..)| (cy - y).abs() <= reach[1]).map(|(_, number, bbox)| (*number, bbox))
    }

    /// Every box that may overlap `bbox`, by x.
    pub fn touching(&self, bbox: &BBox) -> impl Iterator<Item = (usize, &BBox)> {
        self.within([bbox.cx(), bbox.cy()], self.reach(bbox))
    }

    /// How far from the centre of `bbox` the centre of a box may be that overlaps it, `[x, y]`.
    pub fn reach(&self, bbox: &BBox) -> [f64; 2] {
        let [w, h] = self.largest;
        // A little more, for rounding.
        let reach = |size: f64, at: f64| size * 0.5 + 1e-6 * (1.0 + at.abs());
        [reach(bbox.w + w, bbox.cx()), reach(bbox.h + h, bbox.cy())]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn boxes() -> impl Strategy<Value = Vec<BBox>> {
        let one = (-50.0f64..500.0, 0.0f64..300.0, 1.0f64..80.0, 1.0f64..80.0);
        prop::collection::vec(one.prop_map(|(x, y, w, h)| BBox::new(x, y, w, h)), 0..30)
    }

    proptest! {
        #[test]
        fn nothing_that_overlaps_is_missed(all in boxes(), probe in boxes()) {
            let mut nearby = Nearby::default();
            nearby.fill(all.iter().copied().enumerate());
            for bbox in &probe {
                let found: Vec<usize> = nearby.touching(bbox).map(|(i, _)| i).collect();
                for (i, other) in all.iter().enumerate() {
                    prop_assert!(other.iou(bbox) == 0.0 || found.contains(&i));
                }
                let centre = [bbox.x, bbox.y];
                let mut found: Vec<usize> = nearby.within(centre, [40.0, 60.0]).map(|(i, _)| i).collect();
                found.sort_unstable();
                let near = |b: &BBox| (b.cx() - bbox.x).abs() <= 40.0 && (b.cy() - bbox.y).abs() <= 60.0;
                let right: Vec<usize> = (0..all.len()).filter(|i| near(&all[*i])).collect();
                prop_assert_eq!(&found, &right);
                prop_assert_eq!(nearby.within(centre, [f64::INFINITY; 2]).count(), all.len());
            }
        }
    }
}
