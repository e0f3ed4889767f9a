//! The tables, and writing to them. One SQL text serves SQLite and PostgreSQL.
//!
//! ```text
//! tracks (camera, epoch, id)   one row a track: class, first and last seen, newest box, best score
//! track_boxes                  its key boxes, see `path`; they go with the track
//! snapshots                    its best picture, if pictures are kept; it goes with the track
//! events                       what happened at lines and in zones, and the message that told it
//! ```

use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use sqlx::any::{AnyArguments, AnyConnectOptions, AnyPoolOptions, AnyRow};
use sqlx::error::ErrorKind;
use sqlx::query::Query;
use sqlx::{Any, AnyConnection, AnyPool, AssertSqlSafe, ConnectOptions, Executor, Row};

use super::album::Snapshot;
use super::recorder::{Batch, TrackKey, TrackRow};
use crate::analytics::What;
use crate::publish::{NumberedEvent, class_name};

/// Connections at most: one writes, the others answer questions.
const CONNECTIONS: u32 = 4;
/// How long a question waits for a connection.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(5);
/// Rows of one statement.
const CHUNK: usize = 32;
/// Rows that one statement deletes at most: others get their turn between.
const TRIM_CHUNK: i64 = 2000;

/// Where the history is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A SQLite file.
    Sqlite(PathBuf),
    /// A PostgreSQL database, by its URL. It may hold a password.
    Postgres(String),
}

/// The history cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    /// The file cannot be made or opened.
    #[error("cannot open the history {path}: {reason}; choose another place with `[history] database`", path = path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// The URL is none. It is not repeated: it may hold a password.
    #[error("the history's URL is not usable: write postgres://USER@HOST/DATABASE")]
    Url,
    /// The database refused or cannot be reached.
    #[error("the history's database failed: {0}")]
    Database(#[from] sqlx::Error),
    /// What a newer version has made.
    #[error(
        "the history is of version {0}, this program knows {VERSION}: use the newer program, or another database"
    )]
    Newer(i64),
}

impl HistoryError {
    /// Whether the database refuses what was to be written, so that the same will be refused again.
    pub(super) fn is_refusal(&self) -> bool {
        match self {
            Self::Database(sqlx::Error::Encode(_)) => true,
            Self::Database(sqlx::Error::Database(error)) => {
                // Class 22 of SQLSTATE: data exception.
                let is_data = error.code().is_some_and(|code| code.len() == 5 && code.starts_with("22"));
                is_data || !matches!(error.kind(), ErrorKind::Other)
            }
            _ => false,
        }
    }
}

/// Version of the tables.
const VERSION: i64 = 1;

const TABLES: &str = "
CREATE TABLE IF NOT EXISTS gakp_history (version BIGINT NOT NULL);
CREATE TABLE IF NOT EXISTS tracks (
    camera TEXT NOT NULL, epoch BIGINT NOT NULL, id BIGINT NOT NULL,
    class TEXT NOT NULL, first_ns BIGINT NOT NULL, last_ns BIGINT NOT NULL, ended BIGINT NOT NULL,
    confidence DOUBLE PRECISION NOT NULL, width BIGINT NOT NULL, height BIGINT NOT NULL,
    last_frame BIGINT NOT NULL, x DOUBLE PRECISION NOT NULL, y DOUBLE PRECISION NOT NULL,
    w DOUBLE PRECISION NOT NULL, h DOUBLE PRECISION NOT NULL,
    PRIMARY KEY (camera, epoch, id));
CREATE INDEX IF NOT EXISTS tracks_first ON tracks (first_ns);
CREATE INDEX IF NOT EXISTS tracks_last ON tracks (last_ns);
CREATE TABLE IF NOT EXISTS track_boxes (
    camera TEXT NOT NULL, epoch BIGINT NOT NULL, id BIGINT NOT NULL, frame BIGINT NOT NULL,
    time_ns BIGINT NOT NULL, x DOUBLE PRECISION NOT NULL, y DOUBLE PRECISION NOT NULL,
    w DOUBLE PRECISION NOT NULL, h DOUBLE PRECISION NOT NULL, after_gap BIGINT NOT NULL,
    PRIMARY KEY (camera, epoch, id, frame),
    FOREIGN KEY (camera, epoch, id) REFERENCES tracks (camera, epoch, id) ON DELETE CASCADE);
CREATE TABLE IF NOT EXISTS snapshots (
    camera TEXT NOT NULL, epoch BIGINT NOT NULL, id BIGINT NOT NULL,
    score DOUBLE PRECISION NOT NULL, jpeg BLOB NOT NULL,
    PRIMARY KEY (camera, epoch, id),
    FOREIGN KEY (camera, epoch, id) REFERENCES tracks (camera, epoch, id) ON DELETE CASCADE);
