//! A source's thread: `run` retries, `run_once` works.

use std::net::SocketAddr;
use std::ops::ControlFlow;
use std::sync::mpsc;
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_video as gst_video;
use tracing::{debug, info, warn};

use super::backlog;
use super::backoff::Backoff;
use super::clock::{CaptureClock, Stamps};
use super::failure::{self, Failure};
use super::graph::{self, Graph};
use super::knock::{self, Door};
use super::memory;
use super::picture;
use super::spec::{Pacing, SourceError, SourceSpec, Transport};
use super::timeline::{Mode, TimeLine};
use super::url::Location;
use crate::types::{CameraId, CaptureTime, Clock, Image, MediaTime};

/// What a source tells its sink, in order.
#[derive(Clone, Debug)]
pub enum SourceEvent {
    /// A connection gives pictures; comes before its first frame.
    Opened(Opened),
    /// A decoded frame.
    Frame(RawFrame),
    /// A frame came but was damaged (packets lost, no key frame yet) and is not delivered.
    Corrupt,
    /// So many encoded frames were not decoded, because decoding fell behind the camera.
    Skipped {
        /// How many.
        frames: u64,
    },
    /// The connection is gone, or could not be made.
    Lost {
        /// Why.
        reason: Failure,
        /// When the next attempt comes; `None`: never, this was the last event.
        retry_in: Option<Duration>,
    },
    /// A source that is played once came to its end: the last event.
    Ended,
}

/// What a connection turned out to be.
#[derive(Clone, Debug, PartialEq)]
pub struct Opened {
    /// Width of the first frame in pixels; later frames may differ.
    pub width: u32,
    /// Height of the first frame in pixels.
    pub height: u32,
    /// Frames per second, where the stream says.
    pub fps: Option<f64>,
    /// `h264`, `h265`, `jpeg`, `mpeg4`, `raw`, ...
    pub codec: String,
    /// GStreamer's decoder element; `none` for raw video.
    pub decoder: String,
    /// Length of a file, where known.
    pub duration: Option<Duration>,
    /// What RTP travels by; `None` if the source is not RTSP.
    pub transport: Option<Transport>,
}

/// A decoded frame, before it has an index and an epoch.
#[derive(Clone, Debug)]
pub struct RawFrame {
    /// The picture.
    pub image: Image,
    /// Its place on the source's time line, which only grows, also across connections and rounds.
    pub time: MediaTime,
    /// When it was captured.
    pub capture: CaptureTime,
    /// When it left the decoder.
    pub decoded: Instant,
}

/// A running source. Dropping it tells the source to stop, without waiting.
#[derive(Debug)]
pub struct SourceHandle {
    name: CameraId,
    stop: Arc<Stop>,
    done: mpsc::Receiver<()>,
    thread: Option<JoinHandle<()>>,
}

impl SourceHandle {
    /// Stops the source and waits for its thread, at most 5 s: then it is left behind with a
    /// warning. A sink that blocks delays this; the sink hears nothing more once this returns.
    pub fn stop(mut self) {
        self.stop.set();
        // An error means that the thread is already gone.
        if let Err(mpsc::RecvTimeoutError::Timeout) = self.done.recv_timeout(Duration::from_secs(5)) {
            warn!(camera = %self.name, "the source does not stop within 5 s; its thread is left behind");
            return;
        }
        if let Some(thread) = self.thread.take() {
            // A panic in the sink was already reported by the panic hook.
            let _ = thread.join();
        }
    }

