//! Errors as RFC 9457 problem documents.

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::{CameraError, EditError};
use crate::notify::WebhookError;
use crate::types::CameraIdError;

/// An error as the client sees it: `application/problem+json` with `type`, `title`, `status`, `detail`.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Problem {
    /// Names the kind of problem; explained in docs/api.md under its last part.
    #[serde(rename = "type")]
    kind: String,
    title: &'static str,
    #[serde(serialize_with = "write_status")]
    status: StatusCode,
    detail: String,
}

fn write_status<S: serde::Serializer>(status: &StatusCode, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u16(status.as_u16())
}

impl Problem {
    fn new(status: StatusCode, name: &str, title: &'static str, detail: impl Into<String>) -> Self {
        Self { kind: format!("urn:gakp:problem:{name}"), title, status, detail: detail.into() }
    }

    pub fn bad_request(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad-request", "The request is not valid", detail)
    }

    pub fn not_found(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not-found", "Not found", detail)
    }

    pub fn unknown_camera(name: &str) -> Self {
        Self::new(
            StatusCode::NOT_FOUND,
            "unknown-camera",
            "No such camera",
            format!("there is no camera {name:?}; GET /v1/cameras lists them"),
        )
    }

    pub fn unknown_rule(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, "unknown-rule", "No such line, zone or mask", detail)
    }

    pub fn method_not_allowed(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::METHOD_NOT_ALLOWED, "method-not-allowed", "Method not allowed", detail)
    }

    pub fn media_type(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "media-type", "Unsupported media type", detail)
    }

    pub fn too_large(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::PAYLOAD_TOO_LARGE, "too-large", "The body is too large", detail)
    }

    pub fn upgrade_required(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::UPGRADE_REQUIRED, "websocket-only", "This path speaks WebSocket", detail)
    }

    pub fn http2_only(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::UPGRADE_REQUIRED, "http2-only", "This path speaks gRPC over HTTP/2", detail)
    }

    pub fn unauthenticated(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::UNAUTHORIZED, "unauthenticated", "A token is needed", detail)
    }

    pub fn forbidden(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::FORBIDDEN, "forbidden", "Not allowed", detail)
    }

    pub fn forbidden_origin(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::FORBIDDEN, "forbidden-origin", "Origin not allowed", detail)
    }

    pub fn unavailable(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "unavailable", "Not available now", detail)
    }

    pub fn no_history() -> Self {
        let why = "no history is kept: `[history] database` of the configuration is \"none\"";
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "no-history", "No history is kept", why)
    }

    pub fn internal(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", "The service failed", detail)
    }
}

impl Problem {
    /// The status, and the words.
    pub fn parts(&self) -> (StatusCode, &str) {
        (self.status, &self.detail)
    }

    /// Whether it is that there is no such camera.
    pub fn is_unknown_camera(&self) -> bool {
        self.kind.ends_with(":unknown-camera")
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut response = (self.status, Json(&self)).into_response();
        response
            .headers_mut()
            .insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if self.status == StatusCode::UNAUTHORIZED {
            let scheme = HeaderValue::from_static("Bearer realm=\"gakp\"");
            response.headers_mut().insert(header::WWW_AUTHENTICATE, scheme);
        }
        if self.kind.ends_with(":http2-only") {
            // RFC 9110, section 15.5.22.
            response.headers_mut().insert(header::UPGRADE, HeaderValue::from_static("HTTP/2.0"));
        }
        // gRPC tells it in another way.
        response.extensions_mut().insert(self);
        response
    }
}

impl From<CameraIdError> for Problem {
    fn from(error: CameraIdError) -> Self {
        Self::bad_request(error.to_string())
    }
}

impl From<EditError> for Problem {
    fn from(error: EditError) -> Self {
        let detail = error.to_string();
        match error {
            EditError::Rule(_) => Self::bad_request(detail),
            EditError::Exists(_) => {
                Self::new(StatusCode::CONFLICT, "rule-exists", "The name is taken", detail)
            }
            EditError::Unknown { .. } => Self::unknown_rule(detail),
        }
    }
}

impl From<WebhookError> for Problem {
    fn from(error: WebhookError) -> Self {
        let detail = error.to_string();
        match error {
            WebhookError::Exists(_) => {
                Self::new(StatusCode::CONFLICT, "webhook-exists", "The name is taken", detail)
            }
            WebhookError::Unknown(_) => {
                Self::new(StatusCode::NOT_FOUND, "unknown-webhook", "No such webhook", detail)
            }
            WebhookError::Configured(_) => {
                Self::new(StatusCode::CONFLICT, "configured-webhook", "The configuration has it", detail)
            }
            WebhookError::LimitReached(_) => {
                Self::new(StatusCode::CONFLICT, "webhook-limit", "Too many webhooks", detail)
            }
            WebhookError::Invalid { .. } => Self::bad_request(detail),
            WebhookError::Io(_) => Self::internal(detail),
        }
    }
}

impl From<CameraError> for Problem {
    fn from(error: CameraError) -> Self {
        let detail = error.to_string();
        match error {
            CameraError::Exists => Self::new(StatusCode::CONFLICT, "camera-exists", "Camera exists", detail),
            CameraError::NotFound => {
                Self::new(StatusCode::NOT_FOUND, "unknown-camera", "No such camera", detail)
            }
            CameraError::Invalid(_) => Self::bad_request(detail),
            CameraError::LimitReached(_) => {
                Self::new(StatusCode::CONFLICT, "camera-limit", "Too many cameras", detail)
            }
            CameraError::Rules(error) => error.into(),
            CameraError::Io(_) => Self::internal(detail),
        }
    }
}
