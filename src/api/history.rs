//! `/v1/history`: what was.

use std::fmt::Display;

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::{Query, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures::stream::try_unfold;
use jiff::{SignedDuration, Timestamp};
use serde::Serialize;
use serde_json::value::RawValue;

use super::ApiState;
use super::extract::Path;
use super::problem::Problem;
use super::table::{event_table, mot_lines, track_table};
use crate::analytics::RuleId;
use crate::history::{Bucket, Cursor, Database, HistoryError, KeyBox, PastTrack, TrackKey, Wanted};
use crate::publish::{CaptureTs, EVENT_KINDS};
use crate::types::{CameraId, Epoch, TrackId};

/// Tracks or events in an answer if the client does not say.
const DEFAULT_LIMIT: usize = 100;
/// At most.
const MAX_LIMIT: usize = 1000;
/// Rows that an export reads at a time.
const EXPORT_PAGE: usize = 500;
/// Buckets of an answer at most.
const MAX_BUCKETS: i64 = 2000;
/// Seconds of a bucket if the client does not say.
const DEFAULT_BUCKET: i64 = 3600;
/// Longest bucket, s.
const MAX_BUCKET: i64 = 31 * 86_400;
const NS: i64 = 1_000_000_000;

fn database(state: &ApiState) -> Result<&Database, Problem> {
    state.history.as_ref().ok_or_else(Problem::no_history)
}

impl From<HistoryError> for Problem {
    fn from(error: HistoryError) -> Self {
        tracing::warn!("a question to the history failed: {error}");
        Self::unavailable("the history's database does not answer now; the log says why")
    }
}

/// What a query may ask.
#[derive(Default)]
struct Asked {
    wanted: Wanted,
    limit: Option<usize>,
    cursor: Option<Cursor>,
    bucket: Option<i64>,
}

/// `known` are the parameters that this path has.
fn asked(query: &[(String, String)], known: &[&str]) -> Result<Asked, Problem> {
    let mut asked = Asked::default();
    for (key, value) in query {
        let wrong = |what: &dyn Display| Problem::bad_request(format!("{key}={value:?} {what}"));
        let wanted = &mut asked.wanted;
        if !known.contains(&key.as_str()) {
            let known = known.join(", ");
            return Err(Problem::bad_request(format!("unknown parameter {key:?}; there are {known}")));
        }
        let name = || RuleId::new(value).map(|id| id.as_str().to_owned()).map_err(|error| wrong(&error));
        let number = |from: i64, to: i64| {
            let number = value.parse().ok().filter(|n| (from..=to).contains(n));
            number.ok_or_else(|| wrong(&format_args!("must be a number from {from} to {to}")))
        };
        match key.as_str() {
            // Of a camera that was, too.
            "camera" => wanted.camera = Some(CameraId::new(value)?),
            "epoch" => wanted.epoch = Some(Epoch(number(0, i64::MAX)? as u64)),
            "from" => wanted.from_ns = Some(time(value).map_err(|error| wrong(&error))?),
            "to" => wanted.to_ns = Some(time(value).map_err(|error| wrong(&error))?),
            "class" => wanted.class = Some(value.clone()),
            "line" => wanted.line = Some(name()?),
            "zone" => wanted.zone = Some(name()?),
            "type" => match EVENT_KINDS.into_iter().find(|kind| kind == value) {
                Some(kind) => wanted.kind = Some(kind.to_owned()),
                None => return Err(wrong(&format_args!("is none of {}", EVENT_KINDS.join(", ")))),
            },
            "min_s" => match value.parse() {
                Ok(seconds) if (0.0..=1e9).contains(&seconds) => wanted.min_s = Some(seconds),
                _ => return Err(wrong(&"must be seconds, from 0 to 1000000000")),
            },
            "limit" => asked.limit = Some(number(1, MAX_LIMIT as i64)? as usize),
            "bucket_s" => asked.bucket = Some(number(1, MAX_BUCKET)?),
            _ => {
                asked.cursor =
                    Some(value.parse().map_err(|()| wrong(&"is no cursor: take `next` of the page before"))?);
            }
        }
    }
    if let (Some(from), Some(to)) = (asked.wanted.from_ns, asked.wanted.to_ns)
        && from >= to
    {
        return Err(Problem::bad_request("`from` must be before `to`"));
    }
    Ok(asked)
}

fn time(text: &str) -> Result<i64, &'static str> {
    let time: Timestamp = text.parse().map_err(|_| "must be a time such as 2026-01-02T03:04:05Z")?;
    i64::try_from(time.as_nanosecond()).map_err(|_| "must be a year from 1678 to 2261")
}