    /// Whether the source has come to its end (see [`SourceEvent::Ended`], [`SourceEvent::Lost`]).
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl Drop for SourceHandle {
    fn drop(&mut self) {
        self.stop.set();
    }
}

/// Opens a source on a thread named `cam-<name>` and calls `sink` there for everything that happens,
/// until it breaks, the handle stops it, or a source that is played once ends.
///
/// A sink of a camera must be quick: while it works, frames wait in the pipeline (3 decoded, then
/// encoded ones for 2 s, then those are skipped and reported). A sink of a file may block: the file waits.
pub fn start(
    name: &CameraId,
    spec: SourceSpec,
    sink: impl FnMut(SourceEvent) -> ControlFlow<()> + Send + 'static,
) -> Result<SourceHandle, SourceError> {
    super::init()?;
    spec.check()?;
    let stop = Arc::new(Stop::default());
    let (finished, done) = mpsc::sync_channel(1);
    let (camera, told) = (name.clone(), stop.clone());
    // Linux shows 15 characters of it.
    let thread = std::thread::Builder::new().name(format!("cam-{name}")).spawn(move || {
        let mode =
            if spec.is_live() || (matches!(spec.url.location(), Location::Http { .. }) && spec.retries()) {
                Mode::Camera
            } else {
                Mode::File
            };
        let mut source = Source {
            camera,
            line: TimeLine::new(mode),
            clock: CaptureClock::default(),
            closing: Vec::new(),
            transport: if spec.transport == Transport::Udp { Transport::Udp } else { Transport::Tcp },
            spec,
            stop: told,
            sink,
            avoid: Vec::new(),
            proven: false,
        };
        // Either outcome ends the thread.
        let _ = source.run();
        let _ = finished.try_send(());
    });
    let thread = thread.map_err(SourceError::Thread)?;
    Ok(SourceHandle { name: name.clone(), stop, done, thread: Some(thread) })
}

/// A flag that can be waited for.
#[derive(Debug, Default)]
struct Stop {
    set: Mutex<bool>,
    changed: Condvar,
}

impl Stop {
    fn set(&self) {
        *self.set.lock().unwrap_or_else(|e| e.into_inner()) = true;
        self.changed.notify_all();
    }

    fn is_set(&self) -> bool {
        *self.set.lock().unwrap_or_else(|e| e.into_inner())
    }

    /// Waits; true when stopped meanwhile.
    fn wait(&self, duration: Duration) -> bool {
        let guard = self.set.lock().unwrap_or_else(|e| e.into_inner());
        let waited = self.changed.wait_timeout_while(guard, duration, |set| !*set);
        *waited.unwrap_or_else(|e| e.into_inner()).0
    }
}

/// How a connection ended.
enum End {
    /// The sink or the handle said stop.
    Stopped,
    /// The end of a file.
    Eos,
    /// Anything else.
    Lost(Failure),
}

/// After so long with frames a connection counts as good: the back-off begins anew.
const PROVEN: Duration = Duration::from_secs(5);
/// The camera's thread looks for errors and the stop flag this often.
const TICK: gst::ClockTime = gst::ClockTime::from_mseconds(50);
/// A connection that is left takes no longer to close; then it is cut.
const CLOSING: Duration = Duration::from_millis(300);
/// So many of a camera's connections may be left behind that do not even close when cut; until then there is no other.
const MOST_CLOSING: usize = 3;

struct Source<S> {
    camera: CameraId,
    spec: SourceSpec,
    stop: Arc<Stop>,
    sink: S,
    line: TimeLine,
    clock: CaptureClock,
    /// Connections that do not close.
    closing: Vec<mpsc::Receiver<()>>,
    /// For RTSP: the transport of the next connection.
    transport: Transport,
    /// Decoders that failed on this stream.
    avoid: Vec<String>,
    /// Whether the transport has ever brought a frame.
    proven: bool,
}

impl<S: FnMut(SourceEvent) -> ControlFlow<()>> Source<S> {
    fn run(&mut self) -> ControlFlow<()> {
        let mut backoff = Backoff::default();
        loop {
            self.line.restart();
            self.clock.restart();
            let mut flow = Flow::default();
            let end = self.attempt(&mut flow);
            let reason = match end {
                End::Stopped => return ControlFlow::Break(()),
                End::Eos if flow.frames == 0 => Failure::Garbage("it ended before the first frame".into()),
                End::Eos if self.spec.looped => continue,
                End::Eos => {
                    debug!(camera = %self.camera, frames = flow.frames, "the end");
                    return (self.sink)(SourceEvent::Ended);
                }
                End::Lost(reason) => reason,
            };
            if flow.first.is_some_and(|first| first.elapsed() >= PROVEN) {
                backoff.reset();
            }
            self.switch_transport(&reason, flow.frames);
            // A password that has worked is not wrong.
            let refused = reason == Failure::Unauthorized && !self.proven;
            let most = if refused { Backoff::LATER } else { Backoff::SOON };
            let retry_in = self.spec.retries().then(|| backoff.next(most));
            warn!(camera = %self.camera, source = %self.spec.url, reason = reason.label(), ?retry_in, "lost: {reason}");
            (self.sink)(SourceEvent::Lost { reason, retry_in })?;
            match retry_in {
                Some(wait) if !self.stop.wait(wait) => {}
                _ => return ControlFlow::Break(()),
            }
        }
    }

