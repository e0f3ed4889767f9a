//! What was: finished tracks and events, in SQLite or PostgreSQL.
//!
//! ```text
//! Hub, EventHub --collector--> Recorder (memory) --every second--> Database (one transaction)
//!                                                                      ^ questions of the API
//! ```
//!
//! The tracker never waits for the disk: the collector is a subscriber like any other, and a database that is slow
//! or away costs memory up to 200,000 rows, then the oldest of them, counted. Live tracks are written every
//! second as well, so a crash loses at most the last second.

mod album;
mod database;
mod metrics;
mod path;
mod query;
mod recorder;

use std::mem::take;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

pub use album::{Album, Pictures, Snapshot};
pub use database::{Database, HistoryError, Place};
pub use metrics::HistoryMetrics;
pub use path::{KeyBox, at};
pub use query::{Bucket, Cursor, PastEvent, PastTrack, Totals, Wanted};
pub use recorder::{Batch, Recorder, TrackKey, TrackRow};

use crate::publish::{Event, EventFilter, EventHub, EventListener, Heard, Hub, Only, Subscription};

/// How often what is new is written.
const EVERY: Duration = Duration::from_secs(1);
/// How often what is too old or too much is forgotten.
const TRIM_EVERY: Duration = Duration::from_secs(60);
/// Rows that wait for the database at most: some 100 MB.
const MAX_PENDING: usize = 200_000;
/// How long the last write may take when the service ends.
const FAREWELL: Duration = Duration::from_secs(5);
/// A database that stays away is told of this often.
const TELL_EVERY: Duration = Duration::from_secs(60);

/// Where it is kept and for how long.
#[derive(Clone)]
pub struct HistorySettings {
    /// Where.
    pub place: Place,
    /// What is older goes; `None` keeps it.
    pub keep: Option<Duration>,
    /// Where snapshots of tracks come from; `None` keeps no picture.
    pub pictures: Option<Pictures>,
    /// Bytes of rows; the oldest of what is more go. `None`: as many as the disk holds.
    pub max_bytes: Option<i64>,
}

impl HistorySettings {
    /// A SQLite file in a state folder, 30 days, 2 GB.
    pub fn in_folder(folder: &std::path::Path) -> Self {
        Self {
            place: Place::Sqlite(Self::file_in(folder)),
            pictures: None,
            keep: Some(Duration::from_secs(30 * 86_400)),
            max_bytes: Some(2_000_000_000),
        }
    }

    /// The file in a state folder.
    pub fn file_in(folder: &std::path::Path) -> PathBuf {
        folder.join("history.sqlite")
    }
}

/// The history: writes what is published, answers questions.
pub struct History {
    database: Database,
    metrics: HistoryMetrics,
    end: Arc<Notify>,
    writer: JoinHandle<()>,
    collector: JoinHandle<()>,
}

impl History {
    /// Opens it and begins to record. A PostgreSQL server that cannot be reached now is waited for.
    ///
    /// # Errors
    /// [`HistoryError`]: a SQLite file that cannot be used, a URL that is none, tables of a newer version.
    pub async fn start(
        settings: HistorySettings,
        hub: &Hub,
        events: &EventHub,
        metrics: HistoryMetrics,
    ) -> Result<Self, HistoryError> {
        let database = Database::new(&settings.place)?;
        let prepared = match (database.prepare().await, &settings.place) {
            (Ok(()), _) => true,
            (Err(HistoryError::Database(error)), Place::Postgres(_)) => {
                tracing::warn!("the history's database cannot be used yet, it is tried again: {error}");
                false
            }
            (Err(error), _) => return Err(error),
        };
        let shared = Arc::new(Mutex::new(Recorder::default()));
        let (tracks, events) = (hub.subscribe(Only::All), events.listen(EventFilter::default()));
        let collector = tokio::spawn(collect(tracks, events, shared.clone(), metrics.clone()));
        let end = Arc::new(Notify::new());
        let writer = Writer {
            database: database.clone(),
            settings,
            metrics: metrics.clone(),
            recorder: shared,
            classes: hub.classes().clone(),
            pending: Batch::default(),
            album: Album::default(),
            prepared,
            told: None,
        };
        let writer = tokio::spawn(writer.run(end.clone()));
        Ok(Self { database, metrics, end, writer, collector })
    }

    /// What answers questions.
    pub fn database(&self) -> &Database {
        &self.database
    }

    /// Its figures.
    pub fn metrics(&self) -> &HistoryMetrics {
        &self.metrics
    }

    /// Writes what is left and closes it. Call it once the hub is closed.
    pub async fn stop(self) {
        let _ = timeout(FAREWELL, self.collector).await;
        self.end.notify_one();
        if timeout(FAREWELL, self.writer).await.is_err() {
            tracing::warn!("the history's database took too long; its last seconds are lost");
        }
        let _ = timeout(FAREWELL, self.database.close()).await;
    }
}

fn lock(recorder: &Mutex<Recorder>) -> MutexGuard<'_, Recorder> {
    recorder.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Takes what is published as it comes, so that no ring overflows while the database works.
