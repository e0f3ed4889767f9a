//! The cameras of a service: added and removed while it runs, remembered, shown to the API.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use futures::FutureExt;
use futures::future::BoxFuture;
use jiff::Timestamp;
use tokio::sync::watch;

use super::analyst::CameraAnalyst;
use super::camera::{Camera, CameraPlan, CameraState, CameraView, Lanes, MAX_CAMERAS, StartError};
use super::mailbox::Policy;
use super::outlet::LiveOutlet;
use super::store::{Remembered, Store};
use crate::analytics::{Heat, Mask, MaskStyle, Point, RuleId, Rules};
use crate::api::{
    self, CameraError, CameraPatch, CameraStatus, Cameras, EditError, Findings, NewCamera, RuleEdit,
    RulesSpec, TrackCounts,
};
use crate::ingest::{Pacing, SourceError, SourceSpec, Transport};
use crate::publish::{EventHub, Hub, Picture};
use crate::telemetry::{DropReason, Metrics};
use crate::track::TrackerConfig;
use crate::types::{CameraId, Epoch};

/// What a [`CameraSet`] is made of.
pub struct SetConfig {
    /// The shared stages.
    pub lanes: Lanes,
    /// Where tracks go.
    pub hub: Hub,
    /// Where what happens at lines and in zones goes.
    pub events: EventHub,
    /// What is measured.
    pub metrics: Arc<Metrics>,
    /// How to track.
    pub tracker: TrackerConfig,
    /// Where cameras are remembered, and what was; `None` forgets them.
    pub store: Option<(Store, Remembered)>,
    /// Most cameras at a time; at most [`MAX_CAMERAS`].
    pub limit: usize,
}

/// The cameras of a service.
pub struct CameraSet {
    lanes: Lanes,
    hub: Hub,
    events: EventHub,
    metrics: Arc<Metrics>,
    tracker: TrackerConfig,
    limit: usize,
    shown: Mutex<BTreeMap<CameraId, Shown>>,
    /// Serialises changes; readers need only `shown`.
    changes: tokio::sync::Mutex<Changes>,
}

/// What the API reads of a camera.
#[derive(Clone)]
struct Shown {
    url: String,
    view: Arc<CameraView>,
    video: watch::Receiver<Option<Arc<Picture>>>,
    analyst: Arc<CameraAnalyst>,
}

/// A camera and what it was made of.
struct Known {
    camera: NewCamera,
    /// `None` while it is paused.
    running: Option<Camera>,
}

struct Changes {
    cameras: BTreeMap<CameraId, Known>,
    store: Option<Store>,
    remembered: Remembered,
    stopping: bool,
}

impl Changes {
    fn begin_epoch(&mut self) -> Epoch {
        self.remembered.epoch = next_epoch(self.remembered.epoch);
        Epoch(self.remembered.epoch)
    }
}

impl CameraSet {
    /// An empty set. Cameras that are remembered start with [`CameraSet::start_remembered`].
    pub fn new(config: SetConfig) -> Arc<Self> {
        let SetConfig { lanes, hub, events, metrics, tracker, store, limit } = config;
        let (store, remembered) = store.map_or((None, Remembered::default()), |(s, r)| (Some(s), r));
        let changes = Changes { cameras: BTreeMap::new(), store, remembered, stopping: false };
        Arc::new(Self {
            lanes,
            hub,
            events,
            metrics,
            tracker,
            limit: limit.min(MAX_CAMERAS),
            shown: Mutex::default(),
            changes: tokio::sync::Mutex::new(changes),
        })
    }

    /// Starts a camera that the configuration names; it is not remembered, the configuration does that.
    ///
    /// # Errors
    /// As [`Cameras::add`].
    pub async fn start_configured(&self, camera: NewCamera) -> Result<CameraStatus, CameraError> {
        // What was changed at run time wins.
        let changed = self.remembered().await.into_iter().find(|c| c.id == camera.id);
        self.start(changed.unwrap_or(camera), false).await
    }

    /// Stops a camera that the configuration no longer names, or names otherwise. Its lines and zones stay
    /// remembered. `false` if it was changed at run time, which wins: it goes on.
    ///
    /// # Errors
    /// There is no such camera.
    pub async fn stop_configured(&self, id: &CameraId) -> Result<bool, CameraError> {
        let mut changes = self.changes.lock().await;
        if changes.remembered.cameras.iter().any(|camera| camera.id == *id) {
            return Ok(false);
        }
        self.end(&mut changes, id).await?;
        Ok(true)
    }

