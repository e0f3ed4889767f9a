//! Constant velocity in real time: `F`, `Q` and `R` for a box of a given height and a step of `dt`
//! seconds.

use nalgebra::Matrix2;

use super::FilterConfig;
use super::kalman::{Axis, AxisMotion, BoxFilter};

/// A step in time: what is the same for every box.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    config: &'a FilterConfig,
    dt: f64,
    /// White acceleration of unit variance: `[dt^3/3 dt^2/2; dt^2/2 dt]`.
    acceleration: Matrix2<f64>,
    centre: Matrix2<f64>,
    size: Matrix2<f64>,
}

impl<'a> Step<'a> {
    /// A step of `dt` seconds (not negative).
    pub fn new(config: &'a FilterConfig, dt: f64) -> Self {
        let tau = config.size_velocity_decay;
        let decay = (-dt / tau).exp();
        Self {
            config,
            dt,
            acceleration: Matrix2::new(dt.powi(3) / 3.0, dt * dt / 2.0, dt * dt / 2.0, dt),
            centre: Matrix2::new(1.0, dt, 0.0, 1.0),
            size: Matrix2::new(1.0, tau * (1.0 - decay), 0.0, decay),
        }
    }

    /// The filter that it is a step of.
    pub fn config(&self) -> &'a FilterConfig {
        self.config
    }

    /// `F` and `Q*` of the four coordinates `(cx, cy, w, h)` for a box `height` pixels tall. `factor` is
    /// the adaptation of Eq. Q*.
    ///
    /// Centre: `F = [1 dt; 0 1]`, white acceleration `q [dt^3/3 dt^2/2; dt^2/2 dt]` and a random walk of
    /// the position. Size: the same, its velocity decaying with time constant `tau`.
    pub fn motion(&self, height: f64, factor: f64) -> [AxisMotion; 4] {
        let noise = |acceleration: f64, walk: f64| {
            let mut Q = self.acceleration * ((acceleration * height).powi(2) * factor);
            Q[(0, 0)] += (walk * height).powi(2) * self.dt * factor;
            Q
        };
        let FilterConfig { centre_acceleration, centre_walk, size_acceleration, size_walk, .. } =
            *self.config;
        let centre = AxisMotion { F: self.centre, Q: noise(centre_acceleration, centre_walk) };
        let size = AxisMotion { F: self.size, Q: noise(size_acceleration, size_walk) };
        [centre, centre, size, size]
    }
}

/// [`Step::motion`] of one box alone.
pub fn motion(config: &FilterConfig, dt: f64, height: f64, factor: f64) -> [AxisMotion; 4] {
    Step::new(config, dt).motion(height, factor)
}

/// Diagonal of `R` for a box `height` pixels tall, pixels^2. `factor` is the adaptation of Eq. R*.
pub fn measurement_noise(config: &FilterConfig, height: f64, factor: f64) -> [f64; 4] {
    let centre = (config.centre_measurement * height).powi(2) * factor;
    let size = (config.size_measurement * height).powi(2) * factor;
    [centre, centre, size, size]
}

/// The filter of a box first seen as `z = (cx, cy, w, h)`.
pub fn newborn(config: &FilterConfig, z: [f64; 4]) -> BoxFilter {
    let r = measurement_noise(config, z[3], 1.0);
    let centre = (config.birth_centre_velocity * z[3]).powi(2);
    let size = (config.birth_size_velocity * z[3]).powi(2);
    let velocity = [centre, centre, size, size];
    BoxFilter { axes: std::array::from_fn(|i| Axis::new(z[i], r[i], velocity[i])) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Two steps of dt are one of 2 dt: a dropped frame is a larger step, never an error.
        #[test]
        fn two_steps_are_one_of_twice_the_length(dt in 0.0f64..2.0, height in 1.0f64..2000.0) {
            let config = FilterConfig::default();
            let start = newborn(&config, [10.0, 20.0, height / 3.0, height]);
            let (half, whole) = (motion(&config, dt, height, 1.0), motion(&config, 2.0 * dt, height, 1.0));
            let (mut twice, mut once) = (start, start);
            twice.predict(&half);
            twice.predict(&half);
            once.predict(&whole);
            // The centre is exact; the noise of the decaying size velocity is close, not equal.
            for i in 0..2 {
                prop_assert!((twice.axes[i].x - once.axes[i].x).norm() < 1e-9);
                prop_assert!((twice.axes[i].P - once.axes[i].P).norm() <= 1e-9 * once.axes[i].P.norm());
            }
            for i in 2..4 {
                prop_assert!((twice.axes[i].x - once.axes[i].x).norm() < 1e-9);
            }
        }
    }
}
