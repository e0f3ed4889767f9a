//! Which pairs of track and detection are worth a link probability.

use super::GateConfig;
use super::kalman::BoxFilter;
use crate::types::BBox;

/// What the gate measured of a pair; the features use it again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairGeometry {
    /// Squared Mahalanobis distance (Eq. Mahalanobis).
    pub mahalanobis2: f64,
    /// IoU of the detection with the predicted box.
    pub iou: f64,
}

/// How far from the predicted centre, along x and y, a detection may be that [`gate`] lets through, pixels.
pub fn reach(config: &GateConfig, filter: &BoxFilter, r: [f64; 4]) -> [f64; 2] {
    if config.or_iou.is_some() || config.or_distance.is_some() {
        return [f64::INFINITY; 2];
    }
    let variances = filter.variances();
    [0, 1].map(|axis| {
        let s = variances[axis] + if config.innovation { r[axis] } else { 0.0 };
        // A little more, for rounding.
        (config.mahalanobis * s).sqrt() * (1.0 + 1e-9) + 1e-9
    })
}

/// Measures a pair: `filter` is predicted to the detection's time, `predicted` is its box, `r` the
/// diagonal of the measurement noise. `None` when the gate is closed.
pub fn gate(
    config: &GateConfig,
    filter: &BoxFilter,
    predicted: &BBox,
    r: [f64; 4],
    detection: &BBox,
) -> Option<PairGeometry> {
    let z = [detection.cx(), detection.cy(), detection.w, detection.h];
    let mahalanobis2 = filter.mahalanobis2(z, if config.innovation { r } else { [0.0; 4] });
    let near = mahalanobis2 < config.mahalanobis;
    if !near && config.or_iou.is_none() && config.or_distance.is_none() {
        return None;
    }
    let iou = predicted.iou(detection);
    let distance = || (z[0] - predicted.cx()).hypot(z[1] - predicted.cy()) / predicted.h.max(1.0);
    let open = near
        || config.or_iou.is_some_and(|bound| iou > bound)
        || config.or_distance.is_some_and(|bound| distance() < bound);
    open.then_some(PairGeometry { mahalanobis2, iou })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::FilterConfig;
    use crate::track::motion::{measurement_noise, newborn};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn nothing_beyond_its_reach_passes(
            place in (0.0f64..4000.0, 0.0f64..200.0, 4.0f64..400.0),
            off in (-600.0f64..600.0, -600.0f64..600.0, 0.0f64..1.0),
            innovation in any::<bool>(),
        ) {
            let ((x, y, h), (dx, dy, k)) = (place, off);
            let (filter_config, config) =
                (FilterConfig::default(), GateConfig { innovation, ..GateConfig::default() });
            let filter = newborn(&filter_config, [x, y, 0.4 * h, h]);
            let r = measurement_noise(&filter_config, h, 1.0);
            let [predicted, seen] = [0.0, k * k].map(|k| BBox::from_center(x + k * dx, y + k * dy, 0.4 * h, h));
            let passes = gate(&config, &filter, &predicted, r, &seen).is_some();
            let [rx, ry] = reach(&config, &filter, r);
            let far = (seen.cx() - predicted.cx()).abs() > rx || (seen.cy() - predicted.cy()).abs() > ry;
            prop_assert!(!(passes && far));
        }
    }
}
