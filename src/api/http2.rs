//! HTTP/2, which gRPC needs: the same routes, and bounds of its own.
//!
//! Each stream is a task, so a client that takes nothing from one of them is cut off from that one alone.

use std::future::pending;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper::rt::Executor;
use hyper::server::conn::http2;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{Notify, watch};
use tokio::time::{sleep, timeout};

use super::server::{HEADER_TIMEOUT, MAX_HEAD, PEER_TIMEOUT, Stop};

/// Requests under way on one connection; a client that wants more waits.
const MAX_STREAMS: u32 = 32;
/// Bytes of a request's body that a client may send before they are read: as much as a body may have.
const BODY_WINDOW: u32 = 64 * 1024;
/// The same for all requests of a connection.
const CONNECTION_WINDOW: u32 = 256 * 1024;
/// Bytes of an answer that may wait for the connection. More would be old when it arrives, and the hub, which keeps the
/// newest, would not notice.
const UNSENT: usize = 16 * 1024;
/// How often a client is asked whether it is there.
const PING_EVERY: Duration = Duration::from_secs(10);

tokio::task_local! {
    static STREAM: Cut;
}

/// Ends one HTTP/2 stream, whatever waits in it.
#[derive(Clone, Default)]
pub(super) struct Cut(Arc<Notify>);

impl Cut {
    /// Of the request that is being answered; `None` for HTTP/1, whose streams are connections.
    pub fn current() -> Option<Self> {
        STREAM.try_with(Self::clone).ok()
    }

    /// Ends it in a while, if it has not ended by then.
    pub fn after(self, wait: Duration) {
        tokio::spawn(async move {
            sleep(wait).await;
            self.0.notify_one();
        });
    }
}

/// Runs a connection's streams and knows how many there are.
#[derive(Clone)]
struct Streams(watch::Sender<usize>);

impl<F: Future<Output = ()> + Send + 'static> Executor<F> for Streams {
    fn execute(&self, stream: F) {
        let (active, cut) = (Active::new(&self.0), Cut::default());
        tokio::spawn(STREAM.scope(cut.clone(), async move {
            let _active = active;
            // Dropped in the middle, a stream is reset.
            tokio::select! {
                () = stream => {}
                () = cut.0.notified() => {}
            }
        }));
    }
}

/// One of the streams, for as long as it lives.
struct Active(watch::Sender<usize>);

impl Active {
    fn new(count: &watch::Sender<usize>) -> Self {
        count.send_modify(|count| *count += 1);
        Self(count.clone())
    }
}

impl Drop for Active {
    fn drop(&mut self) {
        self.0.send_modify(|count| *count -= 1);
    }
}

/// Requests and answers over one connection.
pub(super) async fn converse(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    router: Router,
    mut stop: Stop,
) {
    let (count, mut active) = watch::channel(0);
    let mut builder = http2::Builder::new(Streams(count));
    builder
        .timer(TokioTimer::new())
        .max_concurrent_streams(MAX_STREAMS)
        .max_header_list_size(MAX_HEAD as u32)
        .initial_stream_window_size(BODY_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .max_send_buf_size(UNSENT)
        .keep_alive_interval(PING_EVERY)
        .keep_alive_timeout(PEER_TIMEOUT);
    let connection = builder.serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    let mut connection = std::pin::pin!(connection);
    let mut ending = false;
    let ended = loop {
        tokio::select! {
            ended = connection.as_mut() => break ended,
            () = stop.stopped(), if !ending => {}
            // A client that was told to go, and neither went nor asked for anything.
            () = idle(&mut active) => if ending { return },
        }
        connection.as_mut().graceful_shutdown();
        ending = true;
    };
    if let Err(error) = ended {
        tracing::debug!(%error, "a connection ended early");
    }
}

/// Resolves once there has been no stream for as long as a connection may sit idle.
async fn idle(active: &mut watch::Receiver<usize>) {
    loop {
        if active.wait_for(|count| *count == 0).await.is_err() {
            // The connection is gone, which others notice.
            return pending().await;
        }
        if timeout(HEADER_TIMEOUT, active.wait_for(|count| *count > 0)).await.is_err() {
            return;
        }
    }
}
