//! The one thread that owns every camera's tracker.
//!
//! It takes frames in each camera's order, asks the link stage for scores, and goes on with other
//! cameras meanwhile. Nobody else ever sees a tracker.

use std::collections::{BTreeMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
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
use crate::types::{CameraId, Clock, Epoch, FrameTracks, TrackId, TrackState};

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
    /// Tracks that ended with a tracker that failed; told with the next frame.
    orphans: Vec<TrackId>,
    /// Frames behind the one in hand; at most as many as the camera has under way.
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
                    let (slot, desk) = Desk::new(*seat);
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
            let Some(request) = desk.isolated(frame.frame.index, |desk| desk.predict(&frame)) else {
                frame.ticket.dropped(DropReason::Inference);
                continue;
            };
            let predicted_in = start.elapsed();
            frame.ticket.step(Step::Predict, start);
            let asked = Instant::now();
            let empty = request.is_empty();
            desk.in_hand = Some(InHand { frame, predicted_in, asked });
            if empty {
                desk.finish_isolated(&[], &self.track);
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
                desk.finish_isolated(&links, &self.track);
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
    fn new(seat: NewSeat) -> (Slot, Self) {
        let NewSeat { slot, camera, epoch, config, outlet, metrics } = seat;
        let egomotion = (config.shift.enabled && config.shift.picture).then(Egomotion::default);
        let desk = Self {
            camera,
            epoch,
            tracker: Tracker::new(config),
            egomotion,
            outlet,
            metrics,
            seq: 0,
            orphans: Vec::new(),
            backlog: VecDeque::new(),
            in_hand: None,
            leaving: None,
        };
        (slot, desk)
    }

    /// Does a step of one frame. Should it panic, this camera begins with a new tracker, and no other notices.
    fn isolated<T>(&mut self, frame: u64, step: impl FnOnce(&mut Self) -> T) -> Option<T> {
        let done = catch_unwind(AssertUnwindSafe(|| step(self)));
        if done.is_err() {
            tracing::error!(camera = %self.camera, frame, "the tracker panicked; this camera's tracks begin anew");
            // What was there is not looked at any more, but for its ids.
            let config = TrackerConfig::default();
            let (tracker, ended) = std::mem::replace(&mut self.tracker, Tracker::new(config)).renewed();
            self.tracker = tracker;
            self.orphans.extend(ended);
            self.egomotion = self.egomotion.take().map(|_| Egomotion::default());
        }
        done.ok()
    }

    /// The pairs of a frame that want scores.
    fn predict(&mut self, frame: &Embedded) -> LinkRequest {
        // Moves into the link job, so it cannot be kept.
        let mut request = LinkRequest::default();
        let shift = self.egomotion.as_mut().and_then(|e| e.next(&frame.frame.image));
        self.tracker.predict(input(frame, shift), &mut request);
        request
    }

    fn finish_isolated(&mut self, links: &[f32], track: &prometheus::Histogram) {
        let Some(frame) = self.in_hand.as_ref().map(|in_hand| in_hand.frame.frame.index) else { return };
        // On a panic the ticket settles itself.
        self.isolated(frame, |desk| desk.finish(links, track));
    }

    /// Decides the frame in hand and publishes it.
    fn finish(&mut self, links: &[f32], track: &prometheus::Histogram) {
        let Some(InHand { frame, predicted_in, .. }) = self.in_hand.take() else { return };
        let start = Instant::now();
        let Update { tracks, mut ended } = match self.tracker.update(links) {
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
        // Older than any that ends now.
        ended.splice(..0, self.orphans.drain(..));
        let Embedded { frame, mut ticket, place, .. } = frame;
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
        let (index, outlet) = (frame.index, &mut self.outlet);
        // The tracker is in order whatever becomes of its tracks.
        let published = catch_unwind(AssertUnwindSafe(|| outlet.emit(frame, Arc::new(report))));
        ticket.step(Step::Publish, updated);
        match published {
            Ok(()) => ticket.tracked(),
            Err(_) => {
                tracing::error!(camera = %self.camera, frame = index, "publishing panicked");
                ticket.dropped(DropReason::Inference);
            }
        }
        drop(place);
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

#[cfg(test)]
mod tests {
    use std::sync::mpsc as channel;

    use tokio::sync::Semaphore;

    use super::*;
    use crate::pipeline::Ticket;
    use crate::track::Association;
    use crate::types::{
        BBox, CaptureTime, ClassId, Detection, Frame, Image, MediaTime, Plane, YuvMatrix, YuvRange,
    };

    /// Hands reports to the test; panics at the frames with these numbers.
    struct Fragile(channel::Sender<Arc<FrameTracks>>, Vec<u64>);

    impl Outlet for Fragile {
        fn emit(&mut self, frame: Arc<Frame>, tracks: Arc<FrameTracks>) {
            assert!(!self.1.contains(&frame.index), "told to");
            self.0.send(tracks).expect("the test listens");
        }
    }

    fn frame(camera: &CameraId, index: u64, metrics: &Arc<CameraMetrics>) -> Embedded {
        let planes = [(0, 64), (64 * 48, 32), (64 * 48 + 32 * 24, 32)];
        let planes = planes.map(|(offset, stride)| Plane { offset, stride });
        let bytes = Arc::new(vec![128; 64 * 48 * 3 / 2]);
        let image = Image::i420((64, 48), YuvRange::Limited, YuvMatrix::Bt601, planes, bytes);
        let time = MediaTime(100_000_000 * index as i64);
        let frame = Frame {
            camera: camera.clone(),
            epoch: Epoch(1),
            index,
            time,
            capture: CaptureTime { clock: Clock::Media, unix_ns: time.0 },
            decoded: Instant::now(),
            image: image.expect("a picture"),
        };
        let person =
            |x: f64| Detection { bbox: BBox { x, y: 4.0, w: 10.0, h: 30.0 }, score: 0.9, class: ClassId(0) };
        let room = Arc::new(Semaphore::new(1));
        Embedded {
            frame: Arc::new(frame),
            ticket: Ticket::new(metrics.clone(), None),
            detections: vec![person(2.0), person(40.0)],
            embeddings: vec![],
            place: room.try_acquire_owned().expect("a place"),
        }
    }

    fn seat(
        name: &str,
        fails_at: Vec<u64>,
        metrics: &Metrics,
    ) -> (NewSeat, channel::Receiver<Arc<FrameTracks>>) {
        let camera = CameraId::new(name).unwrap();
        let (reports, reported) = channel::channel();
        let mut config = TrackerConfig::default();
        config.association.method = Association::Iou;
        let outlet = Box::new(Fragile(reports, fails_at));
        let metrics = metrics.camera(&camera);
        (NewSeat { slot: Slot(0), camera, epoch: Epoch(1), config, outlet, metrics }, reported)
    }

    fn ids(report: &FrameTracks) -> Vec<u64> {
        report.tracks.iter().map(|track| track.id.0).collect()
    }

    fn account(of: &CameraMetrics) -> (u64, u64, u64) {
        (of.frames_in.get(), of.tracked.get(), of.dropped[DropReason::Inference as usize].get())
    }

    #[tokio::test]
    async fn a_panic_on_publishing_stays_with_its_frame() {
        let metrics = Metrics::new().unwrap();
        let (jobs, _job_queue) = mpsc::channel(2);
        let (thread, inbox) = TrackerThread::start(jobs, metrics.clone()).unwrap();
        let mut seats = vec![];
        for (name, fails_at) in [("poisoned", vec![4, 5]), ("healthy", vec![])] {
            let (NewSeat { camera, epoch, config, outlet, metrics: of, .. }, reported) =
                seat(name, fails_at, &metrics);
            let seat = thread.attach(camera.clone(), epoch, config, outlet, of.clone()).await;
            seats.push((camera, seat.unwrap(), of, reported));
        }
        for index in 0..10 {
            for (camera, seat, of, _) in &seats {
                seat.frame(frame(camera, index, of)).await.unwrap();
            }
        }
        for (_, seat, ..) in &seats {
            seat.leave().await;
        }

        let of = |camera: usize| seats[camera].3.try_iter().collect::<Vec<_>>();
        for (camera, frames) in [(0, vec![0, 1, 2, 3, 6, 7, 8, 9]), (1, (0..10).collect())] {
            let reports = of(camera);
            assert_eq!(reports.iter().map(|report| report.frame).collect::<Vec<_>>(), frames);
            assert!(reports.iter().all(|report| ids(report) == [1, 2] && report.ended.is_empty()));
        }
        assert_eq!(account(&seats[0].2), (10, 8, 2));
        assert_eq!(account(&seats[1].2), (10, 10, 0));
        drop((seats, inbox));
        thread.join();
    }

    #[test]
    fn after_a_panic_of_the_tracker_its_ids_end_and_new_ones_go_on() {
        let metrics = Metrics::new().unwrap();
        let (seat, reported) = seat("poisoned", vec![], &metrics);
        let (of, camera) = (seat.metrics.clone(), seat.camera.clone());
        let (_, mut desk) = Desk::new(seat);
        let track = metrics.stage(Stage::Track);
        for index in 0..8 {
            let frame = frame(&camera, index, &of);
            let done = desk.isolated(index, |desk| {
                desk.predict(&frame);
                assert!(index != 4, "in the middle of it");
            });
            assert_eq!(done.is_none(), index == 4);
            desk.in_hand = Some(InHand { frame, predicted_in: Duration::ZERO, asked: Instant::now() });
            desk.finish_isolated(&[], &track);
        }
        let reports: Vec<_> = reported.try_iter().collect();
        // Whoever finishes the broken frame all the same hears that the new tracker has none.
        assert_eq!(reports.iter().map(|report| report.frame).collect::<Vec<_>>(), [0, 1, 2, 3, 5, 6, 7]);
        for report in &reports {
            assert_eq!(ids(report), if report.frame < 4 { [1, 2] } else { [3, 4] }, "frame {}", report.frame);
            let ended: Vec<_> = report.ended.iter().map(|id| id.0).collect();
            assert_eq!(ended, if report.frame == 5 { vec![1, 2] } else { vec![] });
        }
        assert!(reports.windows(2).all(|pair| pair[0].seq + 1 == pair[1].seq));
        assert_eq!(account(&of), (8, 7, 1));
    }
}
