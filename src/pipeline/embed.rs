//! Detections to embeddings, and on to the tracker's thread.

use std::sync::Arc;
use std::time::Instant;

use futures::StreamExt;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

use super::Ticket;
use super::detect::Detected;
use super::tracker::Seat;
use crate::embed::Embedder;
use crate::telemetry::{DropReason, Metrics, Stage};
use crate::traces::Step;
use crate::types::{Detection, Embedding, Frame};

/// A frame with everything that the tracker needs.
pub struct Embedded {
    /// The frame.
    pub frame: Arc<Frame>,
    /// Its place in the account.
    pub ticket: Ticket,
    /// What was detected.
    pub detections: Vec<Detection>,
    /// One entry a detection, or empty.
    pub embeddings: Vec<Option<Embedding>>,
    /// The camera's share of the tracker's queue; given back when the frame is done.
    pub permit: OwnedSemaphorePermit,
}

/// Frames of one camera that may wait for the tracker.
const AT_TRACKER: usize = 2;

/// Runs until there are no more detections, or the tracker is gone. `embedder` is `None` when
/// appearance is turned off.
pub async fn run(
    detected: mpsc::Receiver<Detected>,
    embedder: Option<Embedder>,
    in_flight: usize,
    seat: Seat,
    metrics: Arc<Metrics>,
) {
    let embed = metrics.stage(Stage::Embed);
    let room = Arc::new(Semaphore::new(AT_TRACKER));
    let arriving = futures::stream::unfold(detected, |mut detected| async move {
        let next = detected.recv().await?;
        Some((next, detected))
    });
    let mut embedded = std::pin::pin!(
        arriving
            .map(|Detected { frame, mut ticket, detections }| {
                let embedder = embedder.clone();
                async move {
                    let start = Instant::now();
                    let answer = match &embedder {
                        Some(embedder) if !detections.is_empty() => {
                            let boxes = detections.iter().map(|d| d.bbox).collect();
                            embedder.embed(frame.image.clone(), boxes).await
                        }
                        _ => Ok(Vec::new()),
                    };
                    ticket.step(Step::Embed, start);
                    (frame, ticket, detections, answer, start.elapsed())
                }
            })
            .buffered(in_flight.max(1))
    );
    while let Some((frame, ticket, detections, answer, took)) = embedded.next().await {
        embed.observe(took.as_secs_f64());
        let embeddings = match answer {
            Ok(embeddings) => embeddings,
            Err(error) => {
                tracing::warn!(camera = %frame.camera, frame = frame.index, %error, "embedding failed");
                ticket.dropped(DropReason::Inference);
                continue;
            }
        };
        let Ok(permit) = room.clone().acquire_owned().await else { return };
        if seat.frame(Embedded { frame, ticket, detections, embeddings, permit }).await.is_err() {
            return;
        }
    }
}
