//! The exact account of frames: `frames_in = tracked + sum of drops{reason}`.

use std::sync::Arc;

use crate::telemetry::{CameraMetrics, DropReason};

/// One frame's place in the account. Made when the frame comes in, settled exactly once: as tracked,
/// as dropped for a reason, or, when it is let go of unsettled, as stopped.
pub struct Ticket {
    metrics: Arc<CameraMetrics>,
    settled: bool,
}

impl Ticket {
    /// Counts a frame in.
    pub fn new(metrics: Arc<CameraMetrics>) -> Self {
        metrics.frames_in.inc();
        Self { metrics, settled: false }
    }

    /// The frame was tracked.
    pub fn tracked(mut self) {
        self.settled = true;
        self.metrics.tracked.inc();
    }

    /// The frame was dropped.
    pub fn dropped(mut self, reason: DropReason) {
        self.settle(reason);
    }

    fn settle(&mut self, reason: DropReason) {
        self.settled = true;
        self.metrics.dropped[reason as usize].inc();
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        if !self.settled {
            self.settle(DropReason::Stopped);
        }
    }
}
