//! Detections to embeddings, and on to the tracker's thread.

use std::sync::Arc;
use std::time::Instant;

use futures::StreamExt;
use tokio::sync::{OwnedSemaphorePermit, mpsc};

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
    /// Its place among the camera's frames under way; given back when the frame is done.
    pub place: OwnedSemaphorePermit,
}

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
    let arriving = futures::stream::unfold(detected, |mut detected| async move {
        let next = detected.recv().await?;
        Some((next, detected))
    });
    let mut embedded = std::pin::pin!(
        arriving
            .map(|Detected { frame, mut ticket, detections, place }| {
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
                    (frame, ticket, detections, place, answer, start.elapsed())
                }
            })
            .buffered(in_flight.max(1))
    );
    while let Some((frame, ticket, detections, place, answer, took)) = embedded.next().await {
        embed.observe(took.as_secs_f64());
        let embeddings = match answer {
            Ok(embeddings) => embeddings,
            Err(error) => {
                tracing::warn!(camera = %frame.camera, frame = frame.index, %error, "embedding failed");
                ticket.dropped(DropReason::Inference);
                continue;
            }
        };
        if seat.frame(Embedded { frame, ticket, detections, embeddings, place }).await.is_err() {
            return;
        }
    }
}
