//! Entity tags: who has an answer already is told so instead of being sent it again (RFC 9110, section 13.1.2).

use axum::body::{Body, HttpBody, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use sha2::{Digest, Sha256};

use super::problem::Problem;

/// Tags JSON answers to `GET`; answers 304 without a body where the client has named the tag in `If-None-Match`.
pub(super) async fn tag(request: Request, next: Next) -> Response {
    let is_get = request.method() == Method::GET;
    let known = request.headers().get(header::IF_NONE_MATCH).cloned();
    let response = next.run(request).await;
    let is_json =
        response.headers().get(header::CONTENT_TYPE).is_some_and(|value| value == "application/json");
    // What is streamed has no size, and no end perhaps.
    let size = response.body().size_hint().exact().and_then(|size| usize::try_from(size).ok());
    match size {
        Some(size) if is_get && is_json && response.status() == StatusCode::OK => {
            tagged(response, size, known.as_ref()).await
        }
        _ => response,
    }
}

async fn tagged(response: Response, size: usize, known: Option<&HeaderValue>) -> Response {
    let (mut head, body) = response.into_parts();
    let Ok(body) = to_bytes(body, size).await else {
        return Problem::internal("the answer could not be made").into_response();
    };
    let sum = Sha256::digest(&body);
    let tag: String = sum[..12].iter().map(|byte| format!("{byte:02x}")).collect();
    let tag = format!("\"{tag}\"");
    let matches = known.and_then(|value| value.to_str().ok()).is_some_and(|known| names(known, &tag));
    if let Ok(tag) = tag.parse() {
        head.headers.insert(header::ETAG, tag);
    }
    // What a browser keeps it asks for again, and only for whom it was.
    head.headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("private, no-cache"));
    if matches {
        head.status = StatusCode::NOT_MODIFIED;
        head.headers.remove(header::CONTENT_TYPE);
        head.headers.remove(header::CONTENT_LENGTH);
        return Response::from_parts(head, Body::empty());
    }
    Response::from_parts(head, body.into())
}

/// Whether `If-None-Match` names a tag. Weak ones count: what is compared is what was sent.
fn names(known: &str, tag: &str) -> bool {
    known.split(',').map(str::trim).any(|one| one == "*" || one.strip_prefix("W/").unwrap_or(one) == tag)
}

#[cfg(test)]
mod tests {
    use super::names;

    #[test]
    fn a_tag_is_found_among_others() {
        for known in ["\"ab\"", "W/\"ab\"", "\"x\", W/\"ab\"", "*", " \"x\" ,\"ab\""] {
            assert!(names(known, "\"ab\""), "{known}");
        }
        for other in ["", "ab", "\"abc\"", "W/ab", "w/\"ab\""] {
            assert!(!names(other, "\"ab\""), "{other}");
        }
    }
}
