//! What a consistent filter's NEES and NIS must look like.
//!
//! The squared error of a state or measurement of `n` dimensions, normalised by its covariance, is
//! chi-square distributed with `n` degrees of freedom when the covariance is right. The sum over
//! `count` independent ones has `n count` degrees (Bar-Shalom, Li, Kirubarajan, "Estimation with
//! Applications to Tracking and Navigation", 5.4).

use statrs::distribution::{ChiSquared, Continuous, ContinuousCDF};

fn chi_square(degrees: f64) -> ChiSquared {
    ChiSquared::new(degrees).expect("degrees of freedom are positive")
}

/// The value that a chi-square variable of `n` degrees of freedom stays below with probability `p` in
/// `(0, 1)`.
///
/// # Panics
/// When `n` is 0.
pub fn quantile(n: usize, p: f64) -> f64 {
    chi_square(n as f64).inverse_cdf(p)
}

/// Density of a chi-square variable of `n` degrees of freedom at `x`.
///
/// # Panics
/// When `n` is 0.
pub fn density(n: usize, x: f64) -> f64 {
    chi_square(n as f64).pdf(x)
}

/// The interval that the mean of `count` independent values of `n` degrees of freedom lies in with
/// probability 95 %.
///
/// # Panics
/// When `n` or `count` is 0.
pub fn mean_bounds(n: usize, count: usize) -> (f64, f64) {
    let sum = chi_square(n as f64 * count as f64);
    (sum.inverse_cdf(0.025) / count as f64, sum.inverse_cdf(0.975) / count as f64)
}

/// Mean of a chi-square variable of `n` degrees of freedom whose largest share `trim` in `[0, 1)` is
/// left out: `n F_{n+2}(q) / F_n(q)` with `F_n(q) = 1 - trim`; `n` itself for no trimming.
///
/// # Panics
/// When `n` is 0.
pub fn trimmed_mean(n: usize, trim: f64) -> f64 {
    if trim <= 0.0 {
        return n as f64;
    }
    n as f64 * chi_square(n as f64 + 2.0).cdf(quantile(n, 1.0 - trim)) / (1.0 - trim)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against tables (and scipy.stats.chi2).
    #[test]
    fn known_values() {
        for (n, p, expected) in [
            (1, 0.95, 3.841_458_820_694),
            (2, 0.95, 5.991464547107979),
            (4, 0.95, 9.487729036781154),
            (4, 0.025, 0.484_418_557_087_93),
            (100, 0.975, 129.561_197_185_837),
        ] {
            let found = quantile(n, p);
            assert!((found - expected).abs() < 1e-6 * expected, "{n} {p}: {found}");
        }
    }

    #[test]
    fn bounds_of_a_mean() {
        // scipy: chi2.ppf([.025, .975], n * count) / count.
        for (n, count, expected) in [
            (4, 1, (0.484_418_557_087_93, 11.143286781877796)),
            (2, 50, (1.48443855, 2.59122394)),
            (4, 2000, (3.87699085, 4.12490342)),
            (2, 100_000, (1.98762305, 2.01241483)),
        ] {
            let found = mean_bounds(n, count);
            let near = |a: f64, b: f64| (a - b).abs() < 1e-5;
            assert!(near(found.0, expected.0) && near(found.1, expected.1), "{n} {count}: {found:?}");
        }
    }

    #[test]
    fn a_trimmed_mean_is_that_of_a_cut_distribution() {
        assert_eq!(trimmed_mean(2, 0.0), 2.0);
        // Two degrees are an exponential of mean 2: the mean below q is 2 - q e^{-q/2} / (1 - e^{-q/2}).
        for trim in [0.01, 0.05, 0.3] {
            let q = -2.0 * f64::ln(trim);
            let expected = 2.0 - q * trim / (1.0 - trim);
            assert!((trimmed_mean(2, trim) - expected).abs() < 1e-9, "{trim}");
        }
    }
}
