//! A span for each request that is traced.

use axum::extract::{MatchedPath, Request, State};
use axum::middleware::Next;
use axum::response::Response;

use crate::traces::Traces;

/// Times the request up to the head of its answer.
pub(super) async fn request(
    State(traces): State<Traces>,
    path: MatchedPath,
    request: Request,
    next: Next,
) -> Response {
    let trace = traces.request(request.method(), path.as_str(), request.headers());
    let response = next.run(request).await;
    if let Some(trace) = trace {
        trace.finish(response.status());
    }
    response
}