CREATE TABLE IF NOT EXISTS events (
    id TEXT NOT NULL PRIMARY KEY, camera TEXT NOT NULL, type TEXT NOT NULL,
    line TEXT, zone TEXT, direction TEXT, dwell_s DOUBLE PRECISION,
    epoch BIGINT NOT NULL, track BIGINT, time_ns BIGINT NOT NULL, json TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS events_time ON events (time_ns);
CREATE INDEX IF NOT EXISTS events_camera ON events (camera, time_ns);
CREATE INDEX IF NOT EXISTS events_track ON events (camera, epoch, track);
UPDATE tracks SET ended = 1 WHERE ended = 0;
";

/// The database.
#[derive(Clone, Debug)]
pub struct Database {
    pool: AnyPool,
    is_sqlite: bool,
}

impl Database {
    /// Connects when it is first asked; makes a SQLite file that is not there, for its owner alone.
    ///
    /// # Errors
    /// The file cannot be made, or the URL is none.
    pub fn new(place: &Place) -> Result<Self, HistoryError> {
        sqlx::any::install_default_drivers();
        let (url, is_sqlite) = match place {
            Place::Sqlite(path) => (sqlite_url(path)?, true),
            Place::Postgres(url) => (url.clone(), false),
        };
        let options =
            url.parse::<AnyConnectOptions>().map_err(|_| HistoryError::Url)?.disable_statement_logging();
        let pool = AnyPoolOptions::new()
            .max_connections(CONNECTIONS)
            .acquire_timeout(ACQUIRE_TIMEOUT)
            .after_connect(move |connection, _| {
                Box::pin(async move {
                    if is_sqlite {
                        // In this order: the first is heeded only before anything is written.
                        for pragma in [
                            "auto_vacuum = INCREMENTAL",
                            "journal_mode = WAL",
                            "synchronous = FULL",
                            "busy_timeout = 10000",
                            "foreign_keys = ON",
                        ] {
                            connection.execute(AssertSqlSafe(format!("PRAGMA {pragma}"))).await?;
                        }
                    }
                    Ok(())
                })
            })
            .connect_lazy_with(options);
        Ok(Self { pool, is_sqlite })
    }

    /// Makes the tables if they are not there; tracks that a crash left open are over.
    ///
    /// # Errors
    /// [`HistoryError`].
    pub async fn prepare(&self) -> Result<(), HistoryError> {
        let mut transaction = self.pool.begin().await?;
        for statement in TABLES.split(';').map(str::trim).filter(|text| !text.is_empty()) {
            let statement =
                if self.is_sqlite { statement.to_owned() } else { statement.replace("BLOB", "BYTEA") };
            transaction.execute(AssertSqlSafe(statement)).await?;
        }
        let version =
            sqlx::query("SELECT version FROM gakp_history").fetch_optional(&mut *transaction).await?;
        match version.map(|row| row.try_get::<i64, _>(0)).transpose()? {
            Some(version) if version > VERSION => return Err(HistoryError::Newer(version)),
            Some(_) => {}
            None => {
                let insert = sqlx::query("INSERT INTO gakp_history (version) VALUES ($1)").bind(VERSION);
                insert.execute(&mut *transaction).await?;
            }
        }
        Ok(transaction.commit().await?)
    }

    /// Whether it answers. Changes nothing.
    ///
    /// # Errors
    /// The database's.
    pub async fn ping(&self) -> Result<(), HistoryError> {
        self.pool.execute("SELECT 1").await?;
        Ok(())
    }

    /// `sqlite` or `postgres`.
    pub fn name(&self) -> &'static str {
        if self.is_sqlite { "sqlite" } else { "postgres" }
    }

    pub(super) fn pool(&self) -> &AnyPool {
        &self.pool
    }

    /// Closes the connections; writes what SQLite has put off.
    pub async fn close(&self) {
        self.pool.close().await;
    }

    /// Writes a batch: all of it or nothing. `classes[i]` names class `i`.
    ///
    /// # Errors
    /// The database's.
    pub async fn write(&self, batch: &Batch, classes: &[String]) -> Result<(), HistoryError> {
        // PostgreSQL takes a row once a statement: the newest of each track.
        let tracks: BTreeMap<&TrackKey, &TrackRow> = batch.tracks.iter().map(|row| (&row.key, row)).collect();
        let tracks: Vec<_> = tracks.into_values().collect();
        let mut transaction = self.pool.begin().await?;
        insert(
            &mut transaction,
            "tracks (camera, epoch, id, class, first_ns, last_ns, ended, confidence, width, height, last_frame, x, y, w, h)",
            "ON CONFLICT (camera, epoch, id) DO UPDATE SET last_ns = excluded.last_ns, ended = excluded.ended, \
             confidence = excluded.confidence, last_frame = excluded.last_frame, \
             x = excluded.x, y = excluded.y, w = excluded.w, h = excluded.h",
            &tracks,
            |query, row| {
                let [x, y, w, h] = row.last.bbox;
                keyed(query, &row.key)
                    .bind(class_name(classes, row.class).into_owned())
                    .bind(row.first_ns)
                    .bind(row.last.unix_ns)
                    .bind(i64::from(row.ended))
                    .bind(row.confidence)
                    .bind(i64::from(row.size[0]))
                    .bind(i64::from(row.size[1]))
                    .bind(row.last.frame as i64)
                    .bind(x).bind(y).bind(w).bind(h)
            },
        )
        .await?;
        insert(
            &mut transaction,
            "track_boxes (camera, epoch, id, frame, time_ns, x, y, w, h, after_gap)",
            "ON CONFLICT DO NOTHING",
            &batch.boxes,
            |query, (key, at)| {
                let [x, y, w, h] = at.bbox;
                keyed(query, key)
                    .bind(at.frame as i64)
                    .bind(at.unix_ns)
                    .bind(x)
                    .bind(y)
                    .bind(w)
                    .bind(h)
                    .bind(i64::from(at.after_gap))
            },
        )
        .await?;
        insert(
            &mut transaction,
            "events (id, camera, type, line, zone, direction, dwell_s, epoch, track, time_ns, json)",
            "ON CONFLICT DO NOTHING",
            &batch.events,
            event,
        )
        .await?;
        Ok(transaction.commit().await?)
    }

    /// Keeps a track's snapshot in the place of the last one; `false` if there is no such track yet.
    ///
    /// # Errors
    /// The database's.
    pub async fn keep_snapshot(&self, snapshot: &Snapshot) -> Result<bool, HistoryError> {
        let blob = if self.is_sqlite { "BLOB" } else { "BYTEA" };
        let sql = format!(
            "INSERT INTO snapshots (camera, epoch, id, score, jpeg) \
             SELECT camera, epoch, id, CAST($4 AS DOUBLE PRECISION), CAST($5 AS {blob}) FROM tracks \
             WHERE camera = $1 AND epoch = $2 AND id = $3 \
             ON CONFLICT (camera, epoch, id) DO UPDATE SET score = excluded.score, jpeg = excluded.jpeg"
        );
        let query = keyed(sqlx::query(AssertSqlSafe(sql)), &snapshot.key);
        let done = query.bind(snapshot.score).bind(snapshot.jpeg.clone()).execute(&self.pool).await?;
        Ok(done.rows_affected() > 0)
    }

    /// A track's snapshot, JPEG.
    ///
    /// # Errors
    /// The database's.
    pub async fn snapshot(&self, key: &TrackKey) -> Result<Option<Vec<u8>>, HistoryError> {
        let sql = "SELECT jpeg FROM snapshots WHERE camera = $1 AND epoch = $2 AND id = $3";
        let row = keyed(sqlx::query(sql), key).fetch_optional(&self.pool).await?;
        Ok(row.map(|row| row.try_get(0)).transpose()?)
    }

    /// Bytes that rows take. For PostgreSQL, which does not give back what was deleted, an estimate from their number.
    ///
    /// # Errors
    /// The database's.
    pub async fn bytes(&self) -> Result<i64, HistoryError> {
        let sql = if self.is_sqlite {
            "SELECT (p.page_count - f.freelist_count) * s.page_size \
             FROM pragma_page_count() p, pragma_freelist_count() f, pragma_page_size() s"
        } else {
            // Rows of each with their share of the indices, as measured.
            "SELECT CAST((SELECT count(*) FROM tracks) * 350 + (SELECT count(*) FROM track_boxes) * 190 \
             + (SELECT coalesce(sum(length(json) + 350), 0) FROM events) \
             + (SELECT coalesce(sum(length(jpeg) + 100), 0) FROM snapshots) AS BIGINT)"
        };
        Ok(sqlx::query(sql).fetch_one(&self.pool).await?.try_get(0)?)
    }

    /// Forgets what ended before `before_ns`. Returns the rows of tracks and events that went.
    ///
    /// # Errors
    /// The database's.
    pub async fn forget_before(&self, before_ns: i64) -> Result<u64, HistoryError> {
        let mut gone = 0;
        for (table, time, key) in KEYS {
            let sql = format!(
                "DELETE FROM {table} WHERE ({key}) IN \
                 (SELECT {key} FROM {table} WHERE {time} < $1 ORDER BY {time} LIMIT {TRIM_CHUNK})"
            );
            loop {
                let query = sqlx::query(AssertSqlSafe(sql.clone())).bind(before_ns);
                let deleted = query.execute(&self.pool).await?.rows_affected();
                gone += deleted;
                if deleted < TRIM_CHUNK as u64 {
                    break;
                }
            }
        }
        if gone > 0 && self.is_sqlite {
            self.pool.execute("PRAGMA incremental_vacuum").await?;
        }
        Ok(gone)
    }

    /// The time before which `share` (of 1) of the tracks or of the events lie, whichever is earlier; `None`
    /// when there are none.
    ///
    /// # Errors
    /// The database's.
    pub async fn share_ends_at(&self, share: f64) -> Result<Option<i64>, HistoryError> {
        let mut cut = None;
        for (table, time, _) in KEYS {
            let count = format!("SELECT count(*) FROM {table}");
            let rows: i64 = sqlx::query(AssertSqlSafe(count)).fetch_one(&self.pool).await?.try_get(0)?;
            let skip = (rows as f64 * share).ceil() as i64;
            let sql = format!("SELECT {time} FROM {table} ORDER BY {time} LIMIT 1 OFFSET $1");
            let row = sqlx::query(AssertSqlSafe(sql))
                .bind(skip.min(rows - 1).max(0))
                .fetch_optional(&self.pool)
                .await?;
            let at = row.map(|row: AnyRow| row.try_get::<i64, _>(0)).transpose()?;
            cut = match (cut, at) {
                (Some(cut), Some(at)) => Some(at.min(cut)),
                (cut, at) => at.or(cut),
            };
        }
        Ok(cut)
    }
}