const TRACKS: [&str; 10] =
    ["camera", "epoch", "class", "line", "zone", "from", "to", "min_s", "limit", "cursor"];
const EVENTS: [&str; 8] = ["camera", "type", "line", "zone", "from", "to", "limit", "cursor"];
/// An export has no pages.
const PAGING: usize = 2;

#[derive(Serialize)]
pub(super) struct Summary {
    backend: &'static str,
    tracks: i64,
    events: i64,
    bytes: i64,
    oldest: Option<CaptureTs>,
}

/// `GET /v1/history`.
pub(super) async fn summary(State(state): State<ApiState>) -> Result<Json<Summary>, Problem> {
    let database = database(&state)?;
    let (totals, bytes) = (database.totals().await?, database.bytes().await?);
    let oldest = totals.oldest_ns.map(CaptureTs);
    Ok(Json(Summary {
        backend: database.name(),
        tracks: totals.tracks,
        events: totals.events,
        bytes,
        oldest,
    }))
}

#[derive(Serialize)]
pub(super) struct TrackPage {
    tracks: Vec<TrackBody>,
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<String>,
}

#[derive(Serialize)]
pub(super) struct TrackBody {
    camera: String,
    epoch: u64,
    id: u64,
    class: String,
    first: CaptureTs,
    last: CaptureTs,
    seconds: f64,
    confidence: f64,
    ended: bool,
    width: i64,
    height: i64,
    path: Vec<BoxBody>,
    #[serde(skip_serializing_if = "Option::is_none")]
    snapshot: Option<String>,
}

#[derive(Serialize)]
struct BoxBody {
    time: CaptureTs,
    frame: u64,
    #[serde(rename = "box")]
    bbox: [f64; 4],
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    after_gap: bool,
}

impl From<PastTrack> for TrackBody {
    fn from(track: PastTrack) -> Self {
        let PastTrack {
            key,
            class,
            first_ns,
            last_ns,
            ended,
            confidence,
            size: [width, height],
            path,
            snapshot,
        } = track;
        let key_box = |KeyBox { frame, unix_ns, bbox, after_gap }| {
            let bbox = bbox.map(|v: f64| (v * 100.0).round() / 100.0);
            BoxBody { time: CaptureTs(unix_ns), frame, bbox, after_gap }
        };
        let TrackKey { camera, epoch: Epoch(epoch), id } = &key;
        let picture = format!("/v1/history/tracks/{camera}/{epoch}/{id}/snapshot.jpg");
        Self {
            camera: key.camera.to_string(),
            epoch: key.epoch.0,
            id: key.id.0,
            class,
            first: CaptureTs(first_ns),
            last: CaptureTs(last_ns),
            seconds: seconds(first_ns, last_ns),
            confidence: (confidence * 1e4).round() / 1e4,
            ended,
            width,
            height,
            path: path.into_iter().map(key_box).collect(),
            snapshot: snapshot.then_some(picture),
        }
    }
}

/// To a thousandth.
pub(super) fn seconds(from_ns: i64, to_ns: i64) -> f64 {
    ((to_ns - from_ns) as f64 * 1e-6).round() / 1e3
}

