//! `/v1/log` and `/v1/reload`: what an admin changes of a service that runs.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use futures::future::BoxFuture;
use serde::{Deserialize, Serialize};

use super::ApiState;
use super::extract::{JsonBody, to_its_end};
use super::problem::Problem;

/// What can be changed while it runs, besides cameras.
pub trait Operations: Send + Sync {
    /// What is logged, as `--log` says it.
    fn log_level(&self) -> String;

    /// Logs otherwise from now on.
    ///
    /// # Errors
    /// The text is no level; nothing changed.
    fn set_log_level(&self, level: &str) -> Result<(), String>;

    /// Reads the configuration and the certificate again.
    ///
    /// # Errors
    /// Something is wrong in them; nothing changed.
    fn reload(&self) -> BoxFuture<'_, Result<Reloaded, String>>;
}

/// What became of a configuration that was read again.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Reloaded {
    /// Cameras of the configuration that were started, changed or removed.
    pub cameras: Vec<String>,
    /// Webhooks of the configuration that were started, changed or removed.
    pub webhooks: Vec<String>,
    /// Whether the MQTT broker is another, or is told otherwise.
    pub mqtt: bool,
    /// Whether the certificate was read again.
    pub certificate: bool,
    /// Settings that differ from those in use and take a restart.
    pub restart: Vec<String>,
    /// What could not be done of it.
    pub failed: Vec<String>,
}

/// `GET` and `PUT /v1/log`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LogLevel {
    level: String,
}

fn operations(state: &ApiState) -> Result<&Arc<dyn Operations>, Problem> {
    let none = || Problem::unavailable("this service was started without a way to change that");
    state.operations.as_ref().ok_or_else(none)
}

pub(super) async fn log(State(state): State<ApiState>) -> Result<Json<LogLevel>, Problem> {
    Ok(Json(LogLevel { level: operations(&state)?.log_level() }))
}

pub(super) async fn set_log(
    State(state): State<ApiState>,
    JsonBody(wanted): JsonBody<LogLevel>,
) -> Result<Json<LogLevel>, Problem> {
    operations(&state)?.set_log_level(&wanted.level).map_err(Problem::bad_request)?;
    Ok(Json(wanted))
}

/// `POST /v1/reload`: as SIGHUP.
pub(super) async fn reload(State(state): State<ApiState>) -> Result<Json<Reloaded>, Problem> {
    let operations = operations(&state)?.clone();
    let reloaded = to_its_end(async move { operations.reload().await.map_err(Problem::bad_request) });
    reloaded.await.map(Json)
}
