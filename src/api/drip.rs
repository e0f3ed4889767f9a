//! Bodies that do not end: parts to a client one after the other, until it goes.

use std::convert::Infallible;

use axum::body::{Body, Bytes};
use futures::stream::unfold;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio::time::timeout;

use super::server::Stop;
use super::socket::{Pass, SEND_TIMEOUT};

/// What comes next.
pub(super) trait Parts: Send + 'static {
    /// The next part; `None` at the end. Cancel safe.
    fn next(&mut self) -> impl Future<Output = Option<Bytes>> + Send;
}

/// A body of `parts`. It ends with them, with the client, with its token or with the service; a client that takes
/// nothing for [`SEND_TIMEOUT`] is let go.
pub(super) fn body(parts: impl Parts, stop: Stop, pass: Pass, seat: OwnedSemaphorePermit) -> Body {
    // One part at most waits for the connection, so what is sent is new.
    let (sender, receiver) = mpsc::channel::<Bytes>(1);
    tokio::spawn(async move {
        let _seat = seat;
        feed(parts, sender, stop, pass).await;
    });
    Body::from_stream(unfold(receiver, async |mut receiver| {
        Some((Ok::<_, Infallible>(receiver.recv().await?), receiver))
    }))
}

async fn feed(mut parts: impl Parts, sender: mpsc::Sender<Bytes>, mut stop: Stop, pass: Pass) {
    while pass.is_valid() {
        // Room first, then the part: it is the newest at the moment when it can go.
        let room = tokio::select! {
            () = stop.stopped() => return,
            room = timeout(SEND_TIMEOUT, sender.reserve()) => room,
        };
        let Ok(Ok(room)) = room else { return };
        let part = tokio::select! {
            () = stop.stopped() => return,
            () = sender.closed() => return,
            part = parts.next() => part,
        };
        let Some(part) = part else { return };
        room.send(part);
    }
}
