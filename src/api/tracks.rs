//! `/v1/tracks`: the track stream as JSON or protobuf; `/v1/tracks/stream`: as Server-Sent Events.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{Message, Utf8Bytes, close_code};
use axum::extract::{Query, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use tokio::time::timeout;

use super::ApiState;
use super::drip::{self, Parts};
use super::extract::known_camera;
use super::problem::Problem;
use super::socket::{Opening, Outgoing, Ticket};
use crate::publish::{
    Event, Only, Sieve, Sifted, Subscription, TrackFilter, encode_gap_json, encode_gap_protobuf, encode_json,
    encode_protobuf,
};
use crate::types::{ClassId, TrackState};

/// Subprotocol of JSON text messages, which is also what a client gets that names none.
const JSON: &str = "gakp.v1.json";
/// Subprotocol of binary `gakp.v1.TrackMessage`s.
const PROTOBUF: &str = "gakp.v1.protobuf";
/// After so long without an event a comment is sent.
const SILENCE: Duration = Duration::from_secs(10);

pub(super) async fn tracks(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
    opening: Opening,
) -> Result<Response, Problem> {
    let opening = opening.protocols([PROTOBUF, JSON]);
    let (only, filter) = wishes(&state, &query)?;
    let format = match opening.protocol() {
        Some(protocol) if protocol == PROTOBUF => Format::Protobuf,
        _ => Format::Json,
    };
    // Subscribed before the answer goes out: nothing published after the handshake is missed.
    Ok(opening.run(TrackSocket(Messages::new(&state, only, filter, format))))
}

/// `GET /v1/tracks/stream`: Server-Sent Events, `tracks` and `gap`, each with a JSON message.
pub(super) async fn stream(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
    ticket: Ticket,
) -> Result<Response, Problem> {
    let (only, filter) = wishes(&state, &query)?;
    let events = ServerSent(Messages::new(&state, only, filter, Format::Json));
    let headers = [(header::CONTENT_TYPE, "text/event-stream"), (header::CACHE_CONTROL, "no-store")];
    Ok((headers, drip::body(events, ticket)).into_response())
}

/// Which cameras, and what of their reports.
pub(super) fn wishes(state: &ApiState, query: &[(String, String)]) -> Result<(Only, TrackFilter), Problem> {
    let (mut cameras, mut filter) = (BTreeSet::new(), TrackFilter::default());
    for (key, value) in query {
        let wrong = |what: String| Err(Problem::bad_request(format!("{key}={value:?} {what}")));
        match key.as_str() {
            "camera" => {
                cameras.insert(known_camera(state, value)?);
            }
            "class" => match state.hub.classes().iter().position(|class| class == value) {
                Some(class) => {
                    // The manifest bounds the number of classes.
                    filter.classes.insert(ClassId(class as u16));
                }
                None => return wrong(format!("is none of the classes {}", state.hub.classes().join(", "))),
            },
            "state" => match TrackState::ALL.into_iter().find(|state| state.as_str() == value) {
                Some(state) => {
                    filter.states.insert(state);
                }
                None => return wrong("is none of tentative, confirmed, lost".into()),
            },
            "min_confidence" => match value.parse() {
                Ok(least) if (0.0..=1.0).contains(&least) => filter.min_confidence = least,
                _ => return wrong("must be a number from 0 to 1".into()),
            },
            "rate" => match value.parse() {
                Ok(rate) if (0.01..=1000.0).contains(&rate) => filter.rate = Some(rate),
                _ => return wrong("must be reports per second, from 0.01 to 1000".into()),
            },
            _ => {
                return Err(Problem::bad_request(format!(
                    "unknown parameter {key:?}; there are `camera`, `class`, `state`, `min_confidence` and `rate`"
                )));
            }
        }
    }
    Ok((if cameras.is_empty() { Only::All } else { Only::Cameras(cameras) }, filter))
}

#[derive(Clone, Copy)]
pub(super) enum Format {
    Json,
    Protobuf,
}

/// A message to a subscriber.
pub(super) enum Told {
    Tracks(Bytes),
    Gap(Bytes),
}

/// One subscriber's messages, encoded.
pub(super) struct Messages {
    subscription: Subscription,
    sieve: Sieve,
    format: Format,
    classes: Arc<[String]>,
}

impl Messages {
    pub fn new(state: &ApiState, only: Only, filter: TrackFilter, format: Format) -> Self {
        let (subscription, classes) = (state.hub.subscribe(only), state.hub.classes().clone());
        Self { subscription, sieve: Sieve::new(filter), format, classes }
    }

    /// Whether it ended because it missed too much.
    pub fn given_up(&self) -> bool {
        self.subscription.given_up()
    }

    /// Cancel safe: what was taken from the hub is told before anything is awaited again.
    pub async fn next(&mut self) -> Option<Told> {
        loop {
            let report = match self.subscription.next().await? {
                Event::Tracks(report) => report,
                Event::Gap(gap) => {
                    return Some(Told::Gap(match self.format {
                        Format::Json => encode_gap_json(&gap),
                        Format::Protobuf => encode_gap_protobuf(&gap),
                    }));
                }
            };
            let Some(sifted) = self.sieve.sift(report) else { continue };
            return Some(Told::Tracks(match (self.format, sifted) {
                (Format::Json, Sifted::Whole(report)) => report.json(),
                (Format::Json, Sifted::Part(tracks)) => encode_json(&tracks, &self.classes),
                (Format::Protobuf, Sifted::Whole(report)) => report.protobuf(),
                (Format::Protobuf, Sifted::Part(tracks)) => encode_protobuf(&tracks, &self.classes),
            }));
        }
    }
}

/// What one is told that the hub gave up.
pub(super) const GIVEN_UP: &str = "too slow: missed more than can be accounted for";

struct TrackSocket(Messages);

impl Outgoing for TrackSocket {
    async fn next(&mut self) -> Option<Message> {
        let (Told::Tracks(message) | Told::Gap(message)) = self.0.next().await?;
        match self.0.format {
            Format::Json => text(message),
            Format::Protobuf => Some(Message::Binary(message)),
        }
    }

    fn farewell(&self) -> (u16, &'static str) {
        if self.0.given_up() {
            (close_code::POLICY, GIVEN_UP)
        } else {
            (close_code::AWAY, "the service stops")
        }
    }
}

struct ServerSent(Messages);

impl Parts for ServerSent {
    async fn next(&mut self) -> Option<Bytes> {
        let (name, json) = match timeout(SILENCE, self.0.next()).await {
            Ok(Some(Told::Tracks(json))) => ("tracks", json),
            Ok(Some(Told::Gap(json))) => ("gap", json),
            Ok(None) => return None,
            // A comment: proxies close what is silent, and a client that went is found by what it does not take.
            Err(_) => return Some(Bytes::from_static(b":\n\n")),
        };
        // JSON as we write it has no line break.
        Some([format!("event: {name}\ndata: ").as_bytes(), &json, b"\n\n"].concat().into())
    }
}

/// JSON is UTF-8; checking it costs little and shares the bytes.
fn text(json: Bytes) -> Option<Message> {
    Utf8Bytes::try_from(json).ok().map(Message::Text)
}
