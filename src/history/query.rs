//! Questions: tracks and events by time, camera, line and zone, page by page; counts in buckets.

use std::collections::HashMap;
use std::str::FromStr;

use sqlx::any::AnyRow;
use sqlx::{AssertSqlSafe, Row};

use super::database::{Database, HistoryError};
use super::path::KeyBox;
use super::recorder::TrackKey;
use crate::types::{CameraId, Epoch, TrackId};

/// Which tracks or events. What is `None` is not asked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Wanted {
    /// Of this camera.
    pub camera: Option<CameraId>,
    /// Tracks of this generation of ids.
    pub epoch: Option<Epoch>,
    /// Seen at this time or later, nanoseconds since 1970.
    pub from_ns: Option<i64>,
    /// Seen before this time.
    pub to_ns: Option<i64>,
    /// Tracks of this class.
    pub class: Option<String>,
    /// Tracks that were in view at least so long, seconds.
    pub min_s: Option<f64>,
    /// Events of this kind.
    pub kind: Option<String>,
    /// At this line.
    pub line: Option<String>,
    /// In this zone.
    pub zone: Option<String>,
}

/// A track as it is remembered.
#[derive(Clone, Debug, PartialEq)]
pub struct PastTrack {
    /// Which.
    pub key: TrackKey,
    /// Its class.
    pub class: String,
    /// First seen, nanoseconds since 1970.
    pub first_ns: i64,
    /// Last seen.
    pub last_ns: i64,
    /// Whether it is over.
    pub ended: bool,
    /// Its best score.
    pub confidence: f64,
    /// Width and height of the picture.
    pub size: [i64; 2],
    /// Key boxes, the newest box last.
    pub path: Vec<KeyBox>,
    /// Whether there is a snapshot.
    pub snapshot: bool,
}

/// An event as it was told.
#[derive(Clone, Debug, PartialEq)]
pub struct PastEvent {
    /// Its id.
    pub id: String,
    /// Nanoseconds since 1970.
    pub time_ns: i64,
    /// The JSON message.
    pub json: String,
}

/// Where a page begins: after this one.
#[derive(Clone, Debug, PartialEq)]
pub struct Cursor {
    time_ns: i64,
    id: String,
}

impl std::fmt::Display for Cursor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}_{}", self.time_ns, self.id)
    }
}

impl FromStr for Cursor {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let (time, id) = text.split_once('_').ok_or(())?;
        Ok(Self { time_ns: time.parse().map_err(|_| ())?, id: id.into() })
    }
}

/// Crossings of a line or movements of a zone within a bucket of time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bucket {
    /// When it begins, nanoseconds since 1970.
    pub start_ns: i64,
    /// Crossings inwards, or entries.
    pub inwards: i64,
    /// Crossings outwards, or exits.
    pub outwards: i64,
    /// Mean stay of those who left, seconds.
    pub mean_dwell: Option<f64>,
}

/// What there is in all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Totals {
    /// Tracks.
    pub tracks: i64,
    /// Events.
    pub events: i64,
    /// The oldest of them, nanoseconds since 1970.
    pub oldest_ns: Option<i64>,
}

enum Value {
    Int(i64),
    Text(String),
}

/// A statement in the making.
struct Sql {
    text: String,
    values: Vec<Value>,
}

impl Sql {
    fn new(text: &str) -> Self {
        Self { text: text.into(), values: vec![] }
    }

    /// Adds text in which each `?` stands for the next of `values`.
    fn add(&mut self, text: &str, values: impl IntoIterator<Item = Value>) -> &mut Self {
        let mut values = values.into_iter();
        for part in text.split_inclusive('?') {
            match part.strip_suffix('?') {
                Some(before) => {
                    self.values.extend(values.next());
                    self.text += &format!("{before}${}", self.values.len());
                }
                None => self.text += part,
            }
        }
        self
    }

    async fn rows(self, database: &Database) -> Result<Vec<AnyRow>, HistoryError> {
        let query = sqlx::query(AssertSqlSafe(self.text));
        let query = self.values.into_iter().fold(query, |query, value| match value {
            Value::Int(value) => query.bind(value),
            Value::Text(value) => query.bind(value),
        });
        Ok(query.fetch_all(database.pool()).await?)
    }
}

fn text(value: &str) -> Value {
    Value::Text(value.into())
}

