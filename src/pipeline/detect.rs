//! Frames to detections: keeps a few frames of a camera in the detector at once, and their order.

use std::sync::Arc;
use std::time::Instant;

use futures::StreamExt;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

use super::turns::Turns;
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
    /// Its place among the camera's frames under way; given back when the frame is done.
    pub place: OwnedSemaphorePermit,
}

/// How many frames may be where.
pub struct Share {
    /// Of this camera, in the detector at once.
    pub in_flight: usize,
    /// Of this camera, from the mailbox to the tracks.
    pub places: Arc<Semaphore>,
    /// Of all live cameras in the detector; `None` for files, which wait instead of growing old.
    pub turns: Option<Turns>,
}

/// Runs until the mailbox is closed and empty, or nobody takes the detections.
pub async fn run(
    mailbox: Arc<Mailbox<Captured>>,
    detector: Detector,
    share: Share,
    out: mpsc::Sender<Detected>,
    metrics: Arc<Metrics>,
) {
    let (wait, detect) = (metrics.stage(Stage::Wait), metrics.stage(Stage::Detect));
    let Share { in_flight, places, turns } = share;
    let frames = futures::stream::unfold((mailbox, places, turns), |(mailbox, places, turns)| async move {
        // Whoever has no frame stands in nobody's way.
        if !mailbox.ready().await {
            return None;
        }
        let place = places.clone().acquire_owned().await.ok()?;
        let turn = match &turns {
            Some(turns) => turns.next().await,
            None => None,
        };
        let captured = mailbox.take().await?;
        Some(((captured, place, turn), (mailbox, places, turns)))
    });
    let mut detected = std::pin::pin!(
        frames
            .map(|(Captured { frame, mut ticket }, place, turn)| {
                let detector = detector.clone();
                wait.observe(frame.decoded.elapsed().as_secs_f64());
                ticket.step(Step::Wait, frame.decoded);
                async move {
                    let start = Instant::now();
                    let answer = detector.detect(frame.image.clone()).await;
                    drop(turn);
                    ticket.step(Step::Detect, start);
                    (frame, ticket, place, answer, start.elapsed())
                }
            })
            .buffered(in_flight.max(1))
    );
    while let Some((frame, ticket, place, answer, took)) = detected.next().await {
        detect.observe(took.as_secs_f64());
        match answer {
            Ok(detections) => {
                if out.send(Detected { frame, ticket, detections, place }).await.is_err() {
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