    /// From the knock at the door to the end of the connection.
    fn attempt(&mut self, flow: &mut Flow) -> End {
        self.closing.retain(|closed| closed.try_recv() == Err(mpsc::TryRecvError::Empty));
        if self.closing.len() >= MOST_CLOSING {
            let what = "the camera does not let go of connections that were left";
            return End::Lost(Failure::Garbage(what.into()));
        }
        let peers = match self.knock() {
            Ok(peers) => peers,
            Err(end) => return end,
        };
        match graph::build(&self.spec, self.transport, &self.avoid, peers) {
            Ok(graph) => {
                let end = self.run_once(&graph, flow);
                self.close(graph);
                end
            }
            Err(failure) => End::Lost(failure),
        }
    }

    /// The addresses of a camera that answers sensibly, or how the attempt ends.
    fn knock(&self) -> Result<Vec<SocketAddr>, End> {
        let Location::Rtsp { uri, host, port, .. } = self.spec.url.location() else { return Ok(Vec::new()) };
        let uri = uri.starts_with("rtsp://").then(|| uri.clone());
        let door = Door { host: host.clone(), port: *port, uri };
        let (answer, answered) = mpsc::sync_channel(1);
        // Its own thread, so that nobody who stops the camera waits for a name server or a dead host.
        let knocks = std::thread::Builder::new().name(format!("knock-{}", self.camera));
        let knocks = knocks.spawn(move || {
            // Nobody waits for it any more, perhaps.
            let _ = answer.send(knock::knock(&door));
        });
        knocks.map_err(|e| End::Lost(Failure::Other(format!("no thread for the connection: {e}"))))?;
        loop {
            match answered.recv_timeout(Duration::from(TICK)) {
                Ok(outcome) => return outcome.map_err(End::Lost),
                Err(mpsc::RecvTimeoutError::Timeout) if !self.stop.is_set() => {}
                Err(mpsc::RecvTimeoutError::Timeout) => return Err(End::Stopped),
                Err(mpsc::RecvTimeoutError::Disconnected) => {
                    return Err(End::Lost(Failure::Other("the attempt to connect panicked".into())));
                }
            }
        }
    }

    /// Takes the pipeline down. In the middle of a message GStreamer cannot be stopped: a camera whose message has no end
    /// must not keep us.
    fn close(&mut self, graph: Graph) {
        let line = graph.line.clone();
        let (done, closed) = mpsc::sync_channel(1);
        let closes = std::thread::Builder::new().name(format!("close-{}", self.camera));
        // Without a thread the pipeline goes with the closure, here.
        let closes = closes.spawn(move || {
            drop(graph);
            // Nobody waits for it any more, perhaps.
            let _ = done.send(());
            memory::give_back();
        });
        let mut in_time = closes.is_err() || closed.recv_timeout(CLOSING).is_ok();
        if let (false, Some(line)) = (in_time, line) {
            line.cut();
            in_time = closed.recv_timeout(CLOSING).is_ok();
        }
        if !in_time {
            warn!(camera = %self.camera, "a connection does not close although it was cut; it is left behind");
            self.closing.push(closed);
        }
    }

    /// `Auto` is TCP, and UDP by turns where TCP has never brought a frame although the camera answers.
    fn switch_transport(&mut self, reason: &Failure, frames: u64) {
        self.proven |= frames > 0;
        let answers = matches!(reason, Failure::Silent(_) | Failure::Transport);
        if self.spec.transport == Transport::Auto && !self.proven && answers {
            self.transport = if self.transport == Transport::Tcp { Transport::Udp } else { Transport::Tcp };
        }
    }

    /// One connection, from opening to its end.
    fn run_once(&mut self, graph: &Graph, flow: &mut Flow) -> End {
        let Some(bus) = graph.pipeline.bus() else {
            return End::Lost(Failure::Other("a pipeline without a bus".into()));
        };
        flow.opened = Instant::now();
        if graph.pipeline.set_state(gst::State::Playing).is_err() {
            // The reason is on the bus.
            let failure = self.next_failure(&bus, graph);
            return End::Lost(failure.unwrap_or_else(|| Failure::Other("the source does not start".into())));
        }
        loop {
            if self.stop.is_set() {
                return End::Stopped;
            }
            let asked = Instant::now();
            if let Some(sample) = graph.sink.try_pull_sample(TICK) {
                if self.deliver(&sample, graph, flow).is_break() {
                    return End::Stopped;
                }
            } else if asked.elapsed() < Duration::from_millis(2) {
                // The appsink is not running (yet, or any more): do not spin.
                std::thread::sleep(Duration::from_millis(2));
            }
            if let Some(end) = self.look_around(&bus, graph, flow) {
                return end;
            }
        }
    }

