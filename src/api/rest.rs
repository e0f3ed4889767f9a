//! `/v1/cameras`, health, metrics.

use axum::extract::{Query, State};
use axum::http::{Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use prometheus::{Encoder, TextEncoder};
use serde::Serialize;

use super::extract::{JsonBody, Path, camera_id};
use super::problem::Problem;
use super::{ApiState, CameraPatch, CameraStatus, NewCamera, ssrf};
use crate::auth::Identity;
use crate::types::CameraId;

/// Cameras in an answer at most: more than a service takes.
const MAX_LIMIT: usize = 1024;

#[derive(Serialize)]
pub(super) struct CameraList {
    cameras: Vec<CameraStatus>,
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<String>,
}

/// `GET /v1/cameras?limit=&cursor=`: in the order of their names; without a limit all of them.
pub(super) async fn list(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Json<CameraList>, Problem> {
    let (mut limit, mut after) = (usize::MAX, None);
    for (key, value) in query {
        let wrong = |what: &str| Problem::bad_request(format!("{key}={value:?} {what}"));
        match key.as_str() {
            "limit" => {
                let given = value.parse().ok().filter(|n| (1..=MAX_LIMIT).contains(n));
                limit = given.ok_or_else(|| wrong(&format!("must be a number from 1 to {MAX_LIMIT}")))?;
            }
            "cursor" => {
                let id = CameraId::new(&value);
                after = Some(id.map_err(|_| wrong("is no cursor: take `next` of the page before"))?);
            }
            _ => {
                let there_are = "there are `limit` and `cursor`";
                return Err(Problem::bad_request(format!("unknown parameter {key:?}; {there_are}")));
            }
        }
    }
    let mut cameras = state.cameras.list();
    cameras.retain(|camera| after.as_ref().is_none_or(|after| camera.id > *after));
    let more = cameras.len() > limit;
    cameras.truncate(limit);
    let next = cameras.last().filter(|_| more).map(|camera| camera.id.to_string());
    Ok(Json(CameraList { cameras, next }))
}

pub(super) async fn get(
    State(state): State<ApiState>,
    Path(name): Path<String>,
) -> Result<Json<CameraStatus>, Problem> {
    let id = camera_id(&name)?;
    state.cameras.get(&id).map(Json).ok_or_else(|| Problem::unknown_camera(&name))
}

pub(super) async fn add(
    State(state): State<ApiState>,
    Extension(identity): Extension<Option<Identity>>,
    JsonBody(request): JsonBody<NewCamera>,
) -> Result<Response, Problem> {
    ssrf::check_camera(identity.as_ref(), &request.url).await?;
    let location = format!("/v1/cameras/{}", request.id);
    Ok(created(location, state.cameras.add(request).await?))
}

/// The answer to what made something.
pub(super) fn created(location: String, body: impl Serialize) -> Response {
    (StatusCode::CREATED, [(header::LOCATION, location)], Json(body)).into_response()
}

pub(super) async fn patch(
    State(state): State<ApiState>,
    Path(name): Path<String>,
    Extension(identity): Extension<Option<Identity>>,
    JsonBody(patch): JsonBody<CameraPatch>,
) -> Result<Json<CameraStatus>, Problem> {
    let id = camera_id(&name)?;
    if let Some(url) = &patch.url {
        ssrf::check_camera(identity.as_ref(), url).await?;
    }
    match state.cameras.patch(&id, patch).await {
        Ok(status) => Ok(Json(status)),
        Err(super::CameraError::NotFound) => Err(Problem::unknown_camera(&name)),
        Err(other) => Err(other.into()),
    }
}

pub(super) async fn remove(
    State(state): State<ApiState>,
    Path(name): Path<String>,
) -> Result<StatusCode, Problem> {
    let id = camera_id(&name)?;
    match state.cameras.remove(&id).await {
        Ok(()) => Ok(StatusCode::NO_CONTENT),
        Err(super::CameraError::NotFound) => Err(Problem::unknown_camera(&name)),
        Err(other) => Err(other.into()),
    }
}

pub(super) async fn metrics(State(state): State<ApiState>) -> Result<Response, Problem> {
    let encoder = TextEncoder::new();
    let mut text = Vec::new();
    encoder
        .encode(&state.registry.gather(), &mut text)
        .map_err(|error| Problem::internal(format!("the metrics could not be written: {error}")))?;
    Ok(([(header::CONTENT_TYPE, encoder.format_type().to_owned())], text).into_response())
}

#[derive(Serialize)]
struct Health {
    status: &'static str,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    reasons: Vec<String>,
}

/// The process answers: that is all.
pub(super) async fn healthz() -> Response {
    Json(Health { status: "ok", reasons: Vec::new() }).into_response()
}

/// Whether the service does its job now, and if not, why.
pub(super) async fn readyz(State(state): State<ApiState>) -> Response {
    let mut reasons = (state.readiness)();
    if state.sockets.stop.is_stopping() {
        reasons.push("the service is shutting down".to_owned());
    }
    if reasons.is_empty() {
        Json(Health { status: "ready", reasons }).into_response()
    } else {
        (StatusCode::SERVICE_UNAVAILABLE, Json(Health { status: "not ready", reasons })).into_response()
    }
}

pub(super) async fn no_such_path(uri: Uri) -> Problem {
    Problem::not_found(format!("nothing is at {}; docs/api.md lists the paths", uri.path()))
}

pub(super) async fn no_such_method(method: Method, uri: Uri) -> Problem {
    Problem::method_not_allowed(format!("{method} is not possible at {}", uri.path()))
}
