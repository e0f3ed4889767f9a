//! When a frame was captured: by the camera's clock where that can be believed, else by ours.

use crate::types::{CaptureTime, Clock};

/// Times in nanoseconds, of one connection to a camera.
///
/// A camera tells its wall clock now and then (RTCP sender reports, RFC 3550, section 6.4.1), related to the time
/// stamps of its packets; GStreamer works out what it was at each frame. How much later the frame arrived here is the
/// *lag*: transmission, and what the clocks are apart. It may grow for a while, when the network is slow, but not
/// shrink: a frame is not on its way for less than no time. So
///
/// | what comes | is captured at |
/// | --- | --- |
/// | a camera's time whose lag is less than [`APART`] at first, and later between 1 s below and [`STALL`] above the least | the camera's time |
/// | a camera's time that leaps (time stamps jumped, its clock was set) | arrival, until it has been steady for [`STEADY`] |
/// | no time for this frame, but for one before | what that time and the time stamps (PTS) give, judged likewise |
/// | anything else | arrival |
///
/// and never earlier than the frame before.
#[derive(Debug, Default)]
pub(crate) struct CaptureClock {
    /// The camera's clock less the PTS.
    offset: Option<i64>,
    believed: Option<Lag>,
    /// What a leap led to: when it began, and its lag.
    leapt: Option<Lag>,
    last: Option<i64>,
}

/// The least lag so far.
#[derive(Clone, Copy, Debug)]
struct Lag {
    since: i64,
    seen: i64,
    least: i64,
}

/// What is known of a frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stamps {
    /// Presentation time stamp.
    pub pts: Option<i64>,
    /// The camera's clock, Unix.
    pub camera: Option<i64>,
    /// Our clock when its data were here, Unix.
    pub arrived: i64,
}

const SECOND: i64 = 1_000_000_000;
/// Clocks further apart are not synchronized: that camera's says nothing.
const APART: i64 = 30 * SECOND;
/// How long data may have been held up on the way.
const STALL: i64 = 10 * SECOND;
/// How long a clock that leapt must go on evenly to be believed again.
const STEADY: i64 = 10 * SECOND;
/// How fast two clocks drift apart at most.
const DRIFT_PER_MILLE: i64 = 1;

impl CaptureClock {
    /// A new connection: whatever was known of the camera's clock may be wrong.
    pub fn restart(&mut self) {
        *self = Self { last: self.last, ..Self::default() };
    }

    /// When the frame was captured.
    pub fn capture(&mut self, stamps: Stamps) -> CaptureTime {
        let Stamps { pts, camera, arrived } = stamps;
        let told = camera.or_else(|| pts?.checked_add(self.offset?));
        let (unix_ns, clock) = match told.filter(|told| self.believes(*told, arrived)) {
            Some(told) => {
                self.offset = pts.and_then(|pts| told.checked_sub(pts)).or(self.offset);
                (told, Clock::Rtcp)
            }
            None => (arrived, Clock::Arrival),
        };
        // One that was set back by more is followed.
        let behind = self.last.map_or(0, |last| last.saturating_sub(unix_ns));
        let unix_ns = if (0..STALL).contains(&behind) { unix_ns + behind } else { unix_ns };
        self.last = Some(unix_ns);
        CaptureTime { unix_ns, clock }
    }

    fn believes(&mut self, told: i64, arrived: i64) -> bool {
        let lag = arrived.saturating_sub(told);
        if lag.saturating_abs() >= APART {
            return false;
        }
        if self.believed.is_none_or(|believed| believed.admits(lag)) {
            self.leapt = None;
            self.believed = Some(Lag::after(self.believed, lag, arrived));
            return true;
        }
        let leapt = Lag::after(self.leapt.filter(|leapt| leapt.admits(lag)), lag, arrived);
        self.leapt = Some(leapt);
        let steady = arrived - leapt.since >= STEADY;
        if steady {
            self.believed = self.leapt.take();
        }
        steady
    }
}

impl Lag {
    fn admits(&self, lag: i64) -> bool {
        (self.least - SECOND..self.least + STALL).contains(&lag)
    }

