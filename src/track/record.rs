//! How the detector has done on a camera of late, as far as the tracks tell.
//!
//! A person who is not detected for a moment means little to a detector that misses many, and much to one
//! that misses nobody. Two shares say which one it is, without any truth: how many of the believed tracks
//! it finds (its recall on people who are there), and how many of its new tracks come to be believed (its
//! precision). Both fade, and begin at what is usual.

/// What a track is asked for this long after its last match, s; later nobody knows where it is.
const EXPECTED_FOR: f64 = 0.5;

/// A share of events that forgets: the older ones fade with a time constant, a prior stays.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Share {
    prior: f64,
    weight: f64,
    forget: f64,
    events: f64,
    positive: f64,
}

impl Share {
    const fn new(prior: f64, weight: f64, forget: f64) -> Self {
        Self { prior, weight, forget, events: 0.0, positive: 0.0 }
    }

    fn fade(&mut self, dt: f64) {
        let keep = (-dt / self.forget).exp();
        self.events *= keep;
        self.positive *= keep;
    }

    fn count(&mut self, positive: bool) {
        self.events += 1.0;
        self.positive += f64::from(u8::from(positive));
    }

    fn value(&self) -> f64 {
        (self.prior * self.weight + self.positive) / (self.weight + self.events)
    }
}

/// The detector's record on one camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectorRecord {
    found: Share,
    confirmed: Share,
}

impl Default for DetectorRecord {
    fn default() -> Self {
        Self { found: Share::new(0.8, 20.0, 15.0), confirmed: Share::new(0.5, 4.0, 30.0) }
    }
}

impl DetectorRecord {
    /// `dt` seconds pass.
    pub fn fade(&mut self, dt: f64) {
        self.found.fade(dt);
        self.confirmed.fade(dt);
    }

    /// A believed track, last seen `missed_for` seconds ago, was matched in this frame or not.
    pub fn expect(&mut self, missed_for: f64, matched: bool) {
        if matched || missed_for <= EXPECTED_FOR {
            self.found.count(matched);
        }
    }

    /// A tentative track came to be believed, or ended.
    pub fn settle(&mut self, confirmed: bool) {
        self.confirmed.count(confirmed);
    }

    /// Share of the believed tracks that are found in a frame, 0 to 1.
    pub fn recall(&self) -> f64 {
        self.found.value()
    }

    /// Share of the new tracks that come to be believed, 0 to 1.
    pub fn precision(&self) -> f64 {
        self.confirmed.value()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_follow_what_happens_and_fade_to_the_usual() {
        let mut record = DetectorRecord::default();
        assert_eq!((record.recall(), record.precision()), (0.8, 0.5));
        for i in 0..300 {
            record.expect(0.0, i % 3 == 0);
            record.settle(true);
        }
        assert!((record.recall() - (16.0 + 100.0) / 320.0).abs() < 1e-9);
        assert!((record.precision() - 302.0 / 304.0).abs() < 1e-9);
        // One lost for long tells nothing.
        let before = record;
        record.expect(0.6, false);
        assert_eq!(record, before);
        record.fade(1000.0);
        assert!((record.recall() - 0.8).abs() < 1e-6 && (record.precision() - 0.5).abs() < 1e-6);
    }
}
