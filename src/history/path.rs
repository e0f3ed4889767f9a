//! Paths, simplified as they grow: few key boxes, straight lines between them.
//!
//! The swing filter (Elmeleegy et al. 2009) in four coordinates: a key box stays open as long as one
//! straight line from it passes every later box within the tolerance, by one comparison of slopes a
//! coordinate. A box that no such line reaches makes the one before it a key box.

/// How far a path may leave the boxes, as a part of their height.
pub const TOLERANCE: f64 = 0.03;

/// A box at a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyBox {
    /// 0-based index of the frame within the epoch.
    pub frame: u64,
    /// Nanoseconds since 1970.
    pub unix_ns: i64,
    /// Left, top, width, height in pixels.
    pub bbox: [f64; 4],
    /// The track was not seen before it: no line leads here.
    pub after_gap: bool,
}

/// A path that grows.
#[derive(Clone, Debug)]
pub struct Path {
    key: KeyBox,
    last: KeyBox,
    /// Least and greatest slope of the left, top, right and lower edges that pass all boxes since `key`.
    cone: [(f64, f64); 4],
}

const OPEN: [(f64, f64); 4] = [(f64::NEG_INFINITY, f64::INFINITY); 4];

impl Path {
    /// A path from its first box on, which is a key box.
    pub fn new(first: KeyBox) -> Self {
        Self { key: first, last: first, cone: OPEN }
    }

    /// The newest box.
    pub fn last(&self) -> &KeyBox {
        &self.last
    }

    /// The next box, of a later frame; what became a key box by it goes to `keys`.
    pub fn push(&mut self, next: KeyBox, keys: &mut Vec<KeyBox>) {
        if next.after_gap {
            self.close(keys);
            keys.push(next);
            *self = Self::new(next);
        } else if !self.extend(&next) {
            keys.push(self.last);
            (self.key, self.cone) = (self.last, OPEN);
            self.extend(&next);
        }
        self.last = next;
    }

    /// Makes the newest box a key box, if it is none.
    pub fn close(&mut self, keys: &mut Vec<KeyBox>) {
        if self.last.frame > self.key.frame {
            keys.push(self.last);
            (self.key, self.cone) = (self.last, OPEN);
        }
    }

    /// Narrows the cone by a box; `false` when it lies outside.
    fn extend(&mut self, next: &KeyBox) -> bool {
        let frames = next.frame.saturating_sub(self.key.frame).max(1) as f64;
        let tolerance = (TOLERANCE * next.bbox[3]).max(1.0);
        let (from, to) = (edges(&self.key.bbox), edges(&next.bbox));
        let mut cone = self.cone;
        for ((from, to), (least, greatest)) in from.into_iter().zip(to).zip(&mut cone) {
            let slope = (to - from) / frames;
            if slope < *least || slope > *greatest {
                return false;
            }
            *least = least.max(slope - tolerance / frames);
            *greatest = greatest.min(slope + tolerance / frames);
        }
        self.cone = cone;
        true
    }
}

fn edges([x, y, w, h]: &[f64; 4]) -> [f64; 4] {
    [*x, *y, x + w, y + h]
}

/// The box at `frame`, from the path's key boxes in the order of frames; `None` outside and in gaps.
pub fn at(path: &[KeyBox], frame: u64) -> Option<[f64; 4]> {
    let after = path.partition_point(|key| key.frame < frame);
    let next = path.get(after)?;
    if next.frame == frame {
        return Some(next.bbox);
    }
    let before = path.get(after.checked_sub(1)?)?;
    if next.after_gap {
        return None;
    }
    let part = (frame - before.frame) as f64 / (next.frame - before.frame) as f64;
    Some(std::array::from_fn(|i| before.bbox[i] + part * (next.bbox[i] - before.bbox[i])))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn kept(boxes: &[KeyBox]) -> Vec<KeyBox> {
        let mut path = Path::new(boxes[0]);
        let mut keys = vec![boxes[0]];
        for next in &boxes[1..] {
            path.push(*next, &mut keys);
        }
        path.close(&mut keys);
        keys
    }

    fn line(frame: u64) -> KeyBox {
        let x = frame as f64;
        KeyBox { frame, unix_ns: 0, bbox: [3.0 * x, 100.0 - x, 40.0, 100.0], after_gap: false }
    }

    #[test]
    fn a_straight_walk_is_two_boxes_and_a_turn_one_more() {
        let straight: Vec<_> = (5..105).map(line).collect();
        assert_eq!(kept(&straight), [straight[0], straight[99]]);
        let turned: Vec<_> =
            (0..100).map(|f| if f < 50 { line(f) } else { KeyBox { frame: f, ..line(100 - f) } }).collect();
        let keys = kept(&turned);
        assert!((3..=4).contains(&keys.len()), "{keys:?}");
    }

    #[test]
    fn no_line_leads_over_a_gap() {
        let mut boxes: Vec<_> = (0..10).chain(40..50).map(line).collect();
        boxes[10].after_gap = true;
        let keys = kept(&boxes);
        assert_eq!(keys, [boxes[0], boxes[9], boxes[10], boxes[19]]);
        assert_eq!(at(&keys, 25), None);
        assert_eq!(at(&keys, 45), Some(line(45).bbox));
        assert_eq!((at(&keys, 50), at(&[], 1)), (None, None));
    }

    proptest! {
        #[test]
        fn every_box_is_within_the_tolerance(
            steps in prop::collection::vec((1u64..4, -9.0..9.0f64, -9.0..9.0f64, -2.0..2.0f64, prop::bool::weighted(0.1)), 1..200)
        ) {
            let mut boxes = vec![line(0)];
            for (frames, dx, dy, grow, after_gap) in steps {
                let KeyBox { frame, bbox: [x, y, w, h], .. } = *boxes.last().unwrap();
                let bbox = [x + dx, y + dy, (w + grow).max(2.0), (h + grow).max(2.0)];
                boxes.push(KeyBox { frame: frame + frames, unix_ns: 0, bbox, after_gap });
            }
            let keys = kept(&boxes);
            prop_assert!(keys.len() <= boxes.len());
            prop_assert!(keys.is_sorted_by(|a, b| a.frame < b.frame));
            // The line's end is the key box itself, so the whole error is the tolerance of what lies between.
            for seen in &boxes {
                let found = edges(&at(&keys, seen.frame).unwrap());
                let tolerance = (TOLERANCE * seen.bbox[3]).max(1.0) + 1e-6;
                for (found, seen) in found.into_iter().zip(edges(&seen.bbox)) {
                    prop_assert!((found - seen).abs() <= tolerance, "{found} {seen}");
                }
            }
        }
    }
}