    fn after(before: Option<Self>, lag: i64, now: i64) -> Self {
        match before {
            None => Self { since: now, seen: now, least: lag },
            Some(Self { since, seen, least }) => {
                let drifted = least + (now - seen).max(0) / 1_000 * DRIFT_PER_MILLE;
                Self { since, seen: now, least: lag.min(drifted) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    /// When the test begins, ms.
    const NOW: i64 = 1_767_323_045_000;

    /// Frames every 100 ms that are captured 20 ms before they arrive; `of` says what the camera tells of frame `n`: its
    /// PTS and its clock, ms, where it is right if it is `true`.
    fn run(frames: i64, of: impl Fn(i64) -> (Option<i64>, Option<i64>)) -> Vec<(i64, Clock)> {
        let mut clock = CaptureClock::default();
        (0..frames)
            .map(|n| {
                let (pts, camera) = of(n);
                let arrived = (NOW + 100 * n) * MS;
                let stamps = Stamps { pts: pts.map(|p| p * MS), camera: camera.map(|c| c * MS), arrived };
                let CaptureTime { unix_ns, clock } = clock.capture(stamps);
                // Against the truth.
                (unix_ns / MS - (NOW + 100 * n - 20), clock)
            })
            .collect()
    }

    /// The camera's clock at frame `n` when it is `off` ms ahead.
    fn at(n: i64, off: i64) -> Option<i64> {
        Some(NOW + 100 * n - 20 + off)
    }

    #[test]
    fn arrival_counts_until_the_camera_tells() {
        let seen = run(6, |n| (Some(100 * n), if n < 3 { None } else { at(n, 0) }));
        assert_eq!(seen[..3], [(20, Clock::Arrival); 3]);
        assert_eq!(seen[3..], [(0, Clock::Rtcp); 3]);
    }

    #[test]
    fn a_frame_without_a_time_goes_by_the_one_before() {
        let seen = run(6, |n| (Some(100 * n), if n == 3 { None } else { at(n, 0) }));
        assert_eq!(seen, [(0, Clock::Rtcp); 6]);
        // Without a time stamp there is nothing to go by.
        let seen = run(6, |n| (None, if n == 3 { None } else { at(n, 0) }));
        assert_eq!(seen[3], (20, Clock::Arrival));
        // A time stamp that leapt meanwhile is none.
        let seen =
            run(6, |n| (Some(if n < 3 { 100 * n } else { 9_000_000 }), if n == 3 { None } else { at(n, 0) }));
        assert_eq!(seen[3], (20, Clock::Arrival));
    }

    #[test]
    fn a_clock_that_is_far_off_says_nothing() {
        for off in [-3_600_000, -31_000, 31_000, 3_600_000, i64::MAX / MS - NOW - 1_000_000] {
            let seen = run(300, |n| (Some(100 * n), at(n, off)));
            assert_eq!(seen, [(20, Clock::Arrival); 300], "{off}");
        }
        let seen = run(3, |n| (Some(100 * n), at(n, 25_000)));
        assert_eq!(seen, [(25_000, Clock::Rtcp); 3]);
    }

    #[test]
    fn a_leap_is_not_followed_at_once_and_the_way_back_is() {
        // Time stamps jump by an hour at frame 20; the next sender report, after 5 s, puts it right.
        for leap in [3_600_000, 5_000, -20_000, -3_600_000] {
            let seen = run(100, |n| (Some(100 * n), at(n, if (20..70).contains(&n) { leap } else { 0 })));
            assert!(
                seen.iter().all(|(off, clock)| *off == if *clock == Clock::Rtcp { 0 } else { 20 }),
                "{leap}"
            );
            let arrival = seen.iter().filter(|(_, clock)| *clock == Clock::Arrival).count();
            assert_eq!(arrival, 50, "{leap}");
        }
    }

    #[test]
    fn a_clock_that_was_set_is_believed_after_a_while() {
        let seen = run(300, |n| (Some(100 * n), at(n, if n < 100 { 0 } else { 4_000 })));
        assert_eq!(seen[199], (20, Clock::Arrival));
        assert_eq!(seen[201], (4_000, Clock::Rtcp));
    }

    #[test]
    fn data_that_were_held_up_are_not_younger_for_it() {
        let mut clock = CaptureClock::default();
        for n in 0..100 {
            // The network stands still from frame 20 to 60, then everything comes at once.
            let arrived = if (20..60).contains(&n) { 60 } else { n } * 100 + 20;
            let (pts, camera) = (Some(n * 100 * MS), Some((NOW + n * 100) * MS));
            let seen = clock.capture(Stamps { pts, camera, arrived: (NOW + arrived) * MS });
            assert_eq!(seen, CaptureTime { unix_ns: (NOW + n * 100) * MS, clock: Clock::Rtcp });
        }
    }

    #[test]
    fn drift_is_followed() {
        // 50 ppm for a day, both ways: 4.3 s.
        for sign in [-1, 1] {
            let mut clock = CaptureClock::default();
            for n in 0..864_000 {
                let told = NOW * MS + n * 100 * MS + sign * n * 5_000;
                let stamps = Stamps { pts: None, camera: Some(told), arrived: (NOW + n * 100 + 20) * MS };
                assert_eq!(clock.capture(stamps), CaptureTime { unix_ns: told, clock: Clock::Rtcp }, "{n}");
            }
        }
    }

    #[test]
    fn it_never_goes_back_but_with_our_own_clock() {
        let mut clock = CaptureClock::default();
        let mut capture = |ms: i64| {
            let stamps = Stamps { pts: None, camera: None, arrived: (NOW + ms) * MS };
            clock.capture(stamps).unix_ns / MS - NOW
        };
        assert_eq!([0, 100, 60, 200].map(&mut capture), [0, 100, 100, 200]);
        // Ours was set back by an hour.
        assert_eq!([300 - 3_600_000, 400 - 3_600_000].map(capture), [300 - 3_600_000, 400 - 3_600_000]);
    }
}