    /// Ends a camera; what is remembered of it stays.
    async fn end(&self, changes: &mut Changes, id: &CameraId) -> Result<(), CameraError> {
        let known = changes.cameras.remove(id).ok_or(CameraError::NotFound)?;
        let shown = self.shown().remove(id);
        if let Some(running) = known.running {
            running.stop().await;
        }
        if let Some(shown) = shown {
            shown.analyst.end();
        }
        self.metrics.forget_camera(id);
        Ok(())
    }

    async fn remembered(&self) -> Vec<NewCamera> {
        self.changes.lock().await.remembered.cameras.clone()
    }

    /// Starts the cameras that are remembered and do not run yet. One that cannot start is told and stays
    /// remembered.
    pub async fn start_remembered(&self) {
        for camera in self.remembered().await {
            if self.get(&camera.id).is_some() {
                continue;
            }
            let id = camera.id.clone();
            if let Err(error) = self.start(camera, false).await {
                tracing::error!(camera = %id, %error, "a remembered camera cannot start");
            }
        }
    }

    /// Stops every camera, then the shared stages.
    pub async fn shutdown(self: Arc<Self>) {
        let cameras = {
            let mut changes = self.changes.lock().await;
            changes.stopping = true;
            std::mem::take(&mut changes.cameras)
        };
        let running = cameras.into_values().filter_map(|known| known.running);
        futures::future::join_all(running.map(Camera::stop)).await;
        self.shown().clear();
        // Whoever still reads the set lets the stages end when it lets go.
        if let Some(set) = Arc::into_inner(self) {
            set.lanes.shutdown().await;
        }
    }

    async fn start(&self, camera: NewCamera, remember: bool) -> Result<CameraStatus, CameraError> {
        let spec = source_spec(&camera).map_err(|e| CameraError::Invalid(e.to_string()))?;
        let first_rules = camera.rules().map_err(EditError::from)?;
        let mut changes = self.changes.lock().await;
        if changes.stopping {
            return Err(CameraError::Invalid("the service is stopping".into()));
        }
        if changes.cameras.contains_key(&camera.id) {
            return Err(CameraError::Exists);
        }
        if changes.cameras.len() >= self.limit {
            return Err(CameraError::LimitReached(self.limit));
        }
        spec.check().map_err(|e| CameraError::Invalid(e.to_string()))?;
        let before = changes.remembered.clone();
        let epoch = changes.begin_epoch();
        if remember {
            changes.remembered.cameras.push(camera.clone());
        }
        // First on disk, so that what was accepted is never forgotten.
        self.save_or_restore(&mut changes, before)?;
        // What was changed at run time wins; it was checked when it was remembered, but by an older program perhaps.
        let changed = changes.remembered.rules.get(camera.id.as_str()).cloned();
        let rules = changed.map_or(Ok(first_rules), RulesSpec::rules).unwrap_or_else(|error| {
            tracing::error!(
                camera = %camera.id, %error,
                "its remembered lines, zones and masks cannot be used: its whole picture is hidden until its mask is removed"
            );
            hide_everything()
        });
        let analyst = CameraAnalyst::new(camera.id.clone(), rules, self.metrics.clone(), self.events.clone());
        match self.launch(&mut changes, camera.clone(), spec, epoch, Arc::new(analyst)).await {
            Ok(status) => Ok(status),
            Err(error) => {
                if let Some(shown) = self.shown().remove(&camera.id) {
                    shown.analyst.end();
                }
                changes.cameras.remove(&camera.id);
                self.metrics.forget_camera(&camera.id);
                if remember {
                    changes.remembered.cameras.retain(|c| c.id != camera.id);
                    self.save(&changes)?;
                }
                Err(error)
            }
        }
    }