/// What is forgotten by time: table, time, key.
const KEYS: [(&str, &str, &str); 2] =
    [("tracks", "last_ns", "camera, epoch, id"), ("events", "time_ns", "id")];

type Bound<'q> = Query<'q, Any, AnyArguments>;

fn keyed<'q>(query: Bound<'q>, key: &TrackKey) -> Bound<'q> {
    query.bind(key.camera.as_str().to_owned()).bind(key.epoch.0 as i64).bind(key.id.0 as i64)
}

fn event<'q>(query: Bound<'q>, event: &Arc<NumberedEvent>) -> Bound<'q> {
    let (mut line, mut zone, mut direction, mut dwell) = (None, None, None, None);
    match &event.happening.what {
        What::Crossed { line: name, direction: way } => (line, direction) = (Some(name), Some(way.as_str())),
        What::Left { zone: name, dwell: seconds } | What::Loitering { zone: name, dwell: seconds } => {
            (zone, dwell) = (Some(name), Some(*seconds));
        }
        What::Entered { zone: name }
        | What::Crowded { zone: name, .. }
        | What::Cleared { zone: name, .. } => {
            zone = Some(name);
        }
    }
    query
        // The driver sends a NULL double as a single (sqlx issue 4284): a statement that it keeps would then refuse
        // every double.
        .persistent(false)
        .bind(event.id.clone())
        .bind(event.camera.as_str().to_owned())
        .bind(event.kind.to_owned())
        .bind(line.map(|name| name.as_str().to_owned()))
        .bind(zone.map(|name| name.as_str().to_owned()))
        .bind(direction.map(str::to_owned))
        .bind(dwell)
        .bind(event.epoch.0 as i64)
        .bind(event.happening.track.map(|(id, _)| id.0 as i64))
        .bind(event.unix_ns)
        .bind(String::from_utf8_lossy(&event.json).into_owned())
}

