//! Times, typed by the clock they came from.

/// A frame's place on its stream's own time line, in nanoseconds: what drives the Kalman filter.
///
/// Only differences mean anything. It never goes backwards within a camera's epoch: the source
/// joins the time lines of successive connections by the time that passed between them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MediaTime(pub i64);

impl MediaTime {
    /// From seconds.
    pub fn from_secs(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// Seconds since `earlier`; negative if `earlier` is later.
    pub fn since(self, earlier: MediaTime) -> f64 {
        (self.0 - earlier.0) as f64 * 1e-9
    }
}

/// Which clock a capture time came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Clock {
    /// The camera's own wall clock, by its RTCP sender reports.
    Rtcp,
    /// This machine's wall clock when the frame arrived.
    Arrival,
    /// The media's own time line, counted from the Unix epoch (a file read as fast as it goes).
    Media,
}

impl Clock {
    /// The name used on the wire.
    pub fn as_str(self) -> &'static str {
        match self {
            Clock::Rtcp => "rtcp",
            Clock::Arrival => "arrival",
            Clock::Media => "media",
        }
    }
}

/// When a frame was captured: nanoseconds since the Unix epoch, and the clock that says so.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CaptureTime {
    /// Nanoseconds since 1970-01-01T00:00:00Z.
    pub unix_ns: i64,
    /// The clock.
    pub clock: Clock,
}
