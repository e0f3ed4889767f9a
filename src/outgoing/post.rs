//! Posts to one address: HTTP/1.1 over a connection that is kept while it lasts.

use std::io;
use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::http::{HeaderMap, HeaderValue, Method, Request, StatusCode, header};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use hyper::client::conn::http1::{SendRequest, handshake};
use hyper_util::rt::TokioIo;
use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimeParser;
use tokio::task::AbortHandle;
use tokio_rustls::TlsConnector;

use super::endpoint::Address;

/// Longest answer that is read so that the connection can be used again.
const MAX_ANSWER: usize = 16 * 1024;

/// What was answered.
#[derive(Clone, Debug)]
pub(crate) struct Answer {
    pub status: StatusCode,
    /// How long the receiver wants to be left alone.
    pub retry_after: Option<Duration>,
    /// What it says; empty where it is too long to be read.
    pub body: Bytes,
}

/// Why there was no answer. The texts hold nothing of the URL.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PostError {
    #[error("cannot connect: {0}")]
    Connect(io::Error),
    #[error("the connection broke: {0}")]
    Http(#[from] hyper::Error),
    #[error("the request cannot be made: {0}")]
    Request(#[from] axum::http::Error),
}

/// Posts to one address.
pub(crate) struct Poster {
    address: Address,
    tls: Option<TlsConnector>,
    connection: Option<Connection>,
}

struct Connection {
    sender: SendRequest<Body>,
    driver: AbortHandle,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.driver.abort();
    }
}

impl Poster {
    pub fn new(address: Address, tls: Option<TlsConnector>) -> Self {
        Self { address, tls, connection: None }
    }

    /// Posts `body`. The caller bounds the time; dropped half-way, the next post takes a new connection.
    pub async fn post(&mut self, headers: &HeaderMap, body: Bytes) -> Result<Answer, PostError> {
        // Taken out: a post that is given up half-way leaves no connection behind that waits for its answer.
        if let Some(kept) = self.connection.take().filter(|kept| !kept.sender.is_closed()) {
            match self.exchange(kept, headers, body.clone()).await {
                // The receiver closed it meanwhile: that says nothing about the receiver.
                Err(PostError::Http(_)) => {}
                other => return other,
            }
        }
        let connection = self.connect().await?;
        self.exchange(connection, headers, body).await
    }

    async fn connect(&self) -> Result<Connection, PostError> {
        let stream = self.address.connect(self.tls.as_ref()).await.map_err(PostError::Connect)?;
        let (sender, connection) = handshake(TokioIo::new(stream)).await?;
        let driver = tokio::spawn(async move {
            // Told to whoever waits for the answer, too.
            if let Err(error) = connection.await {
                tracing::debug!(%error, "a connection ended");
            }
        });
        Ok(Connection { sender, driver: driver.abort_handle() })
    }

    async fn exchange(
        &mut self,
        mut connection: Connection,
        headers: &HeaderMap,
        body: Bytes,
    ) -> Result<Answer, PostError> {
        let mut request = Request::builder()
            .method(Method::POST)
            .uri(&self.address.path)
            .header(header::HOST, self.address.authority())
            .header(header::USER_AGENT, concat!("gakp/", env!("CARGO_PKG_VERSION")));
        if let Some(login) = &self.address.login {
            let pair = STANDARD.encode(format!("{}:{}", login.user, login.password));
            request = request.header(header::AUTHORIZATION, format!("Basic {pair}"));
        }
        let mut request = request.body(Body::from(body))?;
        request.headers_mut().extend(headers.clone());
        connection.sender.ready().await?;
        let response = connection.sender.send_request(request).await?;
        let status = response.status();
        let retry_after = response.headers().get(header::RETRY_AFTER).and_then(retry_after);
        // An answer that is longer, or breaks off, costs the connection and nothing else.
        let body = match to_bytes(Body::new(response.into_body()), MAX_ANSWER).await {
            Ok(body) => {
                self.connection = Some(connection);
                body
            }
            Err(_) => Bytes::new(),
        };
        Ok(Answer { status, retry_after, body })
    }
}

/// `Retry-After`: seconds, or a date.
fn retry_after(value: &HeaderValue) -> Option<Duration> {
    let text = value.to_str().ok()?.trim();
    if let Ok(seconds) = text.parse() {
        return Some(Duration::from_secs(seconds));
    }
    let at = DateTimeParser::new().parse_timestamp(text).ok()?;
    at.duration_since(Timestamp::now()).try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn retry_after_is_seconds_or_a_date() {
        let parse = |text: &str| retry_after(&HeaderValue::from_str(text).unwrap());
        assert_eq!(parse("120"), Some(Duration::from_secs(120)));
        for text in ["", "soon", "-1", "Sun, 06 Nov 1994 08:49:37 GMT"] {
            assert_eq!(parse(text), None, "{text}");
        }
        let later = parse("Thu, 31 Dec 2099 23:59:59 GMT").unwrap();
        assert!(later > Duration::from_secs(86_400));
    }
}
