//! `/v1/openapi.json`: this API as an OpenAPI 3.1 document. tests/api_schema.rs holds it to the routes and to what
//! the service answers.

use axum::http::header;
use axum::response::IntoResponse;

const DOCUMENT: &str = include_str!("openapi.json");

pub(super) async fn document() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], DOCUMENT)
}
