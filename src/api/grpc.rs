//! gRPC, `proto/service.proto`: `/gakp.v1.Tracks/Subscribe` streams what the WebSocket `/v1/tracks` sends as protobuf.
//!
//! tonic frames messages and writes statuses; who may come in, seats and filters are those of the other forms. Reports go
//! out as the bytes that all subscribers share.

use std::time::Duration;

use axum::body::{Body, Bytes, HttpBody};
use axum::extract::{FromRequestParts, Request, State};
use axum::http::{HeaderValue, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use bytes::BufMut;
use futures::future::{Ready, ready};
use futures::stream::{BoxStream, StreamExt, unfold};
use prost::Message;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tonic::codec::{BufferSettings, Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::server::{Grpc, ServerStreamingService};
use tonic::{Code, Status};

use super::problem::Problem;
use super::socket::{SEND_TIMEOUT, Ticket};
use super::tracks::{Format, GIVEN_UP, Messages, Told, wishes};
use super::{ApiState, MAX_BODY_BYTES};
use crate::publish::wire::{SubscribeRequest, TrackState};

/// How long a request's message may take to arrive.
const MESSAGE_TIMEOUT: Duration = Duration::from_secs(10);
/// Messages that are ready go out together up to so many bytes; the rest waits where the newest wins.
const BATCH: usize = 4096;

/// What everything is wrapped in: HTTP/2 names the host in its own way, and gRPC its errors.
pub(super) async fn translate(mut request: Request, next: Next) -> Response {
    // `Host` is what sessions, WebSockets and the guard against DNS rebinding go by. Where both are there, this one wins
    // (RFC 9112, section 3.2.2; RFC 9113, section 8.3.1).
    let authority = request.uri().authority().and_then(|it| HeaderValue::from_str(it.as_str()).ok());
    if let Some(host) = authority {
        request.headers_mut().insert(header::HOST, host);
    }
    let is_call = request.method() == Method::POST && is_http2(&request) && is_grpc(&request);
    let response = next.run(request).await;
    match response.extensions().get::<Problem>() {
        Some(problem) if is_call => status(problem).into_http(),
        _ => response,
    }
}

fn is_http2(request: &Request) -> bool {
    request.version() == Version::HTTP_2
}

fn is_grpc(request: &Request) -> bool {
    let media_type = request.headers().get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let rest = media_type.and_then(|text| text.strip_prefix("application/grpc"));
    // `application/grpc-web` is another protocol.
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(['+', ';']))
}

fn status(problem: &Problem) -> Status {
    let (status, detail) = problem.parts();
    let code = match status {
        StatusCode::BAD_REQUEST => Code::InvalidArgument,
        StatusCode::UNAUTHORIZED => Code::Unauthenticated,
        StatusCode::FORBIDDEN => Code::PermissionDenied,
        StatusCode::NOT_FOUND if problem.is_unknown_camera() => Code::NotFound,
        StatusCode::NOT_FOUND | StatusCode::METHOD_NOT_ALLOWED => Code::Unimplemented,
        StatusCode::PAYLOAD_TOO_LARGE => Code::ResourceExhausted,
        StatusCode::SERVICE_UNAVAILABLE => Code::Unavailable,
        _ => Code::Internal,
    };
    Status::new(code, detail)
}

/// `POST /gakp.v1.Tracks/Subscribe`.
pub(super) async fn subscribe(State(state): State<ApiState>, request: Request) -> Response {
    if request.body().size_hint().lower() > MAX_BODY_BYTES as u64 {
        return Problem::too_large(format!("a body may have at most {MAX_BODY_BYTES} bytes")).into_response();
    }
    if !is_grpc(&request) {
        return Problem::media_type("call it with a gRPC client: `Content-Type: application/grpc`")
            .into_response();
    }
    if !is_http2(&request) {
        return Problem::http2_only("call it with a gRPC client; a proxy in between must speak HTTP/2")
            .into_response();
    }
    let (mut parts, body) = request.into_parts();
    let ticket = match Ticket::from_request_parts(&mut parts, &state).await {
        Ok(ticket) => ticket,
        Err(problem) => return Status::resource_exhausted(problem.parts().1).into_http(),
    };
    let mut grpc = Grpc::new(Wire).max_decoding_message_size(MAX_BODY_BYTES);
    let call =
        grpc.server_streaming(Subscribe { state, ticket: Some(ticket) }, Request::from_parts(parts, body));
    match timeout(MESSAGE_TIMEOUT, call).await {
        Ok(response) => response.map(Body::new),
        Err(_) => Status::deadline_exceeded("the request's message did not arrive").into_http(),
    }
}

/// One call.
struct Subscribe {
    state: ApiState,
    ticket: Option<Ticket>,
}

impl ServerStreamingService<SubscribeRequest> for Subscribe {
    type Response = Bytes;
    type ResponseStream = BoxStream<'static, Result<Bytes, Status>>;
    type Future = Ready<Result<tonic::Response<Self::ResponseStream>, Status>>;

    fn call(&mut self, request: tonic::Request<SubscribeRequest>) -> Self::Future {
        let Some(ticket) = self.ticket.take() else { return ready(Err(Status::internal("called twice"))) };
        // The words of the other forms: one place says what they may be.
        ready(match wishes(&self.state, &query(request.into_inner())) {
            Ok((only, filter)) => {
                let messages = Messages::new(&self.state, only, filter, Format::Protobuf);
                // A token that was revoked is found though no camera has anything to tell.
                let recheck = self.state.sockets.keep_alive.ping_every;
                Ok(tonic::Response::new(stream(messages, ticket, recheck)))
            }
            Err(problem) => Err(status(&problem)),
        })
    }
}

/// A request as the parameters of `/v1/tracks`.
fn query(request: SubscribeRequest) -> Vec<(String, String)> {
    let SubscribeRequest { camera, class, state, min_confidence, rate } = request;
    let state = state.into_iter().map(|number| match TrackState::try_from(number) {
        Ok(TrackState::Tentative) => "tentative".to_owned(),
        Ok(TrackState::Confirmed) => "confirmed".to_owned(),
        Ok(TrackState::Lost) => "lost".to_owned(),
        Ok(TrackState::Unspecified) | Err(_) => number.to_string(),
    });
    let named = |key: &str, value: String| (key.to_owned(), value);
    let mut query: Vec<_> = camera.into_iter().map(|value| named("camera", value)).collect();
    query.extend(class.into_iter().map(|value| named("class", value)));
    query.extend(state.map(|value| named("state", value)));
    query.extend(min_confidence.map(|value| named("min_confidence", value.to_string())));
    query.extend(rate.map(|value| named("rate", value.to_string())));
    query
}

/// The messages, and at the end a status that says why.
fn stream(
    messages: Messages,
    ticket: Ticket,
    recheck: Duration,
) -> BoxStream<'static, Result<Bytes, Status>> {
    // One message at most waits for the connection, so what is sent is new.
    let (sender, receiver) = mpsc::channel(1);
    let feed = tokio::spawn(feed(messages, sender, ticket, recheck));
    let next = async |(mut receiver, feed): (mpsc::Receiver<Bytes>, Option<JoinHandle<Status>>)| {
        if let Some(message) = receiver.recv().await {
            return Some((Ok(message), (receiver, feed)));
        }
        let end = feed?.await.unwrap_or_else(|_| Status::internal("the stream failed"));
        Some((Err(end), (receiver, None)))
    };
    unfold((receiver, Some(feed)), next).boxed()
}