    /// Opens a camera, unless it is paused, and shows it. One that cannot be opened is shown as paused.
    async fn launch(
        &self,
        changes: &mut Changes,
        camera: NewCamera,
        spec: SourceSpec,
        epoch: Epoch,
        analyst: Arc<CameraAnalyst>,
    ) -> Result<CameraStatus, CameraError> {
        let id = camera.id.clone();
        let url = spec.url.redacted().to_string();
        let (video, watched) = watch::channel(None);
        let started = if camera.paused {
            Ok(None)
        } else {
            let plan = CameraPlan {
                id: id.clone(),
                epoch,
                spec,
                tracker: self.tracker.clone(),
                outlet: Box::new(LiveOutlet { hub: self.hub.clone(), video, analyst: analyst.clone() }),
                policy: Policy::NewestWins,
            };
            Camera::start(&self.lanes, plan).await.map(Some)
        };
        let view = match &started {
            Ok(Some(running)) => running.view().clone(),
            Ok(None) | Err(_) => {
                let metrics = self.metrics.camera(&id);
                Arc::new(CameraView::new(id.clone(), epoch, metrics, CameraState::Paused))
            }
        };
        let paused = view.condition().state == CameraState::Paused;
        let shown = Shown { url, view, video: watched, analyst };
        let status = status(&shown);
        self.shown().insert(id.clone(), shown);
        if paused {
            self.metrics.pause_camera(&id);
        }
        let (running, failed) = match started {
            Ok(running) => (running, None),
            Err(StartError::Source(error)) => (None, Some(CameraError::Invalid(error.to_string()))),
            Err(StartError::Tracker(error)) => (None, Some(CameraError::Io(error.to_string()))),
        };
        changes.cameras.insert(id, Known { camera, running });
        failed.map_or(Ok(status), Err)
    }

    async fn change(&self, id: &CameraId, patch: CameraPatch) -> Result<CameraStatus, CameraError> {
        let mut changes = self.changes.lock().await;
        let Some(known) = changes.cameras.get(id) else { return Err(CameraError::NotFound) };
        let camera = patch.apply(&known.camera);
        if camera == known.camera {
            return self.get(id).ok_or(CameraError::NotFound);
        }
        let spec = source_spec(&camera).map_err(|e| CameraError::Invalid(e.to_string()))?;
        spec.check().map_err(|e| CameraError::Invalid(e.to_string()))?;
        let Some(analyst) = self.analyst(id) else { return Err(CameraError::NotFound) };
        let before = changes.remembered.clone();
        let epoch = changes.begin_epoch();
        // A camera of the configuration is remembered from now on, too: what was changed at run time wins.
        match changes.remembered.cameras.iter_mut().find(|c| c.id == *id) {
            Some(remembered) => *remembered = camera.clone(),
            None => changes.remembered.cameras.push(camera.clone()),
        }
        self.save_or_restore(&mut changes, before)?;
        if let Some(running) = changes.cameras.remove(id).and_then(|known| known.running) {
            running.stop().await;
        }
        analyst.begin_epoch();
        self.launch(&mut changes, camera, spec, epoch, analyst).await
    }

    async fn stop(&self, id: &CameraId) -> Result<(), CameraError> {
        let mut changes = self.changes.lock().await;
        if !changes.cameras.contains_key(id) {
            return Err(CameraError::NotFound);
        }
        let cameras = changes.remembered.cameras.len();
        changes.remembered.cameras.retain(|c| c.id != *id);
        let had_rules = changes.remembered.rules.remove(id.as_str()).is_some();
        let forgets = had_rules || changes.remembered.cameras.len() < cameras;
        // It ends whether or not that can be written.
        let saved = if forgets { self.save(&changes) } else { Ok(()) };
        self.end(&mut changes, id).await?;
        saved
    }

    async fn edit(&self, id: &CameraId, edit: RuleEdit) -> Result<Rules, CameraError> {
        // Held to the end: changes come one after the other, on disk as in the analyst.
        let mut changes = self.changes.lock().await;
        let Some(analyst) = self.analyst(id) else { return Err(CameraError::NotFound) };
        let rules = edit.apply(&analyst.rules())?;
        let before = changes.remembered.rules.insert(id.to_string(), RulesSpec::from(&rules));
        if let Err(error) = self.save(&changes) {
            match before {
                Some(before) => changes.remembered.rules.insert(id.to_string(), before),
                None => changes.remembered.rules.remove(id.as_str()),
            };
            return Err(error);
        }
        analyst.set_rules(rules.clone());
        Ok(rules)
    }

    fn analyst(&self, id: &CameraId) -> Option<Arc<CameraAnalyst>> {
        self.shown().get(id).map(|shown| shown.analyst.clone())
    }

    /// Writes what is to be remembered; where that fails, it is again what it was `before`.
    fn save_or_restore(&self, changes: &mut Changes, before: Remembered) -> Result<(), CameraError> {
        let saved = self.save(changes);
        if saved.is_err() {
            changes.remembered = before;
        }
        saved
    }

    fn save(&self, changes: &Changes) -> Result<(), CameraError> {
        match &changes.store {
            Some(store) => store.save(&changes.remembered).map_err(|e| CameraError::Io(e.to_string())),
            None => Ok(()),
        }
    }

    fn shown(&self) -> MutexGuard<'_, BTreeMap<CameraId, Shown>> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Cameras for CameraSet {
    fn list(&self) -> Vec<CameraStatus> {
        self.shown().values().map(status).collect()
    }

