//! What handlers take from a request; what is wrong with it is answered with a problem document.

use std::time::Duration;

use axum::body::Bytes;
use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::request::Parts;
use axum::http::{StatusCode, header};
use serde::de::DeserializeOwned;
use tokio::time::timeout;

use super::object::Object;
use super::problem::Problem;
use super::{ApiState, MAX_BODY_BYTES};
use crate::types::CameraId;

/// How long a body may take to arrive.
const BODY_TIMEOUT: Duration = Duration::from_secs(15);

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

/// The body as JSON. Insisting on its media type keeps other sites' forms out: a browser sends
/// `application/json` to another origin only after asking, and we do not allow it.
pub(super) struct JsonBody<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for JsonBody<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, state: &S) -> Result<Self, Problem> {
        let media_type =
            request.headers().get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or("");
        if !media_type.split(';').next().unwrap_or("").trim().eq_ignore_ascii_case("application/json") {
            return Err(Problem::media_type("send the body as `Content-Type: application/json`"));
        }
        let body = timeout(BODY_TIMEOUT, Bytes::from_request(request, state))
            .await
            .map_err(|_| {
                Problem::bad_request(format!("the body did not arrive within {} s", BODY_TIMEOUT.as_secs()))
            })?
            .map_err(|rejection| match rejection.status() {
                StatusCode::PAYLOAD_TOO_LARGE => {
                    Problem::too_large(format!("a body may have at most {MAX_BODY_BYTES} bytes"))
                }
                _ => Problem::bad_request(format!("the body did not arrive: {}", rejection.body_text())),
            })?;
        serde_json::from_slice(&body)
            .map(|Object(value)| Self(value))
            .map_err(|error| Problem::bad_request(format!("the body is not valid: {error}")))
    }
}

/// What was begun is done, also when who asked for it hangs up meanwhile: a handler is dropped then, half-way through
/// what it writes and starts.
///
/// # Errors
/// Its own; or that it panicked.
pub(super) async fn to_its_end<T: Send + 'static, E: Into<Problem> + Send + 'static>(
    work: impl Future<Output = Result<T, E>> + Send + 'static,
) -> Result<T, Problem> {
    let ended = tokio::spawn(work).await;
    ended.map_err(|_| Problem::internal("the change was broken off"))?.map_err(Into::into)
}

/// A name from a path: one that is not even a name has no camera, so it is a 404 as well.
pub(super) fn camera_id(name: &str) -> Result<CameraId, Problem> {
    CameraId::new(name).map_err(|_| Problem::unknown_camera(name))
}

/// A name from a query: of a camera that there is.
pub(super) fn known_camera(state: &ApiState, name: &str) -> Result<CameraId, Problem> {
    let id = CameraId::new(name)?;
    state.cameras.get(&id).map(|_| id).ok_or_else(|| Problem::unknown_camera(name))
}

#[cfg(test)]
mod tests {
    use tokio::sync::oneshot;

    use super::*;

    #[tokio::test]
    async fn what_was_begun_is_done_when_nobody_waits_any_more() {
        let ((go, gone), (done, is_done)) = (oneshot::channel(), oneshot::channel());
        let mut work = Box::pin(to_its_end(async move {
            gone.await.map_err(|_| Problem::internal("never sent"))?;
            done.send("done").map_err(Problem::internal)
        }));
        assert!(futures::poll!(&mut work).is_pending());
        drop(work);
        go.send(()).unwrap();
        assert_eq!(is_done.await, Ok("done"));
        let broken: Result<(), Problem> = to_its_end(async { Err(Problem::bad_request("its own")) }).await;
        assert!(format!("{broken:?}").contains("its own"), "{broken:?}");
    }
}