    /// Between frames: messages, skipped frames, the watchdog.
    fn look_around(&mut self, bus: &gst::Bus, graph: &Graph, flow: &mut Flow) -> Option<End> {
        let skipped = graph.shared.take_skipped();
        if skipped > 0 && (self.sink)(SourceEvent::Skipped { frames: skipped }).is_break() {
            return Some(End::Stopped);
        }
        if let Some(failure) = graph.shared.facts().failure.take() {
            return Some(End::Lost(failure));
        }
        while let Some(message) = bus.pop() {
            match message.view() {
                gst::MessageView::Eos(_) => return Some(self.at_end(graph)),
                gst::MessageView::Error(error) => {
                    let failure = self.failure(error, graph);
                    // What was decoded before it is still good.
                    while let Some(sample) = graph.sink.try_pull_sample(gst::ClockTime::ZERO) {
                        if self.deliver(&sample, graph, flow).is_break() {
                            return Some(End::Stopped);
                        }
                    }
                    return Some(End::Lost(failure));
                }
                gst::MessageView::Warning(w) => {
                    let text =
                        self.spec.url.scrub(&format!("{} {}", w.error(), w.debug().unwrap_or_default()));
                    debug!(camera = %self.camera, "GStreamer warns: {text}");
                }
                // parsebin says here what it found; a stream it cannot link may end without a word.
                gst::MessageView::StreamCollection(message) => {
                    let kinds = gst::StreamType::VIDEO | gst::StreamType::UNKNOWN;
                    let streams = message.stream_collection();
                    if !streams.is_empty() && !streams.iter().any(|s| s.stream_type().intersects(kinds)) {
                        return Some(End::Lost(Failure::Unsupported("there is no video in it".into())));
                    }
                }
                gst::MessageView::Latency(_) => {
                    let _ = graph.pipeline.recalculate_latency();
                }
                _ => {}
            }
        }
        self.watchdog(graph, flow)
    }

    /// The end of a stream: the end of a file, or a camera that hung up (over TCP that is no error).
    fn at_end(&self, graph: &Graph) -> End {
        match self.spec.url.location() {
            Location::Rtsp { .. } | Location::Device(_) => End::Lost(Failure::Disconnected),
            // A live HTTP stream has no length.
            Location::Http { .. } if graph.pipeline.query_duration::<gst::ClockTime>().is_none() => {
                End::Lost(Failure::Disconnected)
            }
            _ => End::Eos,
        }
    }

    /// A frozen camera raises neither error nor end of stream: nothing comes, and time passes.
    fn watchdog(&self, graph: &Graph, flow: &Flow) -> Option<End> {
        let patience = match self.spec.url.location() {
            // Files on slow disks, segments of HLS.
            Location::File(_) => self.spec.silence.max(Duration::from_secs(30)),
            Location::Http { uri, .. } if uri.contains(".m3u8") || uri.contains(".mpd") => {
                self.spec.silence.max(Duration::from_secs(20))
            }
            _ => self.spec.silence,
        };
        let last_frame = flow.last.unwrap_or(flow.opened);
        let last_sign = graph.shared.last_data().map_or(last_frame, |data| data.max(last_frame));
        if last_sign.elapsed() >= patience {
            return Some(End::Lost(Failure::Silent(patience)));
        }
        // Cameras with rare key frames take a while; but data that never decode are a loss too.
        let undecoded = (4 * patience).max(Duration::from_secs(15));
        (last_frame.elapsed() >= undecoded)
            .then(|| End::Lost(Failure::Garbage(format!("nothing decodes for {} s", undecoded.as_secs()))))
    }

    fn failure(&mut self, error: &gst::message::Error, graph: &Graph) -> Failure {
        let details = error.debug().unwrap_or_default();
        let text = self.spec.url.scrub(&format!("{} {details}", error.error()));
        debug!(camera = %self.camera, "GStreamer: {text}");
        let decoder = graph.shared.facts().decoder.clone();
        let from = error.src().and_then(|src| src.downcast_ref::<gst::Element>()).and_then(|e| e.factory());
        if let (Some(decoder), Some(from)) = (decoder, from)
            && from.name() == decoder.as_str()
            && from.has_type(gst::ElementFactoryType::HARDWARE)
        {
            warn!(camera = %self.camera, decoder, "the hardware decoder failed; the next attempt uses another");
            self.avoid.push(decoder);
        }
        failure::classify(&error.error(), &details, &self.spec.url)
    }

