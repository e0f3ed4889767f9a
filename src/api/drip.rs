//! Bodies that do not end: parts to a client one after the other, until it goes.

use std::convert::Infallible;

use axum::body::{Body, Bytes};
use futures::stream::unfold;
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::socket::{SEND_TIMEOUT, Ticket};

/// What comes next.
pub(super) trait Parts: Send + 'static {
    /// The next part; `None` at the end. Cancel safe.
    fn next(&mut self) -> impl Future<Output = Option<Bytes>> + Send;
}

/// A body of `parts`. It ends with them, with the client, with its token or with the service; a client that takes
/// nothing for [`SEND_TIMEOUT`] is let go.
pub(super) fn body(parts: impl Parts, ticket: Ticket) -> Body {
    // One part at most waits for the connection, so what is sent is new.
    let (sender, receiver) = mpsc::channel::<Bytes>(1);
    tokio::spawn(feed(parts, sender, ticket));
    Body::from_stream(unfold(receiver, async |mut receiver| {
        Some((Ok::<_, Infallible>(receiver.recv().await?), receiver))
    }))
}

async fn feed(mut parts: impl Parts, sender: mpsc::Sender<Bytes>, mut ticket: Ticket) {
    while ticket.pass.is_valid() {
        // Room first, then the part: it is the newest at the moment when it can go.
        let room = tokio::select! {
            () = ticket.stop.stopped() => return,
            room = timeout(SEND_TIMEOUT, sender.reserve()) => room,
        };
        let room = match room {
            Ok(Ok(room)) => room,
            Ok(Err(_)) => return,
            Err(_) => return ticket.give_up(),
        };
        let part = tokio::select! {
            () = ticket.stop.stopped() => return,
            () = sender.closed() => return,
            part = parts.next() => part,
        };
        let Some(part) = part else { return };
        room.send(part);
    }
}
