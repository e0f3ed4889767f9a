//! The HTTP, WebSocket and gRPC edge: cameras over REST, live tracks, live video, health, metrics, the page.
//!
//! ```text
//! /                                the web page
//! /v1/cameras                      GET list, POST add
//! /v1/cameras/{id}                 GET status, PATCH, DELETE
//! /v1/cameras/{id}/snapshot.jpg    newest picture, boxes drawn in
//! /v1/cameras/{id}/stream.mjpeg    live pictures, boxes drawn in
//! /v1/cameras/{id}/live            WebSocket: pictures as they are, each with its tracks
//! /v1/cameras/{id}/lines[/{line}]  GET, POST, PUT, DELETE; zones and masks likewise
//! /v1/cameras/{id}/counts          crossings, occupancies
//! /v1/cameras/{id}/heatmap         where people were
//! /v1/session                      who asks; signing in and out
//! /v1/tracks                       WebSocket: tracks as JSON or protobuf
//! /v1/tracks/stream                the same as Server-Sent Events
//! /gakp.v1.Tracks/Subscribe        the same over gRPC
//! /v1/events[/live]                what happened at lines and in zones; a WebSocket of it
//! /v1/history[/...]                tracks and events that were; counts over time; CSV, MOTChallenge
//! /v1/webhooks                     where events are posted, and how that fares
//! /v1/webhooks/{name}/test         one post now
//! /v1/openapi.json                all of this for programs
//! /v1/log /v1/reload               what is logged; reading the configuration again
//! /metrics /healthz /readyz
//! ```
//!
//! It reads what the pipeline publishes through [`Cameras`] and [`Hub`] and never reaches into it.
//! docs/api.md is the reference for users.

mod analytics;
mod auth;
mod cameras;
mod drip;
mod etag;
mod events;
mod extract;
mod grpc;
mod history;
mod http2;
mod live;
mod object;
mod openapi;
mod operations;
mod page;
mod problem;
mod rest;
mod rules;
mod server;
mod socket;
mod ssrf;
mod table;
mod trace;
mod tracks;
mod video;
mod webhooks;

use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::middleware::{from_fn, from_fn_with_state};
use axum::routing::{get, post};
use prometheus::Registry;
use tokio_rustls::rustls::ServerConfig;

pub use auth::RIGHTS;
pub use cameras::{
    CameraError, CameraPatch, CameraState, CameraStatus, Cameras, NewCamera, TrackCounts, Transport,
};
pub use operations::{Operations, Reloaded};
pub use rules::{
    AnchorSpec, EditError, Findings, LineSpec, MaskSpec, Rule, RuleEdit, RulesSpec, StyleSpec, ZoneSpec,
};
pub use server::{serve, serve_with};
pub use socket::KeepAlive;

use crate::auth::Gate;
use crate::history::Database;
use crate::notify::Webhooks;
use crate::publish::{EventHub, Hub};
use crate::traces::Traces;
use socket::{Seats, Sockets};
use video::Studio;

/// Longest body of a request.
const MAX_BODY_BYTES: usize = 64 * 1024;

/// Why the service is not ready; empty when it is.
pub type Readiness = Arc<dyn Fn() -> Vec<String> + Send + Sync>;

/// What the API serves.
#[derive(Clone)]
pub struct ApiConfig {
    /// The cameras.
    pub cameras: Arc<dyn Cameras>,
    /// The tracks.
    pub hub: Hub,
    /// What happens at lines and in zones.
    pub events: EventHub,
    /// What was; without it no history is kept.
    pub history: Option<Database>,
    /// Where events are posted.
    pub webhooks: Webhooks,
    /// What `/metrics` shows.
    pub registry: Registry,
    /// What `/readyz` asks.
    pub readiness: Readiness,
    /// Who may come in.
    pub gate: Arc<Gate>,
    /// What an admin may change while it runs.
    pub operations: Option<Arc<dyn Operations>>,
    /// Where traces of requests go.
    pub traces: Option<Traces>,
    /// Certificate and key; without them it is plain HTTP.
    pub tls: Option<Arc<ServerConfig>>,
}

