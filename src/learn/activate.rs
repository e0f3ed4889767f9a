//! Logistic and tanh over slices, written so that the compiler vectorises them.

/// `e^x` for finite `x`, relative error below 2e-7; saturates at about `e^-87` and `e^88`.
///
/// `x = n ln 2 + f`, a polynomial for `e^f`, `n` put into the exponent's bits. No branch, no call.
#[inline(always)]
fn exp(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer in the mantissa's low bits: baseline x86-64 has no
    // rounding instruction, and a call would stop vectorisation.
    const ROUND: f32 = 12_582_912.0;
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let f = x - n * LN2_HIGH - n * LN2_LOW;
    let p = 1.987_569_1e-4;
    let p = p * f + 1.398_199_9e-3;
    let p = p * f + 8.333_452e-3;
    let p = p * f + 4.166_579_6e-2;
    let p = p * f + 1.666_666_5e-1;
    let p = p * f + 5e-1;
    let p = p * f * f + f + 1.0;
    // The low bits of `shifted` are `n` in two's complement; the shift drops the rest.
    p * f32::from_bits(shifted.to_bits().wrapping_add(127) << 23)
}

/// Logistic function `1 / (1 + e^-x)`.
#[inline(always)]
pub(super) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Hyperbolic tangent, absolute error below 3e-7.
#[inline(always)]
pub(super) fn tanh(x: f32) -> f32 {
    2.0 * sigmoid(2.0 * x) - 1.0
}

/// [`sigmoid`] of every value, in place.
pub(super) fn sigmoid_all(values: &mut [f32]) {
    values.iter_mut().for_each(|v| *v = sigmoid(*v));
}

/// [`tanh`] of every value, in place.
pub(super) fn tanh_all(values: &mut [f32]) {
    values.iter_mut().for_each(|v| *v = tanh(*v));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_the_exact_functions() {
        for i in -40_000..=40_000 {
            let x = i as f32 * 0.001;
            let exact = f64::from(x);
            assert!((f64::from(sigmoid(x)) - 1.0 / (1.0 + (-exact).exp())).abs() < 2e-7, "sigmoid({x})");
            assert!((f64::from(tanh(x)) - exact.tanh()).abs() < 4e-7, "tanh({x})");
        }
        assert_eq!(sigmoid(1e30), 1.0);
        assert!(sigmoid(-1e30) < 1e-37);
    }
}
