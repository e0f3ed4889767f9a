//! One camera: its source, its stages, what is known of it.

use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinHandle;

use super::detect::{self, Captured};
use super::outlet::Outlet;
use super::tracker::{TrackerGone, TrackerThread};
use super::turns::Turns;
use super::{Mailbox, Policy, Ticket, embed, link};
use crate::infer::Models;
use crate::ingest::{self, Failure, Opened, RawFrame, SourceError, SourceEvent, SourceHandle, SourceSpec};
use crate::telemetry::{CameraMetrics, DropReason, Metrics};
use crate::traces::{Step, Traces};
use crate::track::TrackerConfig;
use crate::types::{CameraId, Epoch, Frame};

/// Cameras that one service takes: the link stage's queue holds one job each.
pub const MAX_CAMERAS: usize = 1024;

/// Frames of a file that are decoded ahead.
const AHEAD: usize = 8;

/// Frames of a live camera behind the detector: one being embedded, one being tracked. More would grow old there.
const BEYOND: usize = 2;

/// Detections of a camera that may wait to be embedded.
const DETECTED: usize = 2;

/// What all cameras share: the models, the link stage, the tracker's thread.
pub struct Lanes {
    models: Models,
    metrics: Arc<Metrics>,
    tracker: TrackerThread,
    link: Option<JoinHandle<()>>,
    traces: Option<Traces>,
    turns: Turns,
}

impl Lanes {
    /// Starts the shared stages, sink first. Needs a tokio runtime. Models without a link scorer suit
    /// cameras whose association asks none ([`crate::track::Association::asks_scorer`]).
    pub fn start(models: Models, metrics: Arc<Metrics>) -> std::io::Result<Self> {
        let (jobs, job_queue) = mpsc::channel(MAX_CAMERAS);
        let (tracker, answers) = TrackerThread::start(jobs, metrics.clone())?;
        // Without a scorer (an association that asks none) there is nobody to send jobs to, and none are.
        let stage = |linker| tokio::spawn(link::run(job_queue, linker, answers.downgrade()));
        let link = models.linker.clone().map(stage);
        let turns = Turns::new(models.detector.arrangement());
        Ok(Self { models, metrics, tracker, link, traces: None, turns })
    }

    /// With traces of the cameras' frames.
    pub fn traced(self, traces: Option<Traces>) -> Self {
        Self { traces, ..self }
    }

    /// The models.
    pub fn models(&self) -> &Models {
        &self.models
    }

    /// Ends the shared stages; every camera must have been stopped.
    pub async fn shutdown(self) {
        let Self { models, tracker, link, .. } = self;
        // Joining blocks: the thread ends once nobody can send to it.
        if tokio::task::spawn_blocking(move || tracker.join()).await.is_err() {
            tracing::error!("joining the tracker's thread failed");
        }
        if let Some(link) = link
            && link.await.is_err()
        {
            tracing::error!("the link stage panicked");
        }
        if tokio::task::spawn_blocking(move || models.shutdown()).await.is_err() {
            tracing::error!("ending the models failed");
        }
    }
}

/// What a camera is made of.
pub struct CameraPlan {
    /// Its name.
    pub id: CameraId,
    /// The generation of its track ids.
    pub epoch: Epoch,
    /// What to open.
    pub spec: SourceSpec,
    /// How to track.
    pub tracker: TrackerConfig,
    /// Where its tracks go.
    pub outlet: Box<dyn Outlet>,
    /// What a full mailbox does.
    pub policy: Policy,
}

/// Why a camera could not be started.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// Its source cannot work.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The service stops.
    #[error(transparent)]
    Tracker(#[from] TrackerGone),
}

/// What a camera is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraState {
    /// First connection under way.
    Connecting,
    /// Frames arrive.
    Live,
    /// Lost or refused; the next attempt is planned.
    Retrying,
    /// A file played to its end.
    Ended,
    /// Gave up for good.
    Failed,
    /// Nobody wants it now.
    Paused,
}

/// What is known of a camera, shared with whoever asks.
pub struct CameraView {
    /// Its name.
    pub id: CameraId,
    /// The generation of its track ids.
    pub epoch: Epoch,
    /// Its account.
    pub metrics: Arc<CameraMetrics>,
    state: Mutex<Condition>,
}

/// A camera's condition at one moment.
#[derive(Clone, Debug)]
pub struct Condition {
    /// What it is doing.
    pub state: CameraState,
    /// Since when.
    pub since: SystemTime,
    /// What last went wrong.
    pub last_failure: Option<Failure>,
    /// When the next attempt comes, while retrying.
    pub next_retry: Option<Instant>,
    /// What the connection turned out to be.
    pub opened: Option<Opened>,
    /// Size of the last frame, pixels.
    pub size: Option<(u32, u32)>,
    /// Frames per second, running mean.
    pub fps: Option<f64>,
}

