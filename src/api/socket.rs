//! What every WebSocket here has in common: who may open one, keep-alive, slow and dead peers, closing.

use std::pin::pin;
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;

use axum::extract::FromRequestParts;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use futures::FutureExt;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::ApiState;
use super::http2::Cut;
use super::problem::Problem;
use super::server::Stop;
use crate::auth::{Gate, Identity};

/// Long-lived streams at a time (WebSockets, Server-Sent Events, gRPC, MJPEG).
const MAX_STREAMS: usize = 256;
/// A peer that takes no byte for so long is gone.
pub(super) const SEND_TIMEOUT: Duration = Duration::from_secs(10);
/// How long what was last said waits for a peer that took nothing for [`SEND_TIMEOUT`].
const LAST_WORD: Duration = Duration::from_secs(10);
/// How long a closing peer has to answer.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);
/// Messages that are sent without a look at what came in, at the clock, or at whether the service stops.
const MOST_IN_A_ROW: usize = 16;
/// Longest message taken from a client: none is expected, pongs have at most 125 bytes.
const MAX_INCOMING: usize = 4096;
/// Bytes that are read at a time; clients send little.
const READ_BUFFER: usize = 2048;

/// How a WebSocket finds out that its client is gone.
#[derive(Clone, Copy, Debug)]
pub struct KeepAlive {
    /// How often a client is asked whether it is there.
    pub ping_every: Duration,
    /// A client that has said nothing for so long, not even pong, is gone.
    pub dead_after: Duration,
}

impl Default for KeepAlive {
    fn default() -> Self {
        Self { ping_every: Duration::from_secs(10), dead_after: Duration::from_secs(30) }
    }
}

/// What every WebSocket of this service goes by.
#[derive(Clone)]
pub(super) struct Sockets {
    pub keep_alive: KeepAlive,
    pub stop: Stop,
}

/// Whose stream it is. A stream ends soon after its bearer's token.
pub(super) struct Pass {
    gate: Arc<Gate>,
    identity: Option<Identity>,
}

impl Pass {
    pub fn is_valid(&self) -> bool {
        self.identity.as_ref().is_some_and(|identity| self.gate.still_knows(identity))
    }
}

/// Bounds the streams that are open at a time.
#[derive(Clone)]
pub(super) struct Seats(Arc<Semaphore>);

impl Default for Seats {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(MAX_STREAMS)))
    }
}

impl Seats {
    /// A seat for one stream, free again when dropped.
    pub fn take(&self) -> Result<OwnedSemaphorePermit, Problem> {
        self.0.clone().try_acquire_owned().map_err(|_| {
            Problem::unavailable(format!(
                "{MAX_STREAMS} streams are open, which is the limit; try again later"
            ))
        })
    }
}

/// A place among the streams that are open, free again when dropped, and whose it is.
pub(super) struct Ticket {
    _seat: OwnedSemaphorePermit,
    pub pass: Pass,
    pub stop: Stop,
    cut: Option<Cut>,
}

impl Ticket {
    /// Gives up a client that takes nothing any more. It has a last while to hear why; then what still waits for it is
    /// dropped. A stream of HTTP/1 ends with its connection, which the kernel gives up.
    pub fn give_up(self) {
        if let Some(cut) = self.cut {
            cut.after(LAST_WORD);
        }
    }
}

impl FromRequestParts<ApiState> for Ticket {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &ApiState) -> Result<Self, Problem> {
        let identity = parts.extensions.get::<Option<Identity>>().cloned().flatten();
        let pass = Pass { gate: state.gate.clone(), identity };
        Ok(Self { _seat: state.seats.take()?, pass, stop: state.sockets.stop.clone(), cut: Cut::current() })
    }
}

/// A WebSocket that may be opened.
pub(super) struct Opening {
    upgrade: WebSocketUpgrade,
    keep_alive: KeepAlive,
    ticket: Ticket,
}

/// Takes the upgrade if it is one and its origin may: a page of another site must not read tracks or
/// pictures through its visitor's browser. Clients that are no browser send no `Origin`.
impl FromRequestParts<ApiState> for Opening {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &ApiState) -> Result<Self, Problem> {
        let upgrade = WebSocketUpgrade::from_request_parts(parts, state).await.map_err(|rejection| {
            Problem::upgrade_required(format!("open it with a WebSocket client: {}", rejection.body_text()))
        })?;
        if !same_origin(&parts.headers) {
            return Err(Problem::forbidden_origin(
                "a browser may open this WebSocket only from a page of this service",
            ));
        }
        let upgrade = upgrade
            .max_message_size(MAX_INCOMING)
            .max_frame_size(MAX_INCOMING)
            // The library clears as much whenever it looks whether something came: at each message that is sent.
            .read_buffer_size(READ_BUFFER);
        let ticket = Ticket::from_request_parts(parts, state).await?;
        Ok(Self { upgrade, keep_alive: state.sockets.keep_alive, ticket })
    }
}

