//! Who is next at the detector, when it cannot take every frame.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::infer::Arrangement;

/// As many turns as the detector has use for, for all live cameras together: its workers are busy, and as much as one of
/// them takes next is waiting. A camera that wants another turn stands behind those that want one already, so cameras get
/// the same share, whatever their rates; and it chooses its newest frame when it is called, so that no frame grows
/// old in a queue, however many cameras there are.
#[derive(Clone)]
pub struct Turns(Arc<Semaphore>);

/// Given back when it is dropped.
pub struct Turn(#[expect(dead_code, reason = "held, not read")] OwnedSemaphorePermit);

impl Turns {
    /// Turns at a detector that runs like this.
    pub fn new(arrangement: Arrangement) -> Self {
        let Arrangement { workers, max_batch, .. } = arrangement;
        Self(Arc::new(Semaphore::new((workers.max(1) + 1) * max_batch.max(1))))
    }

    /// Waits for one, behind everybody who waits already.
    pub async fn next(&self) -> Option<Turn> {
        // Nobody closes it.
        self.0.clone().acquire_owned().await.ok().map(Turn)
    }
}