    fn next_failure(&mut self, bus: &gst::Bus, graph: &Graph) -> Option<Failure> {
        if let Some(failure) = graph.shared.facts().failure.take() {
            return Some(failure);
        }
        let message = bus.pop_filtered(&[gst::MessageType::Error])?;
        match message.view() {
            gst::MessageView::Error(error) => Some(self.failure(error, graph)),
            _ => None,
        }
    }

    /// One decoded buffer to the sink.
    fn deliver(&mut self, sample: &gst::Sample, graph: &Graph, flow: &mut Flow) -> ControlFlow<()> {
        let decoded = Instant::now();
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as i64);
        let Some(buffer) = sample.buffer_owned() else { return ControlFlow::Continue(()) };
        let Some(info) = flow.info(sample) else { return (self.sink)(SourceEvent::Corrupt) };
        if buffer.flags().contains(gst::BufferFlags::CORRUPTED) {
            return (self.sink)(SourceEvent::Corrupt);
        }
        // From the arrival of the encoded frame to now, where that is known.
        let arrived = backlog::arrival(&buffer, graph.shared.started());
        let decoding = arrived.map_or(Duration::ZERO, |at| decoded.saturating_duration_since(at));
        let (pts, rtcp) = (buffer.pts().map(gst::ClockTime::nseconds), picture::rtcp_time(&buffer));
        let Some(image) = picture::image(buffer, &info) else { return (self.sink)(SourceEvent::Corrupt) };
        if flow.frames == 0 {
            self.open(&info, graph, flow)?;
        }
        flow.frames += 1;
        flow.last = Some(decoded);
        let time = self.line.place(pts, decoded);
        let capture = if !self.spec.is_live() && self.spec.pacing == Pacing::AsFastAsPossible {
            CaptureTime { unix_ns: time.0, clock: Clock::Media }
        } else {
            let pts = pts.and_then(|pts| i64::try_from(pts).ok());
            self.clock.capture(Stamps { pts, camera: rtcp, arrived: wall - decoding.as_nanos() as i64 })
        };
        let delivered = (self.sink)(SourceEvent::Frame(RawFrame { image, time, capture, decoded }));
        // A sink that blocks is no silence of the source.
        flow.last = Some(Instant::now());
        delivered
    }

    fn open(&mut self, info: &gst_video::VideoInfo, graph: &Graph, flow: &mut Flow) -> ControlFlow<()> {
        flow.first = Some(Instant::now());
        let (rate, facts) = (info.fps(), graph.shared.facts().clone());
        let fps = (rate.numer() > 0 && rate.denom() > 0).then(|| rate.numer() as f64 / rate.denom() as f64);
        if let Some(fps) = fps {
            self.line.set_frame_duration(Duration::from_secs_f64((1.0 / fps).clamp(1e-3, 60.0)));
        }
        let rtsp = matches!(self.spec.url.location(), Location::Rtsp { .. });
        let opened = Opened {
            width: info.width(),
            height: info.height(),
            fps,
            codec: facts.codec.unwrap_or_else(|| "unknown".into()),
            decoder: facts.decoder.unwrap_or_else(|| "none".into()),
            duration: graph.pipeline.query_duration::<gst::ClockTime>().map(Duration::from).filter(|_| !rtsp),
            transport: rtsp.then_some(self.transport),
        };
        info!(camera = %self.camera, source = %self.spec.url, width = opened.width, height = opened.height,
            codec = opened.codec, decoder = opened.decoder, "opened");
        (self.sink)(SourceEvent::Opened(opened))
    }
}

/// What one connection has brought so far.
struct Flow {
    opened: Instant,
    first: Option<Instant>,
    last: Option<Instant>,
    frames: u64,
    caps: Option<(gst::Caps, gst_video::VideoInfo)>,
}

impl Default for Flow {
    fn default() -> Self {
        Self { opened: Instant::now(), first: None, last: None, frames: 0, caps: None }
    }
}

impl Flow {
    /// The picture's format; the caps change when a camera changes its resolution.
    fn info(&mut self, sample: &gst::Sample) -> Option<gst_video::VideoInfo> {
        let caps = sample.caps_owned()?;
        match &self.caps {
            Some((known, info)) if *known == caps => Some(info.clone()),
            _ => {
                let info = gst_video::VideoInfo::from_caps(&caps).ok()?;
                self.caps = Some((caps, info.clone()));
                Some(info)
            }
        }
    }
}