impl Opening {
    /// Agrees on the first of the client's subprotocols that is `known`; [`Opening::protocol`] is that.
    pub fn protocols(mut self, known: [&'static str; 2]) -> Self {
        self.upgrade = self.upgrade.protocols(known);
        self
    }

    pub fn protocol(&self) -> Option<&HeaderValue> {
        self.upgrade.selected_protocol()
    }

    /// The answer; the socket then sends what `outgoing` has.
    pub fn run(self, outgoing: impl Outgoing + 'static) -> Response {
        let Self { upgrade, keep_alive, ticket } = self;
        upgrade.on_upgrade(move |socket| run(socket, keep_alive, ticket, outgoing))
    }
}

pub(super) fn same_origin(headers: &HeaderMap) -> bool {
    let Some(origin) = headers.get(header::ORIGIN) else { return true };
    let text = |value: &HeaderValue| value.to_str().ok().map(str::to_ascii_lowercase);
    let Some(origin) = text(origin) else { return false };
    let host = headers.get(header::HOST).and_then(text);
    // The scheme is not compared: behind a proxy that ends TLS it differs.
    let authority = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
    authority.is_some() && authority == host.as_deref()
}

/// What a socket sends.
pub(super) trait Outgoing: Send {
    /// The next message; `None` at the end. Cancel safe.
    fn next(&mut self) -> impl Future<Output = Option<Message>> + Send;

    /// What to say when [`Outgoing::next`] ended: close code and reason.
    fn farewell(&self) -> (u16, &'static str) {
        (close_code::NORMAL, "the stream ended")
    }
}

/// Sends what `outgoing` has until it ends, the peer goes, or the service stops.
async fn run(mut socket: WebSocket, keep_alive: KeepAlive, ticket: Ticket, mut outgoing: impl Outgoing) {
    let Ticket { _seat, pass, mut stop, .. } = ticket;
    let mut ping = interval(keep_alive.ping_every);
    ping.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut heard = Instant::now();
    let mut stopped = pin!(stop.stopped());
    let mut in_a_row = 0;
    let (code, reason) = loop {
        // What wakes a stream is a message, nearly always, and hundreds of streams wake for the same one: it goes out
        // before anything else is looked at.
        let at_once = if in_a_row < MOST_IN_A_ROW { outgoing.next().now_or_never() } else { None };
        in_a_row = if at_once.is_some() { in_a_row + 1 } else { 0 };
        let message = match at_once {
            Some(Some(message)) => message,
            Some(None) => break outgoing.farewell(),
            None => tokio::select! {
                biased;
                () = &mut stopped => break (close_code::AWAY, "the service stops"),
                incoming = socket.recv() => match incoming {
                    // The library answers pings and closes by itself.
                    Some(Ok(Message::Close(_)) | Err(_)) | None => return,
                    Some(Ok(_)) => {
                        heard = Instant::now();
                        continue;
                    }
                },
                _ = ping.tick() => {
                    if heard.elapsed() > keep_alive.dead_after {
                        return;
                    }
                    if !pass.is_valid() {
                        break (close_code::POLICY, "the token was revoked");
                    }
                    Message::Ping(Default::default())
                }
                message = outgoing.next() => match message {
                    Some(message) => message,
                    None => break outgoing.farewell(),
                },
            },
        };
        let mut sending = pin!(socket.send(message));
        let sent = match futures::poll!(&mut sending) {
            Poll::Ready(sent) => sent.is_ok(),
            Poll::Pending => {
                // A slow client: what came in, the clock and the token are looked at after each message.
                in_a_row = MOST_IN_A_ROW;
                tokio::select! {
                    biased;
                    sent = timeout(SEND_TIMEOUT, sending) => matches!(sent, Ok(Ok(()))),
                    // In the middle of a message there is no saying goodbye.
                    () = &mut stopped => false,
                }
            }
        };
        if !sent {
            return;
        }
    };
    let _ = timeout(CLOSE_TIMEOUT, close(&mut socket, code, reason)).await;
}

/// Says goodbye and reads on until the peer has answered; closing with unread bytes would reset the
/// connection and lose the goodbye.
async fn close(socket: &mut WebSocket, code: u16, reason: &'static str) {
    let goodbye = Message::Close(Some(CloseFrame { code, reason: reason.into() }));
    if socket.send(goodbye).await.is_ok() {
        while let Some(Ok(_)) = socket.recv().await {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_our_own_pages_may_connect() {
        for (host, origin, allowed) in [
            ("cam:8080", None, true),
            ("cam:8080", Some("http://cam:8080"), true),
            ("cam:8080", Some("http://CAM:8080"), true),
            ("cam", Some("https://cam"), true),
            ("[::1]:80", Some("http://[::1]:80"), true),
            ("cam:8080", Some("http://cam:8081"), false),
            ("cam:8080", Some("http://evil.example"), false),
            ("cam:8080", Some("http://cam:8080.evil.example"), false),
            ("cam:8080", Some("null"), false),
            ("cam:8080", Some("file://cam:8080"), false),
        ] {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, host.parse().unwrap());
            if let Some(origin) = origin {
                headers.insert(header::ORIGIN, origin.parse().unwrap());
            }
            assert_eq!(same_origin(&headers), allowed, "{host} {origin:?}");
        }
    }
}
