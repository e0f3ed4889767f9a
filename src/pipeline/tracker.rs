//! The one thread that owns every camera's tracker.
//!
//! It takes frames in each camera's order, asks the link stage for scores, and goes on with other
//! cameras meanwhile. Nobody else ever sees a tracker.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use tokio::sync::{mpsc, oneshot};

use super::embed::Embedded;
use super::link::LinkJob;
use super::outlet::Outlet;
use crate::egomotion::Egomotion;
use crate::infer::InferError;
use crate::telemetry::{CameraMetrics, DropReason, Metrics, Stage};
use crate::traces::Step;
use crate::track::shift::Shift;
use crate::track::{FrameInput, LinkRequest, Tracker, TrackerConfig, Update};
use crate::types::{CameraId, Clock, Epoch, FrameTracks, TrackState};

/// A camera's place at the tracker; never used again, so that a late message finds nobody.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Slot(u64);

/// What the tracker's thread is told.
pub enum ToTracker {
    /// A camera joins.
    Attach(Box<NewSeat>),
    /// A frame of a camera.
    Frame(Slot, Embedded),
    /// The scores of the camera's frame in hand.
    Links {
        /// Whose.
        slot: Slot,
        /// One probability a pair.
        links: Result<Vec<f32>, InferError>,
    },
    /// A camera leaves; its outlet is closed once its frames are done.
    Detach(Slot, oneshot::Sender<()>),
}

/// A camera that joins.
pub struct NewSeat {
    slot: Slot,
    camera: CameraId,
    epoch: Epoch,
    config: TrackerConfig,
    outlet: Box<dyn Outlet>,
    metrics: Arc<CameraMetrics>,
}

/// The thread is gone: the service stops.
#[derive(Debug, thiserror::Error)]
#[error("the tracker's thread has ended")]
pub struct TrackerGone;

/// The tracker's thread and the way to it.
pub struct TrackerThread {
    inbox: mpsc::Sender<ToTracker>,
    next_slot: std::sync::atomic::AtomicU64,
    thread: Option<thread::JoinHandle<()>>,
}

/// A camera's handle to its place at the tracker.
#[derive(Clone)]
pub struct Seat {
    slot: Slot,
    inbox: mpsc::Sender<ToTracker>,
}

/// Messages that may wait for the tracker, all cameras together; stages wait beyond it.
const INBOX: usize = 256;

impl TrackerThread {
    /// Starts the thread. `jobs` takes the pairs to be scored and must hold one a camera.
    pub fn start(
        jobs: mpsc::Sender<LinkJob>,
        metrics: Arc<Metrics>,
    ) -> std::io::Result<(Self, mpsc::Sender<ToTracker>)> {
        let (inbox, messages) = mpsc::channel(INBOX);
        let worker = Worker {
            seats: BTreeMap::new(),
            jobs,
            track: metrics.stage(Stage::Track),
            link: metrics.stage(Stage::Link),
        };
        let thread = thread::Builder::new().name("tracker".into()).spawn(move || worker.run(messages))?;
        let this = Self { inbox: inbox.clone(), next_slot: 0.into(), thread: Some(thread) };
        Ok((this, inbox))
    }

    /// Gives a camera a place.
    pub async fn attach(
        &self,
        camera: CameraId,
        epoch: Epoch,
        config: TrackerConfig,
        outlet: Box<dyn Outlet>,
        metrics: Arc<CameraMetrics>,
    ) -> Result<Seat, TrackerGone> {
        let slot = Slot(self.next_slot.fetch_add(1, std::sync::atomic::Ordering::Relaxed));
        let seat = NewSeat { slot, camera, epoch, config, outlet, metrics };
        self.inbox.send(ToTracker::Attach(Box::new(seat))).await.map_err(|_| TrackerGone)?;
        Ok(Seat { slot, inbox: self.inbox.clone() })
    }

    /// Waits for the thread to end, which it does once every sender of messages is gone.
    pub fn join(mut self) {
        let thread = self.thread.take();
        drop(self);
        if let Some(thread) = thread
            && thread.join().is_err()
        {
            tracing::error!("the tracker's thread panicked");
        }
    }
}

impl Seat {
    /// Hands a frame over; frames are tracked in the order of these calls.
    pub async fn frame(&self, frame: Embedded) -> Result<(), TrackerGone> {
        self.inbox.send(ToTracker::Frame(self.slot, frame)).await.map_err(|_| TrackerGone)
    }

    /// Leaves; returns when the frames before it are done and the outlet is closed.
    pub async fn leave(&self) {
        let (done, left) = oneshot::channel();
        if self.inbox.send(ToTracker::Detach(self.slot, done)).await.is_ok() {
            // An error means that the thread is gone, and the outlet with it.
            let _ = left.await;
        }
    }
}

/// One camera at the tracker.
struct Desk {
    camera: CameraId,
    epoch: Epoch,
    tracker: Tracker,
    /// Looks for the camera's motion in the pictures, unless that is switched off.
    egomotion: Option<Egomotion>,
    outlet: Box<dyn Outlet>,
    metrics: Arc<CameraMetrics>,
    seq: u64,
    /// Frames behind the one in hand; at most [`super::embed::AT_TRACKER`].
    backlog: VecDeque<Embedded>,
    in_hand: Option<InHand>,
    leaving: Option<oneshot::Sender<()>>,
}

struct InHand {
    frame: Embedded,
    predicted_in: Duration,
    asked: Instant,
}

struct Worker {
    seats: BTreeMap<Slot, Desk>,
    jobs: mpsc::Sender<LinkJob>,
    track: prometheus::Histogram,
    link: prometheus::Histogram,
}