/// What every handler can reach.
#[derive(Clone)]
struct ApiState {
    cameras: Arc<dyn Cameras>,
    hub: Hub,
    events: EventHub,
    history: Option<Database>,
    webhooks: Webhooks,
    registry: Registry,
    readiness: Readiness,
    gate: Arc<Gate>,
    operations: Option<Arc<dyn Operations>>,
    /// Whether connections are encrypted.
    secure: bool,
    studio: Arc<Studio>,
    seats: Seats,
    sockets: Sockets,
}

fn router(config: ApiConfig, sockets: Sockets) -> Router {
    let ApiConfig {
        cameras,
        hub,
        events,
        history,
        webhooks,
        registry,
        readiness,
        gate,
        operations,
        traces,
        tls,
    } = config;
    let studio = Arc::new(Studio::default());
    let (seats, secure) = (Seats::default(), tls.is_some());
    let state = ApiState {
        cameras,
        hub,
        events,
        history,
        webhooks,
        registry,
        readiness,
        gate,
        operations,
        secure,
        studio,
        seats,
        sockets,
    };
    let routes = Router::new()
        .route("/v1/cameras", get(rest::list).post(rest::add))
        .route("/v1/cameras/{id}", get(rest::get).patch(rest::patch).delete(rest::remove))
        .route("/v1/cameras/{id}/snapshot.jpg", get(live::snapshot))
        .route("/v1/cameras/{id}/stream.mjpeg", get(live::mjpeg))
        .route("/v1/cameras/{id}/live", get(live::live))
        .route("/v1/cameras/{id}/lines", analytics::all_of::<LineSpec>())
        .route("/v1/cameras/{id}/lines/{line}", analytics::one_of::<LineSpec>())
        .route("/v1/cameras/{id}/zones", analytics::all_of::<ZoneSpec>())
        .route("/v1/cameras/{id}/zones/{zone}", analytics::one_of::<ZoneSpec>())
        .route("/v1/cameras/{id}/masks", analytics::all_of::<MaskSpec>())
        .route("/v1/cameras/{id}/masks/{mask}", analytics::one_of::<MaskSpec>())
        .route("/v1/cameras/{id}/counts", get(analytics::counts))
        .route("/v1/cameras/{id}/heatmap", get(analytics::heat_map))
        .route("/v1/tracks", get(tracks::tracks))
        .route("/v1/tracks/stream", get(tracks::stream))
        .route("/gakp.v1.Tracks/Subscribe", post(grpc::subscribe))
        .route("/v1/events", get(events::recent))
        .route("/v1/events/live", get(events::live))
        .route("/v1/history", get(history::summary))
        .route("/v1/history/tracks", get(history::tracks))
        .route("/v1/history/tracks/{camera}/{epoch}/{track}", get(history::track))
        .route("/v1/history/tracks/{camera}/{epoch}/{track}/snapshot.jpg", get(history::snapshot))
        .route("/v1/history/tracks.csv", get(history::tracks_csv))
        .route("/v1/history/tracks.txt", get(history::tracks_mot))
        .route("/v1/history/events", get(history::events))
        .route("/v1/history/events.csv", get(history::events_csv))
        .route("/v1/history/counts", get(history::counts))
        .route("/v1/webhooks", get(webhooks::list).post(webhooks::add))
        .route("/v1/webhooks/{name}", get(webhooks::get).patch(webhooks::patch).delete(webhooks::remove))
        .route("/v1/webhooks/{name}/test", post(webhooks::test))
        .route("/v1/openapi.json", get(openapi::document))
        .route("/v1/log", get(operations::log).put(operations::set_log))
        .route("/v1/reload", post(operations::reload))
        .route("/metrics", get(rest::metrics))
        .route("/healthz", get(rest::healthz))
        .route("/readyz", get(rest::readyz))
        .route("/v1/session", get(auth::session).post(auth::sign_in).delete(auth::sign_out))
        .merge(page::routes())
        .route_layer(from_fn(etag::tag))
        .route_layer(from_fn_with_state(state.clone(), auth::guard));
    let routes = match traces {
        // Around all the rest: who is refused is traced, too.
        Some(traces) => routes.route_layer(from_fn_with_state(traces, trace::request)),
        None => routes,
    };
    routes
        .fallback(rest::no_such_path)
        .method_not_allowed_fallback(rest::no_such_method)
        .layer(DefaultBodyLimit::max(MAX_BODY_BYTES))
        .layer(from_fn(grpc::translate))
        .with_state(state)
}
