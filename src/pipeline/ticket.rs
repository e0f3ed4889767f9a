//! The exact account of frames: `frames_in = tracked + sum of drops{reason}`.

use std::sync::Arc;
use std::time::Instant;

use crate::telemetry::{CameraMetrics, DropReason};
use crate::traces::{FrameTrace, Outcome, Step};

/// One frame's place in the account. Made when the frame comes in, settled exactly once: as tracked,
/// as dropped for a reason, or, when it is let go of unsettled, as stopped (by a panic, as failed).
pub struct Ticket {
    metrics: Arc<CameraMetrics>,
    trace: Option<Box<FrameTrace>>,
    settled: bool,
}

impl Ticket {
    /// Counts a frame in; its trace, if it has one, ends with its account.
    pub fn new(metrics: Arc<CameraMetrics>, trace: Option<Box<FrameTrace>>) -> Self {
        metrics.frames_in.inc();
        Self { metrics, trace, settled: false }
    }

    /// A step of the frame that began at `began` has just ended.
    pub fn step(&mut self, step: Step, began: Instant) {
        if let Some(trace) = &mut self.trace {
            trace.step(step, began);
        }
    }

    /// The frame was tracked.
    pub fn tracked(mut self) {
        self.settled = true;
        self.metrics.tracked.inc();
        self.trace(Outcome::Tracked);
    }

    /// The frame was dropped.
    pub fn dropped(mut self, reason: DropReason) {
        self.settle(reason);
    }

    fn settle(&mut self, reason: DropReason) {
        self.settled = true;
        self.metrics.dropped[reason as usize].inc();
        self.trace(Outcome::Dropped(reason));
    }

    fn trace(&mut self, outcome: Outcome) {
        if let Some(trace) = self.trace.take() {
            trace.finish(outcome);
        }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        if !self.settled {
            let panics = std::thread::panicking();
            self.settle(if panics { DropReason::Inference } else { DropReason::Stopped });
        }
    }
}