impl Worker {
    fn run(mut self, mut messages: mpsc::Receiver<ToTracker>) {
        while let Some(message) = messages.blocking_recv() {
            match message {
                ToTracker::Attach(seat) => {
                    let NewSeat { slot, camera, epoch, config, outlet, metrics } = *seat;
                    let egomotion = (config.shift.enabled && config.shift.picture).then(Egomotion::default);
                    let tracker = Tracker::new(config);
                    let (backlog, in_hand, leaving) = (VecDeque::new(), None, None);
                    let desk = Desk {
                        camera,
                        epoch,
                        tracker,
                        egomotion,
                        outlet,
                        metrics,
                        seq: 0,
                        backlog,
                        in_hand,
                        leaving,
                    };
                    self.seats.insert(slot, desk);
                }
                ToTracker::Frame(slot, frame) => {
                    if let Some(desk) = self.seats.get_mut(&slot) {
                        desk.backlog.push_back(frame);
                        self.advance(slot);
                    }
                }
                ToTracker::Links { slot, links } => self.answered(slot, links),
                ToTracker::Detach(slot, done) => {
                    if let Some(desk) = self.seats.get_mut(&slot) {
                        desk.leaving = Some(done);
                        self.advance(slot);
                    }
                }
            }
        }
    }

    /// Works on the camera's frames until one needs scores or none is left.
    fn advance(&mut self, slot: Slot) {
        let Some(desk) = self.seats.get_mut(&slot) else { return };
        while desk.in_hand.is_none() {
            let Some(mut frame) = desk.backlog.pop_front() else {
                if let Some(done) = desk.leaving.take() {
                    self.seats.remove(&slot);
                    // Whoever asked may have stopped waiting.
                    let _ = done.send(());
                }
                return;
            };
            let start = Instant::now();
            // Moves into the link job, so it cannot be kept.
            let mut request = LinkRequest::default();
            let shift = desk.egomotion.as_mut().and_then(|e| e.next(&frame.frame.image));
            desk.tracker.predict(input(&frame, shift), &mut request);
            let predicted_in = start.elapsed();
            frame.ticket.step(Step::Predict, start);
            let asked = Instant::now();
            let empty = request.is_empty();
            desk.in_hand = Some(InHand { frame, predicted_in, asked });
            if empty {
                desk.finish(&[], &self.track);
            } else if self.jobs.try_send(LinkJob { slot, request }).is_err()
                && let Some(in_hand) = desk.in_hand.take()
            {
                // One job a camera fits; only a stopped link stage refuses.
                in_hand.frame.ticket.dropped(DropReason::Stopped);
            }
        }
    }

    fn answered(&mut self, slot: Slot, links: Result<Vec<f32>, InferError>) {
        let Some(desk) = self.seats.get_mut(&slot) else { return };
        match links {
            Ok(links) => {
                if let Some(InHand { frame, asked, .. }) = &mut desk.in_hand {
                    self.link.observe(asked.elapsed().as_secs_f64());
                    frame.ticket.step(Step::Link, *asked);
                }
                desk.finish(&links, &self.track);
            }
            Err(error) => {
                if let Some(mut in_hand) = desk.in_hand.take() {
                    in_hand.frame.ticket.step(Step::Link, in_hand.asked);
                    let frame = in_hand.frame.frame.index;
                    tracing::warn!(camera = %desk.camera, frame, %error, "link scores failed");
                    in_hand.frame.ticket.dropped(DropReason::Inference);
                }
            }
        }
        self.advance(slot);
    }
}

impl Desk {
    /// Decides the frame in hand and publishes it.
    fn finish(&mut self, links: &[f32], track: &prometheus::Histogram) {
        let Some(InHand { frame, predicted_in, .. }) = self.in_hand.take() else { return };
        let start = Instant::now();
        let Update { tracks, ended } = match self.tracker.update(links) {
            Ok(update) => update,
            Err(error) => {
                tracing::error!(camera = %self.camera, %error, "the link stage broke its contract");
                frame.ticket.dropped(DropReason::Inference);
                return;
            }
        };
        track.observe((predicted_in + start.elapsed()).as_secs_f64());
        for state in TrackState::ALL {
            let count = tracks.iter().filter(|t| t.state == state).count();
            self.metrics.tracks[state as usize].set(count as i64);
        }
        let Embedded { frame, mut ticket, permit, .. } = frame;
        ticket.step(Step::Update, start);
        let updated = Instant::now();
        let report = FrameTracks {
            camera: self.camera.clone(),
            epoch: self.epoch,
            seq: self.seq,
            frame: frame.index,
            time: frame.time,
            capture: frame.capture,
            width: frame.image.width,
            height: frame.image.height,
            tracks,
            ended,
        };
        self.seq += 1;
        self.metrics.latency.observe(frame.decoded.elapsed().as_secs_f64());
        if frame.capture.clock != Clock::Media
            && let Ok(now) = SystemTime::now().duration_since(UNIX_EPOCH)
        {
            let age = now.as_nanos() as i64 - frame.capture.unix_ns;
            self.metrics.capture_latency.observe(age as f64 * 1e-9);
        }
        self.outlet.emit(frame, Arc::new(report));
        ticket.step(Step::Publish, updated);
        ticket.tracked();
        drop(permit);
    }
}

fn input(frame: &Embedded, shift: Option<Shift>) -> FrameInput<'_> {
    FrameInput {
        time: frame.frame.time,
        width: f64::from(frame.frame.image.width),
        height: f64::from(frame.frame.image.height),
        detections: &frame.detections,
        embeddings: &frame.embeddings,
        shift,
    }
}