async fn collect(
    mut tracks: Subscription,
    mut events: EventListener,
    recorder: Arc<Mutex<Recorder>>,
    metrics: HistoryMetrics,
) {
    let mut happens = true;
    loop {
        tokio::select! {
            // First, or an event of the last frame could be lost with the hub.
            biased;
            event = events.next(), if happens => match event {
                Some(Heard::Event(event)) => lock(&recorder).event(event),
                Some(Heard::Missed(missed)) => metrics.missed_events.inc_by(missed),
                None => happens = false,
            },
            event = tracks.next() => match event {
                Some(Event::Tracks(report)) => lock(&recorder).frame(&report.tracks),
                Some(Event::Gap(gap)) => metrics.missed_reports.inc_by(1 + gap.last - gap.first),
                None => return,
            },
        }
    }
}

struct Writer {
    database: Database,
    settings: HistorySettings,
    metrics: HistoryMetrics,
    recorder: Arc<Mutex<Recorder>>,
    classes: Arc<[String]>,
    album: Album,
    /// What the database has not taken yet.
    pending: Batch,
    prepared: bool,
    /// When the database's failure was told last.
    told: Option<Instant>,
}

impl Writer {
    async fn run(mut self, end: Arc<Notify>) {
        let (mut write, mut trim) = (interval(EVERY), interval(TRIM_EVERY));
        write.set_missed_tick_behavior(MissedTickBehavior::Delay);
        trim.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                biased;
                () = end.notified() => break,
                _ = write.tick() => {
                    let batch = lock(&self.recorder).take();
                    self.write(batch).await;
                    self.take_pictures().await;
                }
                _ = trim.tick() => {
                    if let Err(error) = self.trim().await {
                        self.failed(&error);
                    }
                }
            }
        }
        let mut batch = lock(&self.recorder).take();
        batch.append(lock(&self.recorder).finish());
        self.write(batch).await;
    }

    async fn write(&mut self, batch: Batch) {
        self.pending.append(batch);
        if self.pending.len() > MAX_PENDING {
            self.metrics.dropped.inc_by(self.pending.len() as u64);
            tracing::error!(
                "{} rows of the history are lost: its database does not take them",
                self.pending.len()
            );
            self.pending = Batch::default();
        }
        if self.pending.is_empty() && self.prepared {
            return;
        }
        let written = async {
            if !self.prepared {
                self.database.prepare().await?;
                self.prepared = true;
            }
            self.database.write(&self.pending, &self.classes).await
        }
        .await;
        match written {
            Ok(()) => {
                self.metrics.written.inc_by(self.pending.len() as u64);
                self.pending = Batch::default();
                self.works();
            }
            Err(error) if error.is_refusal() => self.write_singly().await,
            Err(error) => self.failed(&error),
        }
        self.metrics.pending.set(self.pending.len() as i64);
    }

    /// One row that the database refuses must not keep the others out.
    async fn write_singly(&mut self) {
        let mut rows = take(&mut self.pending).into_rows();
        let (mut refused, mut why) = (0, None);
        while let Some(row) = rows.next() {
            match self.database.write(&row, &self.classes).await {
                Ok(()) => self.metrics.written.inc(),
                Err(error) if error.is_refusal() => (refused, why) = (refused + 1, Some(error)),
                Err(error) => {
                    self.pending.append(row);
                    rows.for_each(|row| self.pending.append(row));
                    self.failed(&error);
                    break;
                }
            }
        }
        if let Some(why) = why {
            self.metrics.dropped.inc_by(refused);
            tracing::error!("{refused} rows of the history are lost: its database refuses them: {why}");
        }
        if self.pending.is_empty() {
            self.works();
        }
    }

    fn works(&mut self) {
        self.metrics.up.set(1);
        if self.told.take().is_some() {
            tracing::info!("the history's database is there again");
        }
    }

    /// After the tracks: a picture goes with its track.
    async fn take_pictures(&mut self) {
        let Some(pictures) = &self.settings.pictures else { return };
        if !self.pending.is_empty() {
            return;
        }
        for snapshot in self.album.look(pictures).await {
            match self.database.keep_snapshot(&snapshot).await {
                Ok(true) => self.album.kept(&snapshot),
                // Its track is written a second later; so is the picture.
                Ok(false) => {}
                Err(error) => return self.failed(&error),
            }
        }
    }

    fn failed(&mut self, error: &HistoryError) {
        self.metrics.up.set(0);
        self.metrics.failures.inc();
        if self.told.is_none_or(|told| told.elapsed() > TELL_EVERY) {
            self.told = Some(Instant::now());
            tracing::warn!("the history is not written now, it is tried again every second: {error}");
        }
    }

    /// Forgets what is too old, and the oldest of what is too much.
    async fn trim(&self) -> Result<(), HistoryError> {
        if !self.prepared {
            return Ok(());
        }
        if let Some(keep) = self.settings.keep {
            let before = Timestamp::now().as_nanosecond() - keep.as_nanos() as i128;
            self.database.forget_before(i64::try_from(before).unwrap_or(i64::MIN)).await?;
        }
        let bytes = self.database.bytes().await?;
        self.metrics.bytes.set(bytes);
        let Some(most) = self.settings.max_bytes.filter(|most| bytes > *most) else { return Ok(()) };
        // A little more than is too much, so that it is not done every minute.
        let share = ((bytes - most) as f64 / bytes as f64 + 0.05).min(1.0);
        if let Some(before) = self.database.share_ends_at(share).await? {
            let gone = self.database.forget_before(before).await?;
            tracing::info!(
                "the history had {bytes} bytes, {most} are allowed: {gone} of its oldest rows were deleted"
            );
        }
        Ok(())
    }
}
