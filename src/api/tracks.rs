//! `/v1/tracks`: the track stream as JSON or protobuf.

use std::collections::BTreeSet;

use axum::Extension;
use axum::body::Bytes;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{Message, Utf8Bytes, WebSocketUpgrade, close_code};
use axum::extract::{Query, State};
use axum::http::HeaderMap;
use axum::response::Response;

use super::ApiState;
use super::problem::Problem;
use super::socket::{self, Outgoing, Pass};
use crate::auth::Identity;
use crate::publish::{Event, Only, Subscription, encode_gap_json, encode_gap_protobuf};
use crate::types::CameraId;

/// Subprotocol of JSON text messages, which is also what a client gets that names none.
const JSON: &str = "gakp.v1.json";
/// Subprotocol of binary `gakp.v1.TrackMessage`s.
const PROTOBUF: &str = "gakp.v1.protobuf";

pub(super) async fn tracks(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
    Extension(identity): Extension<Option<Identity>>,
    headers: HeaderMap,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let upgrade = socket::upgrade(&headers, upgrade)?.protocols([PROTOBUF, JSON]);
    let only = only(&state, &query)?;
    let seat = state.seats.take()?;
    let format = match upgrade.selected_protocol() {
        Some(protocol) if protocol == PROTOBUF => Format::Protobuf,
        _ => Format::Json,
    };
    let (sockets, pass) = (state.sockets.clone(), Pass::new(&state.gate, identity));
    // Subscribed before the answer goes out: nothing published after the handshake is missed.
    let stream = TrackStream { subscription: state.hub.subscribe(only), format };
    Ok(upgrade.on_upgrade(|socket| async move {
        let _seat = seat;
        socket::run(socket, sockets, pass, stream).await;
    }))
}

/// The cameras named by `?camera=`, which may repeat; all when there is none.
fn only(state: &ApiState, query: &[(String, String)]) -> Result<Only, Problem> {
    let mut cameras = BTreeSet::new();
    for (key, value) in query {
        if key != "camera" {
            return Err(Problem::bad_request(format!("unknown parameter {key:?}; there is `camera`")));
        }
        let id = CameraId::new(value)?;
        if state.cameras.get(&id).is_none() {
            return Err(Problem::unknown_camera(value));
        }
        cameras.insert(id);
    }
    Ok(if cameras.is_empty() { Only::All } else { Only::Cameras(cameras) })
}

#[derive(Clone, Copy)]
enum Format {
    Json,
    Protobuf,
}

struct TrackStream {
    subscription: Subscription,
    format: Format,
}

impl Outgoing for TrackStream {
    async fn next(&mut self) -> Option<Message> {
        let event = self.subscription.next().await?;
        match (self.format, event) {
            (Format::Json, Event::Tracks(report)) => text(report.json()),
            (Format::Json, Event::Gap(gap)) => text(encode_gap_json(&gap)),
            (Format::Protobuf, Event::Tracks(report)) => Some(Message::Binary(report.protobuf())),
            (Format::Protobuf, Event::Gap(gap)) => Some(Message::Binary(encode_gap_protobuf(&gap))),
        }
    }

    fn farewell(&self) -> (u16, &'static str) {
        if self.subscription.given_up() {
            (close_code::POLICY, "too slow: missed more than can be accounted for")
        } else {
            (close_code::AWAY, "the service stops")
        }
    }
}

/// JSON is UTF-8; checking it costs little and shares the bytes.
fn text(json: Bytes) -> Option<Message> {
    Utf8Bytes::try_from(json).ok().map(Message::Text)
}