/// Hands messages on until something ends; what did.
async fn feed(
    mut messages: Messages,
    sender: mpsc::Sender<Bytes>,
    mut ticket: Ticket,
    recheck: Duration,
) -> Status {
    let stops = || Status::unavailable("the service stops");
    while ticket.pass.is_valid() {
        // Room first, then the message: it is the newest at the moment when it can go.
        let room = tokio::select! {
            () = ticket.stop.stopped() => return stops(),
            room = timeout(SEND_TIMEOUT, sender.reserve()) => room,
        };
        let room = match room {
            Ok(Ok(room)) => room,
            Ok(Err(_)) => return Status::cancelled("the client went"),
            Err(_) => {
                ticket.give_up();
                return Status::resource_exhausted("too slow: took nothing for ten seconds");
            }
        };
        let told = tokio::select! {
            () = ticket.stop.stopped() => return stops(),
            () = sender.closed() => return Status::cancelled("the client went"),
            told = timeout(recheck, messages.next()) => told,
        };
        match told {
            Ok(Some(Told::Tracks(message) | Told::Gap(message))) => room.send(message),
            Ok(None) if messages.given_up() => return Status::resource_exhausted(GIVEN_UP),
            Ok(None) => return stops(),
            Err(_) => {}
        }
    }
    Status::unauthenticated("the token was revoked")
}

/// Messages on the wire: requests are read by prost, what goes out is encoded already.
struct Wire;

impl Codec for Wire {
    type Encode = Bytes;
    type Decode = SubscribeRequest;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Wire {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, message: Bytes, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put(message);
        Ok(())
    }

    fn buffer_settings(&self) -> BufferSettings {
        BufferSettings::new(BATCH, BATCH)
    }
}

impl Decoder for Wire {
    type Item = SubscribeRequest;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<SubscribeRequest>, Status> {
        let message = SubscribeRequest::decode(buffer);
        message.map(Some).map_err(|error| Status::invalid_argument(format!("no SubscribeRequest: {error}")))
    }
}
