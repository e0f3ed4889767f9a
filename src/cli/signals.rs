//! Being told to end, and to read the configuration again.

#[cfg(feature = "service")]
use std::sync::Arc;

use anyhow::{Context, Result};
use tokio::signal::unix::{Signal, SignalKind, signal};

/// SIGTERM and SIGINT. From here on they end nothing by themselves.
pub struct Signals {
    term: Signal,
    int: Signal,
}

impl Signals {
    /// Needs a tokio runtime.
    pub fn listen() -> Result<Self> {
        let listen = |kind| signal(kind).context("cannot listen for signals");
        Ok(Self { term: listen(SignalKind::terminate())?, int: listen(SignalKind::interrupt())? })
    }

    /// Resolves at the next one; one that came meanwhile counts. Cancel safe.
    pub async fn next(&mut self) {
        tokio::select! {
            _ = self.term.recv() => {}
            _ = self.int.recv() => {}
        }
    }
}

/// Reads the configuration again at every SIGHUP. From here on it ends nothing.
///
/// # Errors
/// The signal cannot be listened for.
#[cfg(feature = "service")]
pub fn on_hangup(operations: Arc<impl crate::api::Operations + 'static>) -> Result<impl Future<Output = ()>> {
    let mut hangup = signal(SignalKind::hangup()).context("cannot listen for signals")?;
    Ok(async move {
        while hangup.recv().await.is_some() {
            // What came of it is logged.
            let _ = operations.reload().await;
        }
    })
}
