//! Frames to detections: keeps a few frames of a camera in the detector at once, and their order.

use std::sync::Arc;
use std::time::Instant;

use futures::StreamExt;
use tokio::sync::mpsc;

use super::{Mailbox, Ticket};
use crate::detect::Detector;
use crate::telemetry::{DropReason, Metrics, Stage};
use crate::traces::Step;
use crate::types::{Detection, Frame};

/// A frame from the source.
pub struct Captured {
    /// The frame.
    pub frame: Arc<Frame>,
    /// Its place in the account.
    pub ticket: Ticket,
}

/// A frame with its detections.
pub struct Detected {
    /// The frame.
    pub frame: Arc<Frame>,
    /// Its place in the account.
    pub ticket: Ticket,
    /// What was detected.
    pub detections: Vec<Detection>,
}

/// Runs until the mailbox is closed and empty, or nobody takes the detections.
pub async fn run(
    mailbox: Arc<Mailbox<Captured>>,
    detector: Detector,
    in_flight: usize,
    out: mpsc::Sender<Detected>,
    metrics: Arc<Metrics>,
) {
    let (wait, detect) = (metrics.stage(Stage::Wait), metrics.stage(Stage::Detect));
    let frames = futures::stream::unfold(mailbox, |mailbox| async move {
        let captured = mailbox.take().await?;
        Some((captured, mailbox))
    });
    let mut detected = std::pin::pin!(
        frames
            .map(|Captured { frame, mut ticket }| {
                let detector = detector.clone();
                wait.observe(frame.decoded.elapsed().as_secs_f64());
                ticket.step(Step::Wait, frame.decoded);
                async move {
                    let start = Instant::now();
                    let answer = detector.detect(frame.image.clone()).await;
                    ticket.step(Step::Detect, start);
                    (frame, ticket, answer, start.elapsed())
                }
            })
            .buffered(in_flight.max(1))
    );
    while let Some((frame, ticket, answer, took)) = detected.next().await {
        detect.observe(took.as_secs_f64());
        match answer {
            Ok(detections) => {
                if out.send(Detected { frame, ticket, detections }).await.is_err() {
                    return;
                }
            }
            Err(error) => {
                tracing::warn!(camera = %frame.camera, frame = frame.index, %error, "detection failed");
                ticket.dropped(DropReason::Inference);
            }
        }
    }
}