const TRACK: &str = "SELECT t.camera, t.epoch, t.id, t.class, t.first_ns, t.last_ns, t.ended, t.confidence, t.width, \
    t.height, t.last_frame, t.x, t.y, t.w, t.h, \
    (SELECT count(*) FROM snapshots s WHERE s.camera = t.camera AND s.epoch = t.epoch AND s.id = t.id) FROM tracks t";

/// Orders tracks of one instant; unique with it.
const TRACK_ORDER: &str = "(t.camera || '/' || t.epoch || '/' || t.id)";

impl Database {
    /// Tracks, the newest first by when they were first seen; where the next page begins, if there is one.
    ///
    /// # Errors
    /// The database's.
    pub async fn tracks(
        &self,
        wanted: &Wanted,
        after: Option<&Cursor>,
        limit: usize,
    ) -> Result<(Vec<PastTrack>, Option<Cursor>), HistoryError> {
        let mut sql = Sql::new(TRACK);
        sql.text += " WHERE 1 = 1";
        if let Some(camera) = &wanted.camera {
            sql.add(" AND t.camera = ?", [text(camera.as_str())]);
        }
        if let Some(Epoch(epoch)) = wanted.epoch {
            sql.add(" AND t.epoch = ?", [Value::Int(epoch as i64)]);
        }
        if let Some(from) = wanted.from_ns {
            sql.add(" AND t.last_ns >= ?", [Value::Int(from)]);
        }
        if let Some(to) = wanted.to_ns {
            sql.add(" AND t.first_ns < ?", [Value::Int(to)]);
        }
        if let Some(class) = &wanted.class {
            sql.add(" AND t.class = ?", [text(class)]);
        }
        if let Some(seconds) = wanted.min_s {
            sql.add(" AND t.last_ns - t.first_ns >= ?", [Value::Int((seconds * 1e9) as i64)]);
        }
        for (column, name) in [("line", &wanted.line), ("zone", &wanted.zone)] {
            if let Some(name) = name {
                let exists = format!(
                    " AND EXISTS (SELECT 1 FROM events e WHERE e.camera = t.camera AND e.epoch = t.epoch \
                     AND e.track = t.id AND e.{column} = ?)"
                );
                sql.add(&exists, [text(name)]);
            }
        }
        if let Some(Cursor { time_ns, id }) = after {
            let after = format!(" AND (t.first_ns < ? OR (t.first_ns = ? AND {TRACK_ORDER} < ?))");
            sql.add(&after, [Value::Int(*time_ns), Value::Int(*time_ns), text(id)]);
        }
        let order = format!(" ORDER BY t.first_ns DESC, {TRACK_ORDER} DESC LIMIT ?");
        sql.add(&order, [Value::Int(limit as i64 + 1)]);
        let mut tracks = self.past_tracks(sql).await?;
        let next = page_end(&mut tracks, limit, |track| {
            let TrackKey { camera, epoch, id } = &track.key;
            Cursor { time_ns: track.first_ns, id: format!("{camera}/{}/{id}", epoch.0) }
        });
        Ok((tracks, next))
    }

    /// One track.
    ///
    /// # Errors
    /// The database's.
    pub async fn track(&self, key: &TrackKey) -> Result<Option<PastTrack>, HistoryError> {
        let mut sql = Sql::new(TRACK);
        sql.add(" WHERE t.camera = ? AND t.epoch = ? AND t.id = ?", key_values(key));
        Ok(self.past_tracks(sql).await?.pop())
    }

    async fn past_tracks(&self, sql: Sql) -> Result<Vec<PastTrack>, HistoryError> {
        let rows = sql.rows(self).await?;
        let mut tracks = rows.iter().map(track).collect::<Result<Vec<_>, _>>()?;
        if tracks.is_empty() {
            return Ok(tracks);
        }
        let mut sql = Sql::new(
            "SELECT camera, epoch, id, frame, time_ns, x, y, w, h, after_gap FROM track_boxes \
             WHERE (camera, epoch, id) IN (",
        );
        for (index, track) in tracks.iter().enumerate() {
            // PostgreSQL does not see what a bare parameter in VALUES is.
            let row = "(CAST(? AS TEXT), CAST(? AS BIGINT), CAST(? AS BIGINT))";
            sql.text += if index == 0 { "VALUES " } else { ", " };
            sql.add(row, key_values(&track.key));
        }
        sql.text += ") ORDER BY frame";
        let mut paths: HashMap<TrackKey, Vec<KeyBox>> = HashMap::new();
        for row in sql.rows(self).await? {
            let after_gap = row.try_get::<i64, _>(9)? != 0;
            paths.entry(key(&row)?).or_default().push(key_box(&row, 3, after_gap)?);
        }
        for track in &mut tracks {
            let newest = track.path.pop();
            track.path = paths.remove(&track.key).unwrap_or_default();
            // The newest box is a key box once the track is over.
            track.path.extend(newest.filter(|at| track.path.last().is_none_or(|last| last.frame < at.frame)));
        }
        Ok(tracks)
    }

