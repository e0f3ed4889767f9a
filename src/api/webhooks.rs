//! `/v1/webhooks`: where events are posted.

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::Response;
use axum::{Extension, Json};
use serde::Serialize;

use super::extract::{JsonBody, Path, to_its_end};
use super::problem::Problem;
use super::rest::created;
use super::{ApiState, ssrf};
use crate::auth::Identity;
use crate::notify::{WebhookPatch, WebhookSpec, WebhookStatus, WebhookTrial};
use crate::outgoing::{Address, HTTP, Secret};

#[derive(Serialize)]
pub(super) struct WebhookList {
    webhooks: Vec<WebhookStatus>,
}

pub(super) async fn list(State(state): State<ApiState>) -> Json<WebhookList> {
    Json(WebhookList { webhooks: state.webhooks.list() })
}

pub(super) async fn get(
    State(state): State<ApiState>,
    Path(name): Path<String>,
) -> Result<Json<WebhookStatus>, Problem> {
    Ok(Json(state.webhooks.get(&name)?))
}

pub(super) async fn add(
    State(state): State<ApiState>,
    Extension(identity): Extension<Option<Identity>>,
    JsonBody(spec): JsonBody<WebhookSpec>,
) -> Result<Response, Problem> {
    check(identity.as_ref(), &spec.url).await?;
    let location = format!("/v1/webhooks/{}", spec.name);
    let reach = ssrf::reach(identity.as_ref());
    let status = to_its_end(async move { state.webhooks.add(spec, reach).await }).await?;
    Ok(created(location, status))
}

pub(super) async fn patch(
    State(state): State<ApiState>,
    Path(name): Path<String>,
    Extension(identity): Extension<Option<Identity>>,
    JsonBody(patch): JsonBody<WebhookPatch>,
) -> Result<Json<WebhookStatus>, Problem> {
    if let Some(url) = &patch.url {
        check(identity.as_ref(), url).await?;
    }
    let reach = ssrf::reach(identity.as_ref());
    Ok(Json(to_its_end(async move { state.webhooks.change(&name, patch, reach).await }).await?))
}

pub(super) async fn remove(
    State(state): State<ApiState>,
    Path(name): Path<String>,
) -> Result<StatusCode, Problem> {
    to_its_end(async move { state.webhooks.remove(&name).await }).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// `POST /v1/webhooks/{name}/test`: one post now.
pub(super) async fn test(
    State(state): State<ApiState>,
    Path(name): Path<String>,
) -> Result<Json<WebhookTrial>, Problem> {
    Ok(Json(state.webhooks.try_once(&name).await?))
}

/// Refuses anybody but an admin a receiver in this machine.
async fn check(identity: Option<&Identity>, url: &Secret) -> Result<(), Problem> {
    // Whatever is wrong with it is told by whoever takes it.
    let Ok(address) = Address::parse(url.text(), &HTTP) else { return Ok(()) };
    ssrf::check_host(identity, "webhook", &address.host, address.port).await
}
