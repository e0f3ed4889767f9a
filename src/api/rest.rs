//! `/v1/cameras`, health, metrics.

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{FromRequestParts, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use prometheus::{Encoder, TextEncoder};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::object::Object;
use super::problem::Problem;
use super::{ApiState, CameraPatch, CameraStatus, MAX_BODY_BYTES, NewCamera, ssrf};
use crate::auth::{Identity, Role};
use crate::types::CameraId;

/// What the path names. Unlike axum's own it answers a path that is no UTF-8 with a problem document.
pub(super) struct Path<T>(pub T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for Path<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        match axum::extract::Path::from_request_parts(parts, state).await {
            Ok(axum::extract::Path(names)) => Ok(Self(names)),
            Err(rejection) => Err(Problem::bad_request(rejection.body_text())),
        }
    }
}

#[derive(Serialize)]
pub(super) struct CameraList {
    cameras: Vec<CameraStatus>,
}

pub(super) async fn list(State(state): State<ApiState>) -> Json<CameraList> {
    Json(CameraList { cameras: state.cameras.list() })
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
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let request: NewCamera = json_body(&headers, body)?;
    if identity.is_none_or(|identity| identity.role < Role::Admin) {
        ssrf::check(&request.url).await?;
    }
    let location = format!("/v1/cameras/{}", request.id);
    let status = state.cameras.add(request).await?;
    let mut response = (StatusCode::CREATED, Json(status)).into_response();
    if let Ok(location) = HeaderValue::from_str(&location) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    Ok(response)
}

pub(super) async fn patch(
    State(state): State<ApiState>,
    Path(name): Path<String>,
    Extension(identity): Extension<Option<Identity>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<CameraStatus>, Problem> {
    let id = camera_id(&name)?;
    let patch: CameraPatch = json_body(&headers, body)?;
    if let Some(url) = &patch.url
        && identity.is_none_or(|identity| identity.role < Role::Admin)
    {
        ssrf::check(url).await?;
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

/// A name from a path: one that is not even a name has no camera, so it is a 404 as well.
pub(super) fn camera_id(name: &str) -> Result<CameraId, Problem> {
    CameraId::new(name).map_err(|_| Problem::unknown_camera(name))
}

/// The body as JSON. Insisting on its media type keeps other sites' forms out: a browser sends
/// `application/json` to another origin only after asking, and we do not allow it.
pub(super) fn json_body<T: DeserializeOwned>(
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<T, Problem> {
    let media_type = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or("");
    if !media_type.split(';').next().unwrap_or("").trim().eq_ignore_ascii_case("application/json") {
        return Err(Problem::media_type("send the body as `Content-Type: application/json`"));
    }
    let body = body.map_err(|rejection| match rejection.status() {
        StatusCode::PAYLOAD_TOO_LARGE => {
            Problem::too_large(format!("a body may have at most {MAX_BODY_BYTES} bytes"))
        }
        _ => Problem::bad_request(format!("the body did not arrive: {}", rejection.body_text())),
    })?;
    serde_json::from_slice(&body)
        .map(|Object(value)| value)
        .map_err(|error| Problem::bad_request(format!("the body is not valid: {error}")))
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
