//! Camera motion seen through the boxes: one shift for the whole picture.
//!
//! A camera that pans moves every person alike. Confident tracks are matched to detections by
//! overlap alone, and the median displacement moves all tracks, the lost ones too, before anything
//! else is decided. How much the displacements differ says how far the median may be off.

use std::f64::consts::FRAC_PI_2;

use super::ShiftConfig;
use super::association::match_pairs;
use super::nearby::Nearby;
use crate::types::BBox;

/// Pixels; more is garbage.
const MAX_SHIFT: f64 = 1e6;

/// The camera's motion between two frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shift {
    /// `(dx, dy)`, pixels.
    pub by: [f64; 2],
    /// Variance of each, pixels^2: that of the median of `n` displacements whose standard deviation is `s`,
    /// `pi s^2 / (2 n)`, and the square of what the shrinkage holds back.
    pub variance: [f64; 2],
}

impl Shift {
    /// Whether its numbers are finite, at most 1e6 pixels, and its variances not negative.
    pub fn is_usable(&self) -> bool {
        let near = self.by.iter().all(|by| by.abs() <= MAX_SHIFT);
        near && self.variance.iter().all(|variance| (0.0..=MAX_SHIFT * MAX_SHIFT).contains(variance))
    }
}

/// The shift from `predicted` boxes to `detections`; `None` when too few agree.
pub fn global_shift(config: &ShiftConfig, predicted: &[BBox], detections: &Nearby) -> Option<Shift> {
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
    let of = |values: &mut [f64]| {
        let middle = median(values);
        let mut off: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
        let spread = 1.4826 * median(&mut off);
        let variance = FRAC_PI_2 * spread * spread / n as f64 + ((1.0 - weight) * middle).powi(2);
        (middle * weight, variance)
    };
    let ((dx, var_x), (dy, var_y)) = (of(&mut dx), of(&mut dy));
    Some(Shift { by: [dx, dy], variance: [var_x, var_y] })
}

/// Median of a non-empty slice, which it reorders.
pub(crate) fn median(values: &mut [f64]) -> f64 {
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
        let Shift { by: [dx, dy], variance } =
            global_shift(&ShiftConfig::default(), &people(0.0), &nearby(&moved)).unwrap();
        assert!((dx - 8.0 * 5.0 / 5.3).abs() < 1e-9 && dy == 0.0, "{dx} {dy}");
        assert!((variance[0].sqrt() - 8.0 * 0.3 / 5.3).abs() < 1e-9 && variance[1] == 0.0, "{variance:?}");
    }

    #[test]
    fn is_less_sure_the_more_people_disagree() {
        let off = [-4.0, -2.0, 0.0, 2.0, 4.0];
        let moved: Vec<BBox> = people(8.0).iter().zip(off).map(|(b, d)| b.shifted(d, 0.0)).collect();
        let shift = global_shift(&ShiftConfig::default(), &people(0.0), &nearby(&moved)).unwrap();
        // Median absolute deviation 2, standard deviation 1.4826 times that, of five.
        let expected = FRAC_PI_2 * (1.4826f64 * 2.0).powi(2) / 5.0 + (8.0f64 * 0.3 / 5.3).powi(2);
        assert!((shift.variance[0] - expected).abs() < 1e-9, "{shift:?}");
    }

    #[test]
    fn says_nothing_of_two_people() {
        assert_eq!(global_shift(&ShiftConfig::default(), &people(0.0)[..2], &nearby(&people(5.0))), None);
        assert_eq!(global_shift(&ShiftConfig::default(), &people(0.0), &nearby(&people(5000.0))), None);
    }

    #[test]
    fn garbage_is_not_usable() {
        let shift = |dx, variance| Shift { by: [dx, 0.0], variance: [0.0, variance] };
        assert!(Shift::default().is_usable() && shift(-3.5, 2.0).is_usable());
        for garbage in [f64::NAN, f64::INFINITY, 1e300] {
            assert!(!shift(garbage, 1.0).is_usable() && !shift(-garbage, 1.0).is_usable());
            assert!(!shift(0.0, garbage).is_usable());
        }
        assert!(!shift(0.0, -1.0).is_usable());
    }
}