    fn get(&self, id: &CameraId) -> Option<CameraStatus> {
        self.shown().get(id).map(status)
    }

    fn add(&self, request: NewCamera) -> BoxFuture<'_, Result<CameraStatus, CameraError>> {
        self.start(request, true).boxed()
    }

    fn patch(&self, id: &CameraId, patch: CameraPatch) -> BoxFuture<'_, Result<CameraStatus, CameraError>> {
        let id = id.clone();
        async move { self.change(&id, patch).await }.boxed()
    }

    fn remove(&self, id: &CameraId) -> BoxFuture<'_, Result<(), CameraError>> {
        let id = id.clone();
        async move { self.stop(&id).await }.boxed()
    }

    fn video(&self, id: &CameraId) -> Option<watch::Receiver<Option<Arc<Picture>>>> {
        self.shown().get(id).map(|shown| shown.video.clone())
    }

    fn rules(&self, id: &CameraId) -> Option<Rules> {
        self.analyst(id).map(|analyst| analyst.rules())
    }

    fn edit_rules(&self, id: &CameraId, edit: RuleEdit) -> BoxFuture<'_, Result<Rules, CameraError>> {
        let id = id.clone();
        async move { self.edit(&id, edit).await }.boxed()
    }

    fn findings(&self, id: &CameraId) -> Option<Findings> {
        self.analyst(id).map(|analyst| Findings { since: analyst.since(), counts: analyst.counts() })
    }

    fn heat(&self, id: &CameraId) -> Option<(Timestamp, Heat)> {
        self.analyst(id).map(|analyst| (analyst.since(), analyst.heat()))
    }
}

/// What was to be hidden is not known.
fn hide_everything() -> Rules {
    let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
    let points = corners.map(|(x, y)| Point { x, y }).to_vec();
    let id = RuleId::new("unknown").into_iter();
    let masks = id.map(|id| Mask { id, points: points.clone(), style: MaskStyle::Fill }).collect();
    Rules { masks, ..Rules::default() }
}

/// A camera's source as the service plays it: files in real time.
///
/// # Errors
/// The address is wrong; the message never holds a password.
pub fn source_spec(camera: &NewCamera) -> Result<SourceSpec, SourceError> {
    let mut spec = SourceSpec::parse(&camera.url)?;
    spec.transport = match camera.transport {
        None => Transport::Auto,
        Some(api::Transport::Tcp) => Transport::Tcp,
        Some(api::Transport::Udp) => Transport::Udp,
    };
    spec.looped = camera.looped;
    spec.pacing = Pacing::Realtime;
    Ok(spec)
}

/// Later than `last`, and than every epoch of a run whose state was lost: seconds since 1970.
fn next_epoch(last: u64) -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    now.max(last + 1)
}

fn status(shown: &Shown) -> CameraStatus {
    let Shown { url, view, .. } = shown;
    let condition = view.condition();
    let metrics = &view.metrics;
    let [tentative, confirmed, lost] =
        std::array::from_fn(|i| u64::try_from(metrics.tracks[i].get()).unwrap_or(0));
    let dropped = DropReason::ALL
        .into_iter()
        .map(|reason| (reason.as_str().to_string(), metrics.dropped[reason as usize].get()));
    CameraStatus {
        id: view.id.clone(),
        url: url.clone(),
        state: match condition.state {
            CameraState::Connecting => api::CameraState::Connecting,
            CameraState::Live => api::CameraState::Live,
            CameraState::Retrying => api::CameraState::Retrying,
            CameraState::Ended => api::CameraState::Ended,
            CameraState::Failed => api::CameraState::Failed,
            CameraState::Paused => api::CameraState::Paused,
        },
        since: Timestamp::try_from(condition.since).unwrap_or(Timestamp::UNIX_EPOCH),
        last_error_kind: condition.last_failure.as_ref().map(|f| f.label().to_string()),
        last_error: condition.last_failure.map(|f| f.to_string()),
        next_retry_s: condition
            .next_retry
            .map(|at| at.saturating_duration_since(Instant::now()).as_secs_f64()),
        reconnects: metrics.reconnects.get(),
        epoch: view.epoch.0,
        width: condition.size.map(|s| s.0),
        height: condition.size.map(|s| s.1),
        fps: condition.fps,
        frames_in: metrics.frames_in.get(),
        tracked: metrics.tracked.get(),
        dropped: dropped.collect::<BTreeMap<_, _>>(),
        tracks: TrackCounts { tentative, confirmed, lost },
    }
}