impl CameraView {
    /// Of a camera that has just begun to be in `state`.
    pub fn new(id: CameraId, epoch: Epoch, metrics: Arc<CameraMetrics>, state: CameraState) -> Self {
        let condition = Condition {
            state,
            since: SystemTime::now(),
            last_failure: None,
            next_retry: None,
            opened: None,
            size: None,
            fps: None,
        };
        Self { id, epoch, metrics, state: Mutex::new(condition) }
    }

    /// Its condition now.
    pub fn condition(&self) -> Condition {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// It cannot go on.
    fn broken(&self, why: &str) {
        tracing::error!(camera = %self.id, "{why}");
        self.change(|condition| {
            condition.state = CameraState::Failed;
            condition.last_failure = Some(Failure::Other(why.to_owned()));
            condition.next_retry = None;
            condition.fps = None;
        });
    }

    fn change(&self, change: impl FnOnce(&mut Condition)) {
        let mut condition = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let before = condition.state;
        change(&mut condition);
        if condition.state != before {
            condition.since = SystemTime::now();
        }
        self.metrics.up.set(i64::from(condition.state == CameraState::Live));
    }
}

/// A running camera.
pub struct Camera {
    view: Arc<CameraView>,
    source: SourceHandle,
    mailbox: Arc<Mailbox<Captured>>,
    flow: JoinHandle<()>,
}

impl Camera {
    /// Starts a camera, sink first.
    pub async fn start(lanes: &Lanes, plan: CameraPlan) -> Result<Self, StartError> {
        let CameraPlan { id, epoch, spec, tracker, outlet, policy } = plan;
        spec.check()?;
        let metrics = lanes.metrics.camera(&id);
        let view = CameraView::new(id.clone(), epoch, metrics.clone(), CameraState::Connecting);
        let view = Arc::new(view);
        let seat = lanes.tracker.attach(id.clone(), epoch, tracker, outlet, metrics).await?;
        let capacity = if policy == Policy::Wait { AHEAD } else { 1 };
        let mailbox = Arc::new(Mailbox::new(capacity, policy, lanes.metrics.queue("frames")));
        let (to_embed, detected) = mpsc::channel(DETECTED);
        // Live, a frame more than the workers take would only grow old. Offline, one waits for each
        // worker, so that none is idle between two frames.
        let workers = lanes.models.detector.arrangement().workers;
        let (in_flight, turns, places) = match policy {
            Policy::Wait => (2 * workers, None, 4 * (workers + BEYOND)),
            Policy::NewestWins => (workers, Some(lanes.turns.clone()), workers + BEYOND),
        };
        let embed = embed::run(
            detected,
            lanes.models.embedder.clone(),
            in_flight,
            seat.clone(),
            lanes.metrics.clone(),
        );
        let detector = lanes.models.detector.clone();
        let share = detect::Share { in_flight, places: Arc::new(Semaphore::new(places)), turns };
        let detect = detect::run(mailbox.clone(), detector, share, to_embed, lanes.metrics.clone());
        let (its, frames) = (view.clone(), mailbox.clone());
        let flow = tokio::spawn(async move {
            // Two tasks, so that a slow camera's stages still overlap.
            let (embed, detect) = (tokio::spawn(embed), tokio::spawn(detect));
            for stage in [detect, embed] {
                if stage.await.is_err() {
                    its.broken("a stage of it panicked: remove the camera and add it again");
                    // Its source ends.
                    frames.close();
                }
            }
            seat.leave().await;
        });
        let sink = Sink {
            view: view.clone(),
            mailbox: mailbox.clone(),
            all: lanes.metrics.clone(),
            traces: lanes.traces.clone(),
            index: 0,
            last_decoded: None,
            opened_before: false,
            lost: false,
        };
        let source = match ingest::start(&id, spec, sink.into_fn()) {
            Ok(source) => source,
            Err(error) => {
                mailbox.close();
                // Nothing came in, so there is nothing to lose.
                let _ = flow.await;
                return Err(error.into());
            }
        };
        Ok(Self { view, source, mailbox, flow })
    }

    /// What is known of it.
    pub fn view(&self) -> &Arc<CameraView> {
        &self.view
    }

    /// Waits until its source has ended by itself and every frame is done.
    pub async fn finished(&mut self) {
        if (&mut self.flow).await.is_err() {
            tracing::error!(camera = %self.view.id, "the camera's flow panicked");
        }
    }

