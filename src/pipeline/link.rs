//! Pairs to link probabilities: the pairs of all cameras, scored side by side.

use futures::StreamExt;
use tokio::sync::mpsc;

use super::tracker::{Slot, ToTracker};
use crate::infer::Linker;
use crate::track::LinkRequest;

/// Pairs of one camera's frame in hand.
pub struct LinkJob {
    /// Whose.
    pub slot: Slot,
    /// The pairs; never empty.
    pub request: LinkRequest,
}

/// Runs until the tracker's thread is gone.
pub async fn run(jobs: mpsc::Receiver<LinkJob>, linker: Linker, answers: mpsc::WeakSender<ToTracker>) {
    let jobs = futures::stream::unfold(jobs, |mut jobs| async move {
        let job = jobs.recv().await?;
        Some((job, jobs))
    });
    jobs.for_each_concurrent(None, |LinkJob { slot, request }| {
        let (linker, answers) = (linker.clone(), answers.clone());
        async move {
            let links = linker.score(request).await;
            // Weak, so that the tracker's thread can end: when it is gone, nobody wants the answer.
            if let Some(answers) = answers.upgrade() {
                let _ = answers.send(ToTracker::Links { slot, links }).await;
            }
        }
    })
    .await;
}
