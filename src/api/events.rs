//! `/v1/events`: what happened lately; `/v1/events/live`: a WebSocket of what happens.

use axum::body::Bytes;
use axum::extract::ws::{Message, Utf8Bytes, close_code};
use axum::extract::{Query, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};

use super::ApiState;
use super::extract::known_camera;
use super::problem::Problem;
use super::socket::{Opening, Outgoing};
use crate::publish::{EVENT_KINDS, EventFilter, EventListener, Heard};

/// Events in an answer if the client does not say.
const DEFAULT_LIMIT: usize = 100;
/// Events in an answer at most: as many as are kept.
const MAX_LIMIT: usize = 1000;

/// `GET /v1/events?camera=&type=&limit=`: the newest first.
pub(super) async fn recent(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Response, Problem> {
    let mut limit = DEFAULT_LIMIT;
    let mut rest = vec![];
    for (key, value) in query {
        if key == "limit" {
            limit = value.parse().ok().filter(|n| (1..=MAX_LIMIT).contains(n)).ok_or_else(|| {
                Problem::bad_request(format!("limit={value:?} must be a number from 1 to {MAX_LIMIT}"))
            })?;
        } else {
            rest.push((key, value));
        }
    }
    let filter = filter(&state, &rest, "`camera`, `type` and `limit`")?;
    let events = state.events.recent(&filter, limit);
    let mut body = b"{\"events\":[".to_vec();
    for (index, event) in events.iter().enumerate() {
        if index > 0 {
            body.push(b',');
        }
        body.extend_from_slice(&event.json);
    }
    body.extend_from_slice(b"]}");
    Ok(([(header::CONTENT_TYPE, "application/json")], body).into_response())
}

/// `GET /v1/events/live?camera=&type=`: a WebSocket.
pub(super) async fn live(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
    opening: Opening,
) -> Result<Response, Problem> {
    let filter = filter(&state, &query, "`camera` and `type`")?;
    Ok(opening.run(EventStream(state.events.listen(filter))))
}

fn filter(state: &ApiState, query: &[(String, String)], known: &str) -> Result<EventFilter, Problem> {
    let mut filter = EventFilter::default();
    for (key, value) in query {
        match key.as_str() {
            "camera" => {
                filter.cameras.insert(known_camera(state, value)?);
            }
            "type" => {
                let kind = EVENT_KINDS.into_iter().find(|kind| kind == value).ok_or_else(|| {
                    Problem::bad_request(format!("type={value:?} is none of {}", EVENT_KINDS.join(", ")))
                })?;
                filter.kinds.insert(kind);
            }
            _ => return Err(Problem::bad_request(format!("unknown parameter {key:?}; there are {known}"))),
        }
    }
    Ok(filter)
}

struct EventStream(EventListener);

impl Outgoing for EventStream {
    async fn next(&mut self) -> Option<Message> {
        let json = match self.0.next().await? {
            Heard::Event(event) => event.json.clone(),
            Heard::Missed(missed) => Bytes::from(format!("{{\"gap\":{{\"missed\":{missed}}}}}")),
        };
        Utf8Bytes::try_from(json).ok().map(Message::Text)
    }

    fn farewell(&self) -> (u16, &'static str) {
        (close_code::AWAY, "the service stops")
    }
}
