//! The Kalman filter of one box.
//!
//! State `x = (cx, cy, w, h, vcx, vcy, vw, vh)` in pixels and pixels per second, measurement
//! `Z = (cx, cy, w, h)`. `F` couples each coordinate with its own velocity only, and `Q`, `R` are
//! diagonal by coordinate, so `P` stays block diagonal for ever: the filter is kept as four
//! [`Axis`] filters of two states. A test holds it to the full 8 x 8 equations.

use nalgebra::{Matrix2, RowVector2, Vector2};

/// One coordinate and its velocity: mean `x`, covariance `P`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    /// Mean: value (pixels) and velocity (pixels per second).
    pub x: Vector2<f64>,
    /// Covariance.
    pub P: Matrix2<f64>,
}

/// Transition and process noise of one coordinate over a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisMotion {
    /// State transition.
    pub F: Matrix2<f64>,
    /// Process noise.
    pub Q: Matrix2<f64>,
}

impl Axis {
    /// A coordinate first measured as `value`, with variance `r` (pixels^2), and velocity zero with
    /// variance `velocity_variance`.
    pub fn new(value: f64, r: f64, velocity_variance: f64) -> Self {
        Self { x: Vector2::new(value, 0.0), P: Matrix2::new(r, 0.0, 0.0, velocity_variance) }
    }

    /// Eq. mean_prediction and covariance_prediction: `x = F x`, `P = F P F' + Q`.
    pub fn predict(&mut self, motion: &AxisMotion) {
        self.x = motion.F * self.x;
        self.P = motion.F * self.P * motion.F.transpose() + motion.Q;
    }

    /// Eq. K_gain, mean_update and the Joseph form of covariance_update for a measurement `z` of
    /// variance `r`, with `H = (1, 0)`.
    pub fn update(&mut self, z: f64, r: f64) {
        let H = RowVector2::new(1.0, 0.0);
        let S = self.P[(0, 0)] + r;
        let K: Vector2<f64> = self.P * H.transpose() / S;
        self.x += K * (z - self.x[0]);
        let A = Matrix2::identity() - K * H;
        self.P = A * self.P * A.transpose() + K * r * K.transpose();
    }
}

/// The filter of one box: `(cx, cy, w, h)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoxFilter {
    /// The four coordinates.
    pub axes: [Axis; 4],
}

impl BoxFilter {
    /// Predicts every coordinate.
    pub fn predict(&mut self, motion: &[AxisMotion; 4]) {
        for (axis, motion) in self.axes.iter_mut().zip(motion) {
            axis.predict(motion);
        }
    }

    /// Updates every coordinate with measurement `z` of variances `r` (diagonal of `R`).
    pub fn update(&mut self, z: [f64; 4], r: [f64; 4]) {
        for ((axis, z), r) in self.axes.iter_mut().zip(z).zip(r) {
            axis.update(z, r);
        }
    }

    /// Mean of `(cx, cy, w, h)`.
    pub fn position(&self) -> [f64; 4] {
        self.axes.map(|axis| axis.x[0])
    }

    /// Mean velocity of `(cx, cy, w, h)`, pixels per second.
    pub fn velocity(&self) -> [f64; 4] {
        self.axes.map(|axis| axis.x[1])
    }

    /// Diagonal of `H P H'`: variances of `(cx, cy, w, h)`.
    pub fn variances(&self) -> [f64; 4] {
        self.axes.map(|axis| axis.P[(0, 0)])
    }

    /// Squared Mahalanobis distance of `z` under `S = H P H' + R` with `R = diag(r)`; pass zeros for
    /// the paper's literal `S = H P H'` (Eq. Mahalanobis).
    pub fn mahalanobis2(&self, z: [f64; 4], r: [f64; 4]) -> f64 {
        self.axes
            .iter()
            .zip(z.iter().zip(r))
            .map(|(axis, (z, r))| (z - axis.x[0]).powi(2) / (axis.P[(0, 0)] + r))
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{SMatrix, SVector};
    use proptest::prelude::*;

    fn motion(dt: f64, q: f64) -> AxisMotion {
        AxisMotion {
            F: Matrix2::new(1.0, dt, 0.0, 1.0),
            Q: Matrix2::new(dt.powi(3) / 3.0, dt * dt / 2.0, dt * dt / 2.0, dt) * q,
        }
    }

    proptest! {
        #[test]
        fn covariance_stays_symmetric_and_positive_definite(
            steps in prop::collection::vec((0.0f64..5.0, 1e-3f64..1e4, -1e4f64..1e4, 1e-3f64..1e4), 1..60)
        ) {
            let mut axis = Axis::new(0.0, 4.0, 100.0);
            for (dt, q, z, r) in steps {
                axis.predict(&motion(dt, q));
                axis.update(z, r);
                prop_assert!((axis.P[(0, 1)] - axis.P[(1, 0)]).abs() <= 1e-9 * axis.P.norm());
                prop_assert!(axis.P[(0, 0)] > 0.0 && axis.P.determinant() > 0.0, "{:?}", axis.P);
            }
        }

        #[test]
        fn equals_the_full_eight_state_filter(
            steps in prop::collection::vec((0.01f64..0.5, prop::array::uniform4(-50.0f64..50.0)), 1..20)
        ) {
            let r = [4.0, 5.0, 6.0, 7.0];
            let q = [10.0, 20.0, 3.0, 4.0];
            let mut blocks = BoxFilter { axes: std::array::from_fn(|i| Axis::new(i as f64, r[i], 100.0)) };
            let mut x = SVector::<f64, 8>::zeros();
            let mut P = SMatrix::<f64, 8, 8>::zeros();
            for i in 0..4 {
                x[i] = i as f64;
                P[(i, i)] = r[i];
                P[(i + 4, i + 4)] = 100.0;
            }
            let mut H = SMatrix::<f64, 4, 8>::zeros();
            H.fixed_view_mut::<4, 4>(0, 0).fill_with_identity();
            let R = SMatrix::<f64, 4, 4>::from_diagonal(&r.into());
            for (dt, z) in steps {
                let motions: [AxisMotion; 4] = std::array::from_fn(|i| motion(dt, q[i]));
                let (mut F, mut Q) = (SMatrix::<f64, 8, 8>::identity(), SMatrix::<f64, 8, 8>::zeros());
                for i in 0..4 {
                    F[(i, i + 4)] = dt;
                    for (a, b) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                        Q[(i + 4 * a, i + 4 * b)] = motions[i].Q[(a, b)];
                    }
                }
                blocks.predict(&motions);
                x = F * x;
                P = F * P * F.transpose() + Q;
                let z_vec = SVector::<f64, 4>::from(z);
                let S = H * P * H.transpose() + R;
                let e = z_vec - H * x;
                let d2 = (e.transpose() * S.try_inverse().unwrap() * e)[0];
                prop_assert!((blocks.mahalanobis2(z, r) - d2).abs() < 1e-6 * (1.0 + d2));
                let K = P * H.transpose() * S.try_inverse().unwrap();
                x += K * e;
                let A = SMatrix::<f64, 8, 8>::identity() - K * H;
                P = A * P * A.transpose() + K * R * K.transpose();
                blocks.update(z, r);
                for i in 0..4 {
                    prop_assert!((blocks.position()[i] - x[i]).abs() < 1e-6);
                    prop_assert!((blocks.velocity()[i] - x[i + 4]).abs() < 1e-6);
                    prop_assert!((blocks.variances()[i] - P[(i, i)]).abs() < 1e-6);
                }
            }
        }
    }
}