    /// Events, the newest first; where the next page begins, if there is one.
    ///
    /// # Errors
    /// The database's.
    pub async fn events(
        &self,
        wanted: &Wanted,
        after: Option<&Cursor>,
        limit: usize,
    ) -> Result<(Vec<PastEvent>, Option<Cursor>), HistoryError> {
        let mut sql = Sql::new("SELECT id, time_ns, json FROM events WHERE 1 = 1");
        let camera = wanted.camera.as_ref().map(|camera| camera.as_str().to_owned());
        for (column, value) in
            [("camera", &camera), ("type", &wanted.kind), ("line", &wanted.line), ("zone", &wanted.zone)]
        {
            if let Some(value) = value {
                sql.add(&format!(" AND {column} = ?"), [text(value)]);
            }
        }
        if let Some(from) = wanted.from_ns {
            sql.add(" AND time_ns >= ?", [Value::Int(from)]);
        }
        if let Some(to) = wanted.to_ns {
            sql.add(" AND time_ns < ?", [Value::Int(to)]);
        }
        if let Some(Cursor { time_ns, id }) = after {
            let values = [Value::Int(*time_ns), Value::Int(*time_ns), text(id)];
            sql.add(" AND (time_ns < ? OR (time_ns = ? AND id < ?))", values);
        }
        sql.add(" ORDER BY time_ns DESC, id DESC LIMIT ?", [Value::Int(limit as i64 + 1)]);
        let rows = sql.rows(self).await?;
        let event = |row: &AnyRow| -> Result<PastEvent, sqlx::Error> {
            Ok(PastEvent { id: row.try_get(0)?, time_ns: row.try_get(1)?, json: row.try_get(2)? })
        };
        let mut events = rows.iter().map(event).collect::<Result<Vec<_>, _>>()?;
        let next =
            page_end(&mut events, limit, |event| Cursor { time_ns: event.time_ns, id: event.id.clone() });
        Ok((events, next))
    }

    /// Crossings of a line in buckets of `bucket_ns` that are counted from `first_ns`, which is no later than
    /// `from_ns`; events from `from_ns` to before `to_ns`. Empty buckets are left out.
    ///
    /// # Errors
    /// The database's.
    pub async fn crossings(
        &self,
        camera: &CameraId,
        line: &str,
        [first_ns, from_ns, to_ns]: [i64; 3],
        bucket_ns: i64,
    ) -> Result<Vec<Bucket>, HistoryError> {
        self.buckets(
            ["line", "direction", "in", "line.crossed"],
            camera,
            line,
            [first_ns, from_ns, to_ns],
            bucket_ns,
        )
        .await
    }

    /// Entries and exits of a zone, likewise.
    ///
    /// # Errors
    /// The database's.
    pub async fn visits(
        &self,
        camera: &CameraId,
        zone: &str,
        [first_ns, from_ns, to_ns]: [i64; 3],
        bucket_ns: i64,
    ) -> Result<Vec<Bucket>, HistoryError> {
        self.buckets(
            ["zone", "type", "zone.entered", "zone.left"],
            camera,
            zone,
            [first_ns, from_ns, to_ns],
            bucket_ns,
        )
        .await
    }

