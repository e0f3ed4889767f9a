//! Camera motion seen through the boxes: one shift for the whole picture.
//!
//! A camera that pans moves every person alike. Confident tracks are matched to detections by
//! overlap alone, and the median displacement moves all tracks, the lost ones too, before anything
//! else is decided.

use super::ShiftConfig;
use super::association::match_pairs;
use super::nearby::Nearby;
use crate::types::BBox;

/// The shift `(dx, dy)` in pixels from `predicted` boxes to `detections`; `None` when too few agree.
pub fn global_shift(config: &ShiftConfig, predicted: &[BBox], detections: &Nearby) -> Option<(f64, f64)> {
    if !config.enabled || predicted.len() < config.min_pairs || detections.len() < config.min_pairs {
        return None;
    }
    let mut pairs = Vec::with_capacity(2 * predicted.len());
    let mut moves = Vec::with_capacity(2 * predicted.len());
    let mut last = 0;
    for (track, bbox) in predicted.iter().enumerate() {
        for (detection, seen) in detections.touching(bbox) {
            let iou = bbox.iou(seen);
            if iou > config.min_iou {
                pairs.push((track, detection, iou));
                moves.push((seen.cx() - bbox.cx(), seen.cy() - bbox.cy()));
                last = last.max(detection + 1);
            }
        }
    }
    let (mut dx, mut dy): (Vec<f64>, Vec<f64>) =
        match_pairs(&pairs, predicted.len(), last).into_iter().map(|chosen| moves[chosen]).unzip();
    let n = dx.len();
    if n < config.min_pairs {
        return None;
    }
    let weight = n as f64 / (n as f64 + config.shrink);
    Some((median(&mut dx) * weight, median(&mut dy) * weight))
}

/// Median of a non-empty slice, which it reorders.
fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let mid = values.len() / 2;
    if values.len() % 2 == 1 { values[mid] } else { (values[mid - 1] + values[mid]) / 2.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn people(shift: f64) -> Vec<BBox> {
        (0..5).map(|i| BBox::new(100.0 * f64::from(i) + shift, 50.0, 40.0, 100.0)).collect()
    }

    fn nearby(boxes: &[BBox]) -> Nearby {
        let mut nearby = Nearby::default();
        nearby.fill(boxes.iter().copied().enumerate());
        nearby
    }

    #[test]
    fn finds_a_pan_and_ignores_one_runner() {
        let mut moved = people(8.0);
        moved[2] = moved[2].shifted(12.0, 0.0);
        let (dx, dy) = global_shift(&ShiftConfig::default(), &people(0.0), &nearby(&moved)).unwrap();
        assert!((dx - 8.0 * 5.0 / 5.3).abs() < 1e-9 && dy == 0.0, "{dx} {dy}");
    }

    #[test]
    fn says_nothing_of_two_people() {
        assert_eq!(global_shift(&ShiftConfig::default(), &people(0.0)[..2], &nearby(&people(5.0))), None);
        assert_eq!(global_shift(&ShiftConfig::default(), &people(0.0), &nearby(&people(5000.0))), None);
    }
}
