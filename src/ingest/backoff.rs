//! How long to wait before the next attempt.

use std::time::Duration;

/// Exponential back-off with jitter: about 0.4 s, 0.8 s, 1.5 s, ... up to a limit.
///
/// The jitter (half to all of the step) keeps a hundred cameras behind one switch from coming back
/// in the same instant.
#[derive(Debug, Default)]
pub(crate) struct Backoff {
    failures: u32,
}

impl Backoff {
    const FIRST: Duration = Duration::from_millis(500);
    /// A knock costs next to nothing, and a camera that is back is to be seen within 5 s.
    pub const SOON: Duration = Duration::from_secs(3);
    /// Some cameras lock a user out after a few wrong passwords.
    pub const LATER: Duration = Duration::from_secs(30);

    /// The wait before the next attempt, at most `most`.
    pub fn next(&mut self, most: Duration) -> Duration {
        let step = Self::FIRST.saturating_mul(1 << self.failures.min(10)).min(most);
        self.failures = self.failures.saturating_add(1);
        step.mul_f64(0.5 + 0.5 * fastrand::f64())
    }

    /// To be called once a connection has proved itself.
    pub fn reset(&mut self) {
        self.failures = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grows_to_the_limit_and_starts_below_one_second() {
        for most in [Backoff::SOON, Backoff::LATER] {
            let mut backoff = Backoff::default();
            for _ in 0..3 {
                let waits: Vec<f64> = (0..40).map(|_| backoff.next(most).as_secs_f64()).collect();
                assert!((0.25..1.0).contains(&waits[0]), "{waits:?}");
                for (i, &wait) in waits.iter().enumerate() {
                    let step = (0.5 * 2f64.powi(i.min(20) as i32)).min(most.as_secs_f64());
                    assert!(wait >= step / 2.0 && wait <= step, "{i}: {wait} of {step}");
                }
                assert!(waits[39] >= most.as_secs_f64() / 2.0);
                backoff.reset();
            }
        }
    }
}
