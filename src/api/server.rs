//! Accepting connections, and ending in order.

use std::io;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use socket2::SockRef;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsAcceptor;

use super::socket::{KeepAlive, Sockets};
use super::{ApiConfig, http2, router};

/// Plain HTTP connections at a time, WebSockets not among them. More wait in the kernel's backlog.
const MAX_CONNECTIONS: usize = 512;
/// Longest head of a request, bytes.
pub(super) const MAX_HEAD: usize = 32 * 1024;
/// How long a connection may take to send a request's head, and to sit idle between requests.
pub(super) const HEADER_TIMEOUT: Duration = Duration::from_secs(15);
/// How long sent bytes may stay unacknowledged before the peer counts as dead.
pub(super) const PEER_TIMEOUT: Duration = Duration::from_secs(20);
/// Bytes that may wait in the kernel beyond what the network has under way. More would be handed to
/// a slow client long after it was news, and the hub, which keeps the newest, would not notice.
#[cfg(target_os = "linux")]
const UNSENT: u32 = 16 * 1024;
/// How long connections have to end once the service stops.
const DRAIN: Duration = Duration::from_millis(1500);

/// Tells long-lived streams that the service stops. While anyone holds one, draining waits for it.
#[derive(Clone)]
pub(super) struct Stop(watch::Receiver<bool>);

impl Stop {
    /// Resolves once the service stops. Cancel safe.
    pub async fn stopped(&mut self) {
        // An error means that the server itself is gone: that is stopping too.
        let _ = self.0.wait_for(|stopping| *stopping).await;
    }

    /// Whether the service is stopping.
    pub fn is_stopping(&self) -> bool {
        *self.0.borrow()
    }
}

/// Serves the API on `listener` until `shutdown` resolves. Then it accepts nothing more, lets running
/// requests finish, closes WebSockets with code 1001, and returns within two seconds.
///
/// # Errors
/// The listener cannot be read at all; errors of single connections are theirs alone.
pub async fn serve(
    listener: TcpListener,
    config: ApiConfig,
    shutdown: impl Future<Output = ()> + Send,
) -> io::Result<()> {
    serve_with(listener, config, KeepAlive::default(), shutdown).await
}

/// [`serve`] with another idea of when a WebSocket's client is gone.
///
/// # Errors
/// As [`serve`].
pub async fn serve_with(
    listener: TcpListener,
    config: ApiConfig,
    keep_alive: KeepAlive,
    shutdown: impl Future<Output = ()> + Send,
) -> io::Result<()> {
    listener.local_addr()?;
    let (stop, stopped) = watch::channel(false);
    let tls = config.tls.clone().map(TlsAcceptor::from);
    let router = router(config, Sockets { keep_alive, stop: Stop(stopped.clone()) });
    let mut connections = JoinSet::new();
    let mut shutdown = std::pin::pin!(shutdown);
    loop {
        tokio::select! {
            biased;
            () = &mut shutdown => break,
            Some(_) = connections.join_next() => {}
            accepted = listener.accept(), if connections.len() < MAX_CONNECTIONS => match accepted {
                Ok((stream, _)) => {
                    connections.spawn(connection(stream, tls.clone(), router.clone(), Stop(stopped.clone())));
                }
                Err(error) => {
                    // Out of file descriptors, or a peer that hung up at once: neither is the end.
                    tracing::warn!(%error, "a connection could not be accepted");
                    sleep(Duration::from_millis(100)).await;
                }
            },
        }
    }
    drop((listener, router, stopped));
    stop.send_replace(true);
    let drained = timeout(DRAIN, async {
        while connections.join_next().await.is_some() {}
        stop.closed().await;
    });
    if drained.await.is_err() {
        tracing::warn!("connections were cut off because they did not end in time");
    }
    Ok(())
}

async fn connection(stream: TcpStream, tls: Option<TlsAcceptor>, router: Router, mut stop: Stop) {
    // Frames and tracks are small and wanted at once. A peer that vanished without a word is found
    // by its bytes that nobody acknowledges.
    let _ = stream.set_nodelay(true);
    #[cfg(target_os = "linux")]
    {
        let socket = SockRef::from(&stream);
        let _ = socket.set_tcp_user_timeout(Some(PEER_TIMEOUT));
        let _ = socket.set_tcp_notsent_lowat(UNSENT);
    }
    let Some(tls) = tls else {
        let begun = tokio::select! {
            begun = timeout(HEADER_TIMEOUT, begins_http2(&stream)) => begun,
            () = stop.stopped() => return,
        };
        return match begun {
            Ok(Ok(true)) => http2::converse(stream, router, stop).await,
            Ok(Ok(false)) => converse(stream, router, stop).await,
            Ok(Err(error)) => tracing::debug!(%error, "a connection ended early"),
            Err(_) => tracing::debug!("a connection was opened and not used"),
        };
    };
    let shaken = tokio::select! {
        shaken = timeout(HEADER_TIMEOUT, tls.accept(stream)) => shaken,
        () = stop.stopped() => return,
    };
    match shaken {
        Ok(Ok(stream)) if stream.get_ref().1.alpn_protocol() == Some(b"h2") => {
            http2::converse(stream, router, stop).await;
        }
        Ok(Ok(stream)) => converse(stream, router, stop).await,
        Ok(Err(error)) => tracing::debug!(%error, "a TLS handshake failed"),
        Err(_) => tracing::debug!("a TLS handshake took too long"),
    }
}

/// Whether a client begins as HTTP/2 does, `PRI * HTTP/2.0`; no method of HTTP/1 begins so. Nothing is taken.
async fn begins_http2(stream: &TcpStream) -> io::Result<bool> {
    const PREFACE: &[u8] = b"PRI";
    let mut start = [0; PREFACE.len()];
    loop {
        let n = stream.peek(&mut start).await?;
        if n == 0 || n == PREFACE.len() || start[..n] != PREFACE[..n] {
            return Ok(start[..n] == *PREFACE);
        }
        // One or two bytes of three: they stay readable, so nothing tells when there are more.
        sleep(Duration::from_millis(10)).await;
    }
}

/// Requests and answers over one connection of HTTP/1.
async fn converse(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    router: Router,
    mut stop: Stop,
) {
    let service = TowerToHyperService::new(router);
    let mut builder = http1::Builder::new();
    builder.timer(TokioTimer::new()).header_read_timeout(HEADER_TIMEOUT).max_buf_size(MAX_HEAD);
    let mut connection =
        std::pin::pin!(builder.serve_connection(TokioIo::new(stream), service).with_upgrades());
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = stop.stopped() => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        tracing::debug!(%error, "a connection ended early");
    }
}
