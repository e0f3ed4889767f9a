//! A camera's lines, zones, counts and heat map over REST.

use std::collections::BTreeMap;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::Response;
use axum::routing::{MethodRouter, get};
use jiff::Timestamp;
use serde::Serialize;

use super::ApiState;
use super::extract::{JsonBody, Path, camera_id};
use super::problem::Problem;
use super::rest::created;
use super::rules::{Drawn, EditError, Findings, RuleEdit, RulesSpec};
use crate::analytics::{HEAT_COLUMNS, HEAT_ROWS, Heat, LineCount, RuleError, RuleId, ZoneCount};

/// `GET` and `POST` of a camera's lines or zones.
pub(super) fn all_of<T: Drawn>() -> MethodRouter<ApiState> {
    get(list::<T>).post(add::<T>)
}

/// `GET`, `PUT` and `DELETE` of a line or a zone.
pub(super) fn one_of<T: Drawn>() -> MethodRouter<ApiState> {
    get(one::<T>).put(put::<T>).delete(remove::<T>)
}

fn rules(state: &ApiState, camera: &str) -> Result<RulesSpec, Problem> {
    let rules = state.cameras.rules(&camera_id(camera)?);
    rules.map(|rules| RulesSpec::from(&rules)).ok_or_else(|| Problem::unknown_camera(camera))
}

async fn edit(state: &ApiState, camera: &str, change: RuleEdit) -> Result<(), Problem> {
    state.cameras.edit_rules(&camera_id(camera)?, change).await?;
    Ok(())
}

/// A name from a path: one that is no name names nothing.
fn rule_id<T: Drawn>(name: &str) -> Result<RuleId, Problem> {
    RuleId::new(name)
        .map_err(|_| Problem::unknown_rule(format!("there is no {} {name:?} on this camera", T::WHAT)))
}

async fn list<T: Drawn>(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
) -> Result<Json<BTreeMap<&'static str, Vec<T>>>, Problem> {
    Ok(Json(BTreeMap::from([(T::PLURAL, T::of(rules(&state, &camera)?))])))
}

async fn one<T: Drawn>(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
) -> Result<Json<T>, Problem> {
    let (all, id) = (T::of(rules(&state, &camera)?), rule_id::<T>(&id)?);
    let found = all.into_iter().find(|spec| spec.name() == id.as_str());
    found.map(Json).ok_or_else(|| EditError::Unknown { what: T::WHAT, id }.into())
}

async fn add<T: Drawn>(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
    JsonBody(spec): JsonBody<T>,
) -> Result<Response, Problem> {
    let rule = spec.clone().rule().map_err(refused)?;
    edit(&state, &camera, RuleEdit::Add(rule)).await?;
    Ok(created(format!("/v1/cameras/{camera}/{}/{}", T::PLURAL, spec.name()), spec))
}

/// The name in the body must be that of the path.
async fn put<T: Drawn>(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
    JsonBody(spec): JsonBody<T>,
) -> Result<Json<T>, Problem> {
    if spec.name() != id {
        return Err(Problem::bad_request(format!("the body is of {:?}, the path of {id:?}", spec.name())));
    }
    let rule = spec.clone().rule().map_err(refused)?;
    edit(&state, &camera, RuleEdit::Put(rule)).await?;
    Ok(Json(spec))
}

async fn remove<T: Drawn>(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
) -> Result<StatusCode, Problem> {
    edit(&state, &camera, T::removal(rule_id::<T>(&id)?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

fn refused(error: RuleError) -> Problem {
    Problem::bad_request(error.to_string())
}

#[derive(Serialize)]
pub(super) struct CountsBody {
    camera: String,
    since: String,
    lines: BTreeMap<String, LineBody>,
    zones: BTreeMap<String, ZoneBody>,
}

#[derive(Serialize)]
struct LineBody {
    #[serde(rename = "in")]
    inwards: u64,
    #[serde(rename = "out")]
    outwards: u64,
}

#[derive(Serialize)]
struct ZoneBody {
    occupancy: u32,
    entries: u64,
    exits: u64,
    mean_dwell_s: Option<f64>,
    longest_s: f64,
    crowded: bool,
}

/// Seconds to a thousandth.
fn seconds(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

pub(super) async fn counts(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
) -> Result<Json<CountsBody>, Problem> {
    let Findings { since, counts } =
        state.cameras.findings(&camera_id(&camera)?).ok_or_else(|| Problem::unknown_camera(&camera))?;
    let lines = counts
        .lines
        .into_iter()
        .map(|(id, LineCount { inwards, outwards })| (id.to_string(), LineBody { inwards, outwards }));
    let zones = counts.zones.into_iter().map(|(id, count)| {
        let ZoneCount { occupancy, entries, exits, dwell, longest, crowded } = count;
        let mean_dwell_s = (exits > 0).then(|| seconds(dwell / exits as f64));
        let longest_s = seconds(longest);
        (id.to_string(), ZoneBody { occupancy, entries, exits, mean_dwell_s, longest_s, crowded })
    });
    let (lines, zones) = (lines.collect(), zones.collect());
    Ok(Json(CountsBody { camera, since: format!("{since:.3}"), lines, zones }))
}

#[derive(Serialize)]
pub(super) struct HeatBody {
    camera: String,
    since: String,
    columns: usize,
    rows: usize,
    seconds: Vec<f64>,
}

pub(super) async fn heat_map(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
) -> Result<Json<HeatBody>, Problem> {
    let (since, heat): (Timestamp, Heat) =
        state.cameras.heat(&camera_id(&camera)?).ok_or_else(|| Problem::unknown_camera(&camera))?;
    Ok(Json(HeatBody {
        camera,
        since: format!("{since:.3}"),
        columns: HEAT_COLUMNS,
        rows: HEAT_ROWS,
        seconds: heat.cells().iter().copied().map(seconds).collect(),
    }))
}