    /// Stops it: no frame comes in any more, those in flight are finished, the account is settled.
    pub async fn stop(self) {
        let Self { view, source, mailbox, flow } = self;
        mailbox.close();
        if tokio::task::spawn_blocking(move || source.stop()).await.is_err() {
            tracing::error!(camera = %view.id, "stopping the source failed");
        }
        if !flow.is_finished() && flow.await.is_err() {
            tracing::error!(camera = %view.id, "the camera's flow panicked");
        }
        view.metrics.up.set(0);
    }
}

/// What the source's thread calls.
struct Sink {
    view: Arc<CameraView>,
    mailbox: Arc<Mailbox<Captured>>,
    all: Arc<Metrics>,
    traces: Option<Traces>,
    index: u64,
    last_decoded: Option<Instant>,
    opened_before: bool,
    /// Since it was last opened. A file that begins again is opened anew without having been lost.
    lost: bool,
}

impl Sink {
    fn into_fn(mut self) -> impl FnMut(SourceEvent) -> ControlFlow<()> + Send + 'static {
        move |event| self.take(event)
    }

    fn take(&mut self, event: SourceEvent) -> ControlFlow<()> {
        let id = &self.view.id;
        match event {
            SourceEvent::Opened(opened) => {
                let lost = std::mem::replace(&mut self.lost, false);
                if std::mem::replace(&mut self.opened_before, true) && lost {
                    self.view.metrics.reconnects.inc();
                }
                self.last_decoded = None;
                self.view.change(|c| {
                    c.state = CameraState::Live;
                    c.size = Some((opened.width, opened.height));
                    c.next_retry = None;
                    c.fps = opened.fps;
                    c.opened = Some(opened);
                });
            }
            SourceEvent::Frame(raw) => return self.frame(raw),
            SourceEvent::Corrupt => {
                self.ticket(None, Instant::now()).dropped(DropReason::Corrupt);
            }
            SourceEvent::Skipped { frames } => {
                for _ in 0..frames {
                    self.ticket(None, Instant::now()).dropped(DropReason::Undecoded);
                }
            }
            SourceEvent::Lost { reason, retry_in } => {
                self.lost = true;
                self.all.camera_failed(id, reason.label());
                self.view.change(|c| {
                    c.state = if retry_in.is_some() { CameraState::Retrying } else { CameraState::Failed };
                    c.last_failure = Some(reason);
                    c.next_retry = retry_in.map(|wait| Instant::now() + wait);
                    c.fps = None;
                });
                if retry_in.is_none() {
                    self.mailbox.close();
                }
            }
            SourceEvent::Ended => {
                self.view.change(|c| {
                    c.state = CameraState::Ended;
                    c.fps = None;
                });
                self.mailbox.close();
            }
        }
        ControlFlow::Continue(())
    }

    /// Counts a frame in.
    fn ticket(&self, index: Option<u64>, began: Instant) -> Ticket {
        let CameraView { id, epoch, metrics, .. } = &*self.view;
        let trace = self.traces.as_ref().and_then(|traces| traces.frame(id, *epoch, index, began));
        Ticket::new(metrics.clone(), trace)
    }

    fn frame(&mut self, raw: RawFrame) -> ControlFlow<()> {
        let RawFrame { image, time, capture, decoded } = raw;
        let size = (image.width, image.height);
        let interval = self.last_decoded.replace(decoded).map(|last| decoded.duration_since(last));
        self.view.change(|c| {
            c.size = Some(size);
            c.fps = smoothed_fps(c.fps, interval);
        });
        let frame = Frame {
            camera: self.view.id.clone(),
            epoch: self.view.epoch,
            index: self.index,
            time,
            capture,
            decoded,
            image,
        };
        let ticket = self.ticket(Some(self.index), decoded);
        self.index += 1;
        match self.mailbox.put(Captured { frame: Arc::new(frame), ticket }) {
            Ok(None) => ControlFlow::Continue(()),
            Ok(Some(Captured { frame, mut ticket })) => {
                ticket.step(Step::Wait, frame.decoded);
                ticket.dropped(DropReason::Overload);
                ControlFlow::Continue(())
            }
            // Closed: the ticket settles itself as stopped.
            Err(_) => ControlFlow::Break(()),
        }
    }
}

/// Running mean of the frame interval, as frames per second.
fn smoothed_fps(fps: Option<f64>, interval: Option<Duration>) -> Option<f64> {
    let Some(interval) = interval.map(|i| i.as_secs_f64()).filter(|i| *i > 0.0) else { return fps };
    let mean = match fps {
        Some(fps) if fps > 0.0 => 0.95 / fps + 0.05 * interval,
        _ => interval,
    };
    Some(1.0 / mean)
}
