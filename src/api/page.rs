//! The web page at `/`, embedded: what npm has built of `web/`, nothing from elsewhere. A binary that was compiled without
//! it shows how to build it.

use axum::Router;
use axum::http::header;
use axum::response::IntoResponse;
use axum::routing::get;

/// Only what comes from this service runs or loads, and nobody frames it.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Path, media type, content: written by build.rs.
const FILES: &[(&str, &str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/page.rs"));

pub(super) fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    FILES.iter().fold(Router::new(), |router, &(path, media_type, bytes)| {
        router.route(path, get(move || async move { file(path, media_type, bytes) }))
    })
}

fn file(path: &str, media_type: &'static str, bytes: &'static [u8]) -> impl IntoResponse {
    // The names of what the page loads change with its content; a newer binary brings a newer page.
    let cache = if path == "/" { "no-cache" } else { "public, max-age=31536000, immutable" };
    let headers = [
        (header::CONTENT_TYPE, media_type),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, cache),
    ];
    (headers, bytes)
}