    /// `inward` is what `sign` says of those who come in.
    async fn buckets(
        &self,
        [what, sign, inward, kind]: [&str; 4],
        camera: &CameraId,
        name: &str,
        [first_ns, from_ns, to_ns]: [i64; 3],
        bucket_ns: i64,
    ) -> Result<Vec<Bucket>, HistoryError> {
        let mut sql = Sql::new("");
        // Counted from the first bucket, so that division never rounds a negative time up.
        sql.add(
            &format!(
                "SELECT (time_ns - CAST(? AS BIGINT)) / CAST(? AS BIGINT) AS bucket, \
                 sum(CASE WHEN {sign} = ? THEN 1 ELSE 0 END), sum(CASE WHEN {sign} = ? THEN 0 ELSE 1 END), \
                 avg(dwell_s) FROM events WHERE camera = ? AND {what} = ? AND type IN (?, ?) \
                 AND time_ns >= ? AND time_ns < ? GROUP BY bucket ORDER BY bucket"
            ),
            [
                Value::Int(first_ns),
                Value::Int(bucket_ns),
                text(inward),
                text(inward),
                text(camera.as_str()),
                text(name),
                text(kind),
                // A kind, or nothing that is one.
                text(inward),
                Value::Int(from_ns),
                Value::Int(to_ns),
            ],
        );
        let bucket = |row: &AnyRow| -> Result<Bucket, sqlx::Error> {
            Ok(Bucket {
                start_ns: first_ns + row.try_get::<i64, _>(0)? * bucket_ns,
                inwards: row.try_get(1)?,
                outwards: row.try_get(2)?,
                mean_dwell: row.try_get(3)?,
            })
        };
        Ok(sql.rows(self).await?.iter().map(bucket).collect::<Result<_, _>>()?)
    }

    /// What there is.
    ///
    /// # Errors
    /// The database's.
    pub async fn totals(&self) -> Result<Totals, HistoryError> {
        let sql = Sql::new(
            "SELECT (SELECT count(*) FROM tracks), (SELECT count(*) FROM events), \
             (SELECT min(first_ns) FROM tracks), (SELECT min(time_ns) FROM events)",
        );
        let rows = sql.rows(self).await?;
        let row = rows.first().ok_or(sqlx::Error::RowNotFound)?;
        let oldest: [Option<i64>; 2] = [row.try_get(2)?, row.try_get(3)?];
        let oldest_ns = oldest.into_iter().flatten().min();
        Ok(Totals { tracks: row.try_get(0)?, events: row.try_get(1)?, oldest_ns })
    }
}

/// Cuts what was read beyond the page, which says that there is more.
fn page_end<T>(rows: &mut Vec<T>, limit: usize, cursor: impl Fn(&T) -> Cursor) -> Option<Cursor> {
    let more = rows.len() > limit;
    rows.truncate(limit);
    rows.last().filter(|_| more).map(cursor)
}

fn key_values(key: &TrackKey) -> [Value; 3] {
    [text(key.camera.as_str()), Value::Int(key.epoch.0 as i64), Value::Int(key.id.0 as i64)]
}

fn key(row: &AnyRow) -> Result<TrackKey, sqlx::Error> {
    let camera: String = row.try_get(0)?;
    let camera = CameraId::new(&camera).map_err(|error| sqlx::Error::Decode(error.into()))?;
    let (epoch, id): (i64, i64) = (row.try_get(1)?, row.try_get(2)?);
    Ok(TrackKey { camera, epoch: Epoch(epoch as u64), id: TrackId(id as u64) })
}

/// From five columns and the one for the time.
fn key_box(row: &AnyRow, at: usize, after_gap: bool) -> Result<KeyBox, sqlx::Error> {
    let frame: i64 = row.try_get(at)?;
    let bbox = [row.try_get(at + 2)?, row.try_get(at + 3)?, row.try_get(at + 4)?, row.try_get(at + 5)?];
    Ok(KeyBox { frame: frame as u64, unix_ns: row.try_get(at + 1)?, bbox, after_gap })
}

fn track(row: &AnyRow) -> Result<PastTrack, sqlx::Error> {
    let last_ns = row.try_get(5)?;
    let newest = KeyBox {
        frame: row.try_get::<i64, _>(10)? as u64,
        unix_ns: last_ns,
        bbox: [row.try_get(11)?, row.try_get(12)?, row.try_get(13)?, row.try_get(14)?],
        after_gap: false,
    };
    Ok(PastTrack {
        key: key(row)?,
        class: row.try_get(3)?,
        first_ns: row.try_get(4)?,
        last_ns,
        ended: row.try_get::<i64, _>(6)? != 0,
        confidence: row.try_get(7)?,
        size: [row.try_get(8)?, row.try_get(9)?],
        path: vec![newest],
        snapshot: row.try_get::<i64, _>(15)? != 0,
    })
}
