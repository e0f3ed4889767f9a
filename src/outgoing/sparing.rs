//! Log lines that may come a thousand times: said at once, then at most every half minute, with how many there were.

use std::time::{Duration, Instant};

const EVERY: Duration = Duration::from_secs(30);

/// Counts losses and says when it is time to tell of them.
#[derive(Debug, Default)]
pub(crate) struct Sparing {
    told: Option<Instant>,
    since: u64,
}

impl Sparing {
    /// Notes `count` more. How many there were since the last time it was told, if it is time to tell again.
    pub fn note(&mut self, count: u64) -> Option<u64> {
        self.since += count;
        if self.told.is_some_and(|told| told.elapsed() < EVERY) {
            return None;
        }
        self.told = Some(Instant::now());
        Some(std::mem::take(&mut self.since))
    }
}

/// How long to wait after so many failures in a row: doubled each time from half a second on, at most `most`, and
/// between half and all of that, so that many clients do not come back in step.
pub(crate) fn backoff(failures: u32, most: Duration) -> Duration {
    let base = Duration::from_millis(500).saturating_mul(1 << failures.saturating_sub(1).min(16));
    base.min(most).mul_f64(0.5 + 0.5 * fastrand::f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_tells_at_once_and_then_seldom() {
        let mut sparing = Sparing::default();
        assert_eq!(sparing.note(2), Some(2));
        assert_eq!((sparing.note(3), sparing.note(4)), (None, None));
        sparing.told = Instant::now().checked_sub(EVERY);
        assert_eq!(sparing.note(1), Some(8));
    }

    #[test]
    fn waiting_grows_to_a_bound() {
        let most = Duration::from_secs(60);
        for (failures, longest) in [(1, 0.5), (2, 1.0), (5, 8.0), (8, 60.0), (u32::MAX, 60.0)] {
            let waits: Vec<_> = (0..100).map(|_| backoff(failures, most).as_secs_f64()).collect();
            assert!(waits.iter().all(|w| (longest / 2.0..=longest).contains(w)), "{failures}: {waits:?}");
        }
    }
}
