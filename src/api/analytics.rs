//! A camera's lines, zones, counts and heat map over REST.

use std::collections::BTreeMap;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde::Serialize;

use super::ApiState;
use super::problem::Problem;
use super::rest::{Path, camera_id, json_body};
use super::rules::{EditError, Findings, LineSpec, Rule, RuleEdit, RulesSpec, ZoneSpec};
use crate::analytics::{
    HEAT_COLUMNS, HEAT_ROWS, Heat, Line, LineCount, RuleError, RuleId, Rules, Zone, ZoneCount,
};

#[derive(Serialize)]
pub(super) struct LineList {
    lines: Vec<LineSpec>,
}

#[derive(Serialize)]
pub(super) struct ZoneList {
    zones: Vec<ZoneSpec>,
}

fn rules(state: &ApiState, camera: &str) -> Result<Rules, Problem> {
    state.cameras.rules(&camera_id(camera)?).ok_or_else(|| Problem::unknown_camera(camera))
}

async fn edit(state: &ApiState, camera: &str, change: RuleEdit) -> Result<Rules, Problem> {
    Ok(state.cameras.edit_rules(&camera_id(camera)?, change).await?)
}

/// A name from a path: one that is no name names nothing.
fn rule_id(name: &str, what: &'static str) -> Result<RuleId, Problem> {
    RuleId::new(name)
        .map_err(|_| Problem::unknown_rule(format!("there is no {what} {name:?} on this camera")))
}

fn created(camera: &str, what: &str, id: &str, body: impl Serialize) -> Response {
    let mut response = (StatusCode::CREATED, Json(body)).into_response();
    if let Ok(location) = HeaderValue::from_str(&format!("/v1/cameras/{camera}/{what}/{id}")) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    response
}

/// The body of a `PUT`; a name in it must be that of the path.
fn named<T: serde::de::DeserializeOwned>(
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
    id: &str,
    of: fn(&T) -> &str,
) -> Result<T, Problem> {
    let spec: T = json_body(headers, body)?;
    if of(&spec) != id {
        let got = of(&spec);
        return Err(Problem::bad_request(format!("the body is of {got:?}, the path of {id:?}")));
    }
    Ok(spec)
}

fn refused(error: RuleError) -> Problem {
    Problem::bad_request(error.to_string())
}

pub(super) async fn lines(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
) -> Result<Json<LineList>, Problem> {
    Ok(Json(LineList { lines: RulesSpec::from(&rules(&state, &camera)?).lines }))
}

pub(super) async fn line(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
) -> Result<Json<LineSpec>, Problem> {
    let (rules, id) = (rules(&state, &camera)?, rule_id(&id, "line")?);
    let line = rules.lines.iter().find(|line| line.id == id);
    line.map(|line| Json(line.into())).ok_or_else(|| EditError::Unknown { what: "line", id }.into())
}

pub(super) async fn add_line(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let spec: LineSpec = json_body(&headers, body)?;
    let line = Line::try_from(spec.clone()).map_err(refused)?;
    edit(&state, &camera, RuleEdit::Add(Rule::Line(line))).await?;
    Ok(created(&camera, "lines", &spec.id.clone(), spec))
}

pub(super) async fn put_line(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<LineSpec>, Problem> {
    let spec = named(&headers, body, &id, |spec: &LineSpec| &spec.id)?;
    let line = Line::try_from(spec.clone()).map_err(refused)?;
    edit(&state, &camera, RuleEdit::Put(Rule::Line(line))).await?;
    Ok(Json(spec))
}

pub(super) async fn remove_line(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
) -> Result<StatusCode, Problem> {
    edit(&state, &camera, RuleEdit::RemoveLine(rule_id(&id, "line")?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

pub(super) async fn zones(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
) -> Result<Json<ZoneList>, Problem> {
    Ok(Json(ZoneList { zones: RulesSpec::from(&rules(&state, &camera)?).zones }))
}

pub(super) async fn zone(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
) -> Result<Json<ZoneSpec>, Problem> {
    let (rules, id) = (rules(&state, &camera)?, rule_id(&id, "zone")?);
    let zone = rules.zones.iter().find(|zone| zone.id == id);
    zone.map(|zone| Json(zone.into())).ok_or_else(|| EditError::Unknown { what: "zone", id }.into())
}

pub(super) async fn add_zone(
    State(state): State<ApiState>,
    Path(camera): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let spec: ZoneSpec = json_body(&headers, body)?;
    let zone = Zone::try_from(spec.clone()).map_err(refused)?;
    edit(&state, &camera, RuleEdit::Add(Rule::Zone(zone))).await?;
    Ok(created(&camera, "zones", &spec.id.clone(), spec))
}

pub(super) async fn put_zone(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<ZoneSpec>, Problem> {
    let spec = named(&headers, body, &id, |spec: &ZoneSpec| &spec.id)?;
    let zone = Zone::try_from(spec.clone()).map_err(refused)?;
    edit(&state, &camera, RuleEdit::Put(Rule::Zone(zone))).await?;
    Ok(Json(spec))
}

pub(super) async fn remove_zone(
    State(state): State<ApiState>,
    Path((camera, id)): Path<(String, String)>,
) -> Result<StatusCode, Problem> {
    edit(&state, &camera, RuleEdit::RemoveZone(rule_id(&id, "zone")?)).await?;
    Ok(StatusCode::NO_CONTENT)
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
