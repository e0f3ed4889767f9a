//! Camera motion seen through the boxes: one shift for the whole picture.
//!
//! A camera that pans moves every person alike. Confident tracks are matched to detections by
//! overlap alone, and the median displacement moves all tracks, the lost ones too, before anything
//! else is decided.

use super::ShiftConfig;
use super::assign::assign;
use crate::types::BBox;

/// The shift `(dx, dy)` in pixels from `predicted` boxes to `detections`; `None` when too few agree.
pub fn global_shift(config: &ShiftConfig, predicted: &[BBox], detections: &[BBox]) -> Option<(f64, f64)> {
    if !config.enabled || predicted.len() < config.min_pairs || detections.len() < config.min_pairs {
        return None;
    }
    let cost: Vec<f64> = predicted
        .iter()
        .flat_map(|p| detections.iter().map(move |d| p.iou(d)))
        .map(|iou| if iou > config.min_iou { -iou } else { 0.0 })
        .collect();
    let mut dx = Vec::with_capacity(predicted.len());
    let mut dy = Vec::with_capacity(predicted.len());
    for (row, col) in assign(&cost, predicted.len(), detections.len()).into_iter().enumerate() {
        let Some(col) = col.filter(|col| cost[row * detections.len() + col] < 0.0) else { continue };
        dx.push(detections[col].cx() - predicted[row].cx());
        dy.push(detections[col].cy() - predicted[row].cy());
    }
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

    #[test]
    fn finds_a_pan_and_ignores_one_runner() {
        let mut moved = people(8.0);
        moved[2] = moved[2].shifted(12.0, 0.0);
        let (dx, dy) = global_shift(&ShiftConfig::default(), &people(0.0), &moved).unwrap();
        assert!((dx - 8.0 * 5.0 / 5.3).abs() < 1e-9 && dy == 0.0, "{dx} {dy}");
    }

    #[test]
    fn says_nothing_of_two_people() {
        assert_eq!(global_shift(&ShiftConfig::default(), &people(0.0)[..2], &people(5.0)), None);
        assert_eq!(global_shift(&ShiftConfig::default(), &people(0.0), &people(5000.0)), None);
    }
}