/// Inserts rows, many a statement: a database in the network answers each of them.
async fn insert<T>(
    connection: &mut AnyConnection,
    into: &str,
    conflict: &str,
    rows: &[T],
    bind: impl for<'q> Fn(Bound<'q>, &T) -> Bound<'q>,
) -> Result<(), sqlx::Error> {
    let columns = into.matches(',').count() + 1;
    let (chunks, rest) = rows.as_chunks::<CHUNK>();
    for rows in chunks.iter().map(|chunk| &chunk[..]).chain(rest.chunks(1)) {
        let places: Vec<String> = (0..rows.len())
            .map(|row| {
                let places: Vec<_> =
                    (1..=columns).map(|column| format!("${}", row * columns + column)).collect();
                format!("({})", places.join(", "))
            })
            .collect();
        let sql = format!("INSERT INTO {into} VALUES {} {conflict}", places.join(", "));
        let query = rows.iter().fold(sqlx::query(AssertSqlSafe(sql)), &bind);
        query.execute(&mut *connection).await?;
    }
    Ok(())
}

fn sqlite_url(path: &FilePath) -> Result<String, HistoryError> {
    let make = || -> io::Result<()> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        OpenOptions::new().create(true).append(true).mode(0o600).open(path).map(|_| ())
    };
    make().map_err(|reason| HistoryError::File { path: path.into(), reason })?;
    let text = path.to_str().ok_or_else(|| HistoryError::File {
        path: path.into(),
        reason: io::Error::new(io::ErrorKind::InvalidInput, "the path is no UTF-8"),
    })?;
    Ok(format!("sqlite:{}", text.replace('%', "%25").replace('?', "%3F").replace('#', "%23")))
}