/// `GET /v1/history/tracks`.
pub(super) async fn tracks(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Json<TrackPage>, Problem> {
    let asked = asked(&query, &TRACKS)?;
    let limit = asked.limit.unwrap_or(DEFAULT_LIMIT);
    let (tracks, next) = database(&state)?.tracks(&asked.wanted, asked.cursor.as_ref(), limit).await?;
    let tracks = tracks.into_iter().map(TrackBody::from).collect();
    Ok(Json(TrackPage { tracks, next: next.map(|cursor| cursor.to_string()) }))
}

/// `GET /v1/history/tracks/{camera}/{epoch}/{track}`.
pub(super) async fn track(
    State(state): State<ApiState>,
    Path((camera, epoch, id)): Path<(String, String, String)>,
) -> Result<Json<TrackBody>, Problem> {
    let key = track_key(&camera, &epoch, &id)?;
    let found = database(&state)?.track(&key).await?;
    found.map(|track| Json(track.into())).ok_or_else(|| unknown_track(&camera, &epoch, &id))
}

fn unknown_track(camera: &str, epoch: &str, id: &str) -> Problem {
    Problem::not_found(format!("no track {camera}/{epoch}/{id} is remembered"))
}

/// From a path: what is no number names no track.
fn track_key(camera: &str, epoch: &str, id: &str) -> Result<TrackKey, Problem> {
    let number = |text: &str| {
        let number = text.parse::<i64>().ok().and_then(|n| u64::try_from(n).ok());
        number.ok_or_else(|| unknown_track(camera, epoch, id))
    };
    let camera = CameraId::new(camera).map_err(|_| unknown_track(camera, epoch, id))?;
    Ok(TrackKey { camera, epoch: Epoch(number(epoch)?), id: TrackId(number(id)?) })
}

/// `GET /v1/history/tracks/{camera}/{epoch}/{track}/snapshot.jpg`.
pub(super) async fn snapshot(
    State(state): State<ApiState>,
    Path((camera, epoch, id)): Path<(String, String, String)>,
) -> Result<Response, Problem> {
    let key = track_key(&camera, &epoch, &id)?;
    let jpeg = database(&state)?.snapshot(&key).await?;
    let jpeg = jpeg
        .ok_or_else(|| Problem::not_found(format!("there is no snapshot of track {camera}/{epoch}/{id}")))?;
    Ok(([(header::CONTENT_TYPE, "image/jpeg"), (header::CACHE_CONTROL, "no-store")], jpeg).into_response())
}

#[derive(Serialize)]
pub(super) struct EventPage {
    events: Vec<Box<RawValue>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<String>,
}

/// `GET /v1/history/events`: as they were told.
pub(super) async fn events(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Json<EventPage>, Problem> {
    let asked = asked(&query, &EVENTS)?;
    let limit = asked.limit.unwrap_or(DEFAULT_LIMIT);
    let (events, next) = database(&state)?.events(&asked.wanted, asked.cursor.as_ref(), limit).await?;
    let events = events.into_iter().map(|event| RawValue::from_string(event.json)).collect::<Result<_, _>>();
    let events =
        events.map_err(|error| Problem::internal(format!("an event in the history is damaged: {error}")))?;
    Ok(Json(EventPage { events, next: next.map(|cursor| cursor.to_string()) }))
}

#[derive(Serialize)]
pub(super) struct BucketsBody {
    camera: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    line: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    zone: Option<String>,
    bucket_s: i64,
    buckets: Vec<BucketBody>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum BucketBody {
    Line {
        start: CaptureTs,
        #[serde(rename = "in")]
        inwards: i64,
        #[serde(rename = "out")]
        outwards: i64,
    },
    Zone {
        start: CaptureTs,
        entries: i64,
        exits: i64,
        mean_dwell_s: Option<f64>,
    },
}

/// `GET /v1/history/counts`.
pub(super) async fn counts(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Json<BucketsBody>, Problem> {
    let Asked { wanted, bucket, .. } = asked(&query, &["camera", "line", "zone", "from", "to", "bucket_s"])?;
    let camera = wanted.camera.ok_or_else(|| Problem::bad_request("say which `camera`"))?;
    let to = match wanted.to_ns {
        Some(to) => to,
        None => time(&Timestamp::now().to_string()).map_err(Problem::internal)?,
    };
    let day = SignedDuration::from_hours(24).as_nanos() as i64;
    let from = wanted.from_ns.unwrap_or(to.saturating_sub(day));
    let bucket_s = bucket.unwrap_or(DEFAULT_BUCKET);
    let length = to.checked_sub(from).filter(|length| *length > 0);
    let length = length.ok_or_else(|| Problem::bad_request("`from` must be before `to`"))?;
    if length / (bucket_s * NS) >= MAX_BUCKETS {
        return Err(Problem::bad_request(format!(
            "that is more than {MAX_BUCKETS} buckets: ask for a shorter time or a longer `bucket_s`"
        )));
    }
    // Buckets begin at whole multiples of their length, so that those of two answers are the same.
    let first = from.div_euclid(bucket_s * NS) * (bucket_s * NS);
    let (database, range) = (database(&state)?, [first, from, to]);
    let buckets = match (&wanted.line, &wanted.zone) {
        (Some(line), None) => {
            let buckets = database.crossings(&camera, line, range, bucket_s * NS).await?;
            buckets.into_iter().map(line_bucket).collect()
        }
        (None, Some(zone)) => {
            let buckets = database.visits(&camera, zone, range, bucket_s * NS).await?;
            buckets.into_iter().map(zone_bucket).collect()
        }
        _ => return Err(Problem::bad_request("say which `line` or which `zone`, one of them")),
    };
    Ok(Json(BucketsBody {
        camera: camera.to_string(),
        line: wanted.line,
        zone: wanted.zone,
        bucket_s,
        buckets,
    }))
}

fn line_bucket(Bucket { start_ns, inwards, outwards, .. }: Bucket) -> BucketBody {
    BucketBody::Line { start: CaptureTs(start_ns), inwards, outwards }
}

fn zone_bucket(Bucket { start_ns, inwards, outwards, mean_dwell }: Bucket) -> BucketBody {
    let mean_dwell_s = mean_dwell.map(|s| (s * 1e3).round() / 1e3);
    BucketBody::Zone { start: CaptureTs(start_ns), entries: inwards, exits: outwards, mean_dwell_s }
}

/// `GET /v1/history/tracks.csv`.
pub(super) async fn tracks_csv(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Response, Problem> {
    let Asked { wanted, .. } = asked(&query, &TRACKS[..TRACKS.len() - PAGING])?;
    export(database(&state)?.clone(), wanted, Export::Tracks).await
}

/// `GET /v1/history/events.csv`.
pub(super) async fn events_csv(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Response, Problem> {
    let Asked { wanted, .. } = asked(&query, &EVENTS[..EVENTS.len() - PAGING])?;
    export(database(&state)?.clone(), wanted, Export::Events).await
}

/// `GET /v1/history/tracks.txt`: MOTChallenge lines of one camera and epoch, the newest epoch if none is named.
pub(super) async fn tracks_mot(
    State(state): State<ApiState>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Response, Problem> {
    let Asked { mut wanted, .. } = asked(&query, &TRACKS[..TRACKS.len() - PAGING])?;
    if wanted.camera.is_none() {
        return Err(Problem::bad_request("say which `camera`: frames of two cameras have the same numbers"));
    }
    let database = database(&state)?.clone();
    if wanted.epoch.is_none() {
        let (newest, _) = database.tracks(&wanted, None, 1).await?;
        wanted.epoch = newest.first().map(|track| track.key.epoch);
    }
    export(database, wanted, Export::Mot).await
}

#[derive(Clone, Copy)]
enum Export {
    Tracks,
    Events,
    Mot,
}

impl Export {
    /// The page after `cursor` as it is sent, and where the next begins.
    async fn page(
        self,
        database: &Database,
        wanted: &Wanted,
        cursor: Option<Cursor>,
    ) -> Result<(Vec<u8>, Option<Cursor>), HistoryError> {
        if let Export::Events = self {
            let (events, next) = database.events(wanted, cursor.as_ref(), EXPORT_PAGE).await?;
            return Ok((event_table(cursor.is_none(), &events), next));
        }
        let (tracks, next) = database.tracks(wanted, cursor.as_ref(), EXPORT_PAGE).await?;
        Ok(match self {
            Export::Mot => (mot_lines(&tracks), next),
            _ => (track_table(cursor.is_none(), &tracks), next),
        })
    }
}

/// A download of all pages, one after the other. The first is read before the answer begins, so that a database that
/// is away is told as an error; if it goes later the download breaks off.
async fn export(database: Database, wanted: Wanted, what: Export) -> Result<Response, Problem> {
    let (media_type, name) = match what {
        Export::Tracks => ("text/csv; charset=utf-8", "tracks.csv"),
        Export::Events => ("text/csv; charset=utf-8", "events.csv"),
        Export::Mot => ("text/plain; charset=utf-8", "tracks.txt"),
    };
    let first = what.page(&database, &wanted, None).await?;
    let pages = try_unfold(Some((Some(first), None)), move |next: Option<Unsent>| {
        let (database, wanted) = (database.clone(), wanted.clone());
        async move {
            let Some((page, cursor)) = next else { return Ok::<_, HistoryError>(None) };
            let (bytes, next) = match page {
                Some(page) => page,
                None => what.page(&database, &wanted, cursor).await?,
            };
            Ok(Some((Bytes::from(bytes), next.map(|next| (None, Some(next))))))
        }
    });
    let headers = [
        (header::CONTENT_TYPE, media_type.to_owned()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\"")),
    ];
    Ok((headers, Body::from_stream(pages)).into_response())
}

/// A page that was read already, or where the next begins.
type Unsent = (Option<(Vec<u8>, Option<Cursor>)>, Option<Cursor>);
