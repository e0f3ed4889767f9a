//! One connection's GStreamer pipeline: source -> parser -> decoder -> appsink.
//!
//! The decoder is chosen here rather than by decodebin: hardware first, its name known, one that
//! failed avoided the next time. `videoconvert` passes I420 through untouched and works only for
//! decoders that give something else.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;
use gstreamer_video as gst_video;

use super::backlog;
use super::decoder;
use super::failure::{Failure, RTSP_TIMEOUT};
use super::line::Line;
use super::spec::{Pacing, SourceSpec, Transport};
use super::url::{Location, Login};

/// Decoded frames that wait for the sink; then the decoder waits.
const DECODED_FRAMES: u32 = 3;

/// A pipeline, taken down when dropped.
pub(crate) struct Graph {
    pub pipeline: gst::Pipeline,
    pub sink: gst_app::AppSink,
    pub shared: Arc<Shared>,
    /// Its RTSP connection.
    pub line: Option<Arc<Line>>,
}

impl Drop for Graph {
    fn drop(&mut self) {
        // Failing to stop leaves nothing more to do.
        let _ = self.pipeline.set_state(gst::State::Null);
    }
}

/// What the streaming threads tell the camera's thread.
pub(crate) struct Shared {
    started: Instant,
    /// Milliseconds from `started` to the newest encoded data; 0 before any.
    last_data_ms: AtomicU64,
    /// Encoded frames skipped since last asked.
    skipped: AtomicU64,
    facts: Mutex<Facts>,
}

/// What was found in the stream.
#[derive(Clone, Default)]
pub(crate) struct Facts {
    pub codec: Option<String>,
    pub decoder: Option<String>,
    /// Set when the graph could not be completed.
    pub failure: Option<Failure>,
}

impl Shared {
    pub fn facts(&self) -> MutexGuard<'_, Facts> {
        self.facts.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    fn fail(&self, failure: Failure) {
        self.facts().failure.get_or_insert(failure);
    }

    /// When the graph was built.
    pub fn started(&self) -> Instant {
        self.started
    }

    /// Marks that encoded data came.
    pub fn data_arrived(&self) {
        let ms = self.started.elapsed().as_millis() as u64;
        self.last_data_ms.store(ms.max(1), Ordering::Relaxed);
    }

    /// When encoded data last came.
    pub fn last_data(&self) -> Option<Instant> {
        let ms = self.last_data_ms.load(Ordering::Relaxed);
        (ms > 0).then(|| self.started + std::time::Duration::from_millis(ms))
    }

    /// Counts an encoded frame that will not be decoded.
    pub fn skip_one(&self) {
        self.skipped.fetch_add(1, Ordering::Relaxed);
    }

    /// Encoded frames skipped since the last call.
    pub fn take_skipped(&self) -> u64 {
        self.skipped.swap(0, Ordering::Relaxed)
    }
}

/// Builds the pipeline for one connection, of a camera to one of `peers`; nothing flows yet.
pub(crate) fn build(
    spec: &SourceSpec,
    transport: Transport,
    avoid: &[String],
    peers: Vec<SocketAddr>,
) -> Result<Graph, Failure> {
    let pipeline = gst::Pipeline::new();
    let shared = Arc::new(Shared {
        started: Instant::now(),
        last_data_ms: AtomicU64::new(0),
        skipped: AtomicU64::new(0),
        facts: Mutex::default(),
    });
    let live = spec.is_live();
    let convert = make("videoconvert")?;
    let sink = gst_app::AppSink::builder()
        .caps(&gst_video::VideoCapsBuilder::new().format(gst_video::VideoFormat::I420).build())
        .max_buffers(DECODED_FRAMES)
        .sync(!live && spec.pacing == Pacing::Realtime)
        .enable_last_sample(false)
        .build();
    accept_video_meta(&sink);
    pipeline.add_many([&convert, sink.upcast_ref()]).map_err(internal)?;
    gst::Element::link_many([&convert, sink.upcast_ref()]).map_err(internal)?;

    let plug = Plug {
        pipeline: pipeline.downgrade(),
        convert: convert.downgrade(),
        shared: shared.clone(),
        live,
        threads: spec.decoder_threads.unwrap_or_else(|| decoder_threads(live)),
        software: spec.software_decoder,
        avoid: avoid.to_vec(),
    };
    let mut line = None;
    match spec.url.location() {
        Location::Rtsp { uri, login, .. } => {
            let source = rtsp_source(spec, uri, login.as_ref(), transport)?;
            line = Some(Line::of(&source, peers));
            pipeline.add(&source).map_err(internal)?;
            depayload_pads_of(&pipeline, &source, plug);
        }
        Location::Http { uri, login, .. } => {
            let source = make("urisourcebin")?;
            source.set_property("uri", uri);
            source.set_property("parse-streams", true);
            let (login, insecure) = (login.clone(), spec.insecure_tls);
            source.connect("source-setup", false, move |args| {
                let http = args.get(1)?.get::<gst::Element>().ok()?;
                if let Some(Login { user, password }) = &login
                    && http.has_property("user-id")
                {
                    http.set_property("user-id", user);
                    http.set_property("user-pw", password);
                }
                if http.has_property("timeout") {
                    http.set_property_from_str("timeout", "10");
                }
                if insecure && http.has_property("ssl-strict") {
                    http.set_property("ssl-strict", false);
                }
                None
            });
            pipeline.add(&source).map_err(internal)?;
            plug.take_pads_of(&source);
        }
        Location::File(path) => {
            let source = make("filesrc")?;
            source.set_property("location", path);
            parse(&pipeline, &source, plug)?;
        }
        Location::Device(path) => {
            let source = make("v4l2src")?;
            source.set_property("device", path.to_string_lossy().as_ref());
            parse(&pipeline, &source, plug)?;
        }
        Location::Test(test) => {
            let source = make("videotestsrc")?;
            source.set_property_from_str("pattern", &test.pattern);
            source.set_property("is-live", live);
            source.set_property("num-buffers", test.frames.map_or(-1, |n| n as i32));
            let caps = gst_video::VideoCapsBuilder::new()
                .format(gst_video::VideoFormat::I420)
                .width(test.width as i32)
                .height(test.height as i32)
                .framerate(gst::Fraction::new(test.fps as i32, 1))
                .build();
            pipeline.add(&source).map_err(internal)?;
            source.link_filtered(&convert, &caps).map_err(internal)?;
            *shared.facts() = Facts { codec: Some("raw".into()), ..Facts::default() };
        }
    }
    Ok(Graph { pipeline, sink, shared, line })
}

/// Threads of a software decoder. Each delays the picture by a frame, which a live one cannot afford; of
/// the cores that a file gets, most are the models' (on two cores, a second thread costs 3 percent of the
/// frames/s of an offline run).
fn decoder_threads(live: bool) -> u32 {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    if live { 1 } else { (cores / 4).clamp(1, 4) as u32 }
}

fn rtsp_source(
    spec: &SourceSpec,
    uri: &str,
    login: Option<&Login>,
    transport: Transport,
) -> Result<gst::Element, Failure> {
    let source = make("rtspsrc")?;
    source.set_property("location", uri);
    if let Some(Login { user, password }) = login {
        source.set_property("user-id", user);
        source.set_property("user-pw", password);
    }
    let udp = transport == Transport::Udp;
    source.set_property_from_str("protocols", if udp { "udp" } else { "tcp" });
    source.set_property("latency", spec.latency.as_millis() as u32);
    // "drop-on-latency" would throw away packets that are in time when B frames or a burst at the start
    // spread the time stamps; nothing behind the jitter buffer blocks it, so it stays short anyway.
    source.set_property("drop-on-latency", false);
    source.set_property("tcp-timeout", RTSP_TIMEOUT.as_micros() as u64);
    source.set_property("timeout", RTSP_TIMEOUT.as_micros() as u64);
    source.set_property("udp-buffer-size", 2 << 20);
    source.set_property("teardown-timeout", 50 * gst::ClockTime::MSECOND.nseconds());
    source.set_property("add-reference-timestamp-meta", true);
    source.set_property("user-agent", concat!("gakp/", env!("CARGO_PKG_VERSION")));
    if spec.insecure_tls {
        source.set_property_from_str("tls-validation-flags", "no-flags");
    }
    // Video only: sound and metadata are not even set up.
    source.connect("select-stream", false, |args| {
        let media = args.get(2).and_then(|caps| caps.get::<gst::Caps>().ok());
        let video = media.is_none_or(|caps| {
            caps.structure(0).is_none_or(|s| s.get::<&str>("media").is_ok_and(|media| media == "video"))
        });
        Some(video.to_value())
    });
    Ok(source)
}

/// Adds `source ! parsebin` and takes the video of it.
fn parse(pipeline: &gst::Pipeline, source: &gst::Element, plug: Plug) -> Result<(), Failure> {
    let parser = make("parsebin")?;
    pipeline.add_many([source, &parser]).map_err(internal)?;
    source.link(&parser).map_err(internal)?;
    plug.take_pads_of(&parser);
    Ok(())
}

/// The same for RTP, whose pads come later; only the first is used.
fn depayload_pads_of(pipeline: &gst::Pipeline, source: &gst::Element, plug: Plug) {
    let (weak, shared) = (pipeline.downgrade(), plug.shared.clone());
    let plug = Mutex::new(Some(plug));
    source.connect_pad_added(move |_, pad| {
        let Some(pipeline) = weak.upgrade() else { return };
        let Some(plug) = plug.lock().ok().and_then(|mut plug| plug.take()) else { return };
        if let Err(failure) = depayload(&pipeline, pad, plug) {
            shared.fail(failure);
        }
    });
}

/// Adds `depayloader ! parsebin`.
///
/// parsebin could find the depayloader itself, but would ask it for single NAL units; then the parser
/// knows only by the next frame that one is complete, and everything comes a frame late.
fn depayload(pipeline: &gst::Pipeline, pad: &gst::Pad, plug: Plug) -> Result<(), Failure> {
    let caps = pad.current_caps().unwrap_or_else(|| pad.query_caps(None));
    let encoding = caps.structure(0).and_then(|s| s.get::<String>("encoding-name").ok()).unwrap_or_default();
    let kind = gst::ElementFactoryType::DEPAYLOADER;
    let mut found: Vec<_> = gst::ElementFactory::factories_with_type(kind, gst::Rank::MARGINAL)
        .into_iter()
        .filter(|f| f.can_sink_any_caps(&caps))
        .collect();
    found.sort_by_key(|f| (std::cmp::Reverse(f.rank()), f.name()));
    let depayloader = found
        .iter()
        .find_map(|f| f.create().build().ok())
        .ok_or_else(|| Failure::Unsupported(format!("nothing here reads {encoding} from RTP")))?;
    let parser = make("parsebin")?;
    pipeline.add_many([&depayloader, &parser]).map_err(internal)?;
    let whole_frames = match encoding.as_str() {
        "H264" => Some("video/x-h264"),
        "H265" => Some("video/x-h265"),
        _ => None,
    };
    match whole_frames {
        Some(name) => {
            let caps = gst::Caps::builder(name).field("alignment", "au").build();
            depayloader.link_filtered(&parser, &caps).map_err(internal)?;
        }
        None => depayloader.link(&parser).map_err(internal)?,
    }
    plug.take_pads_of(&parser);
    let sink = depayloader.static_pad("sink").ok_or_else(|| internal("the depayloader has no sink"))?;
    pad.link(&sink).map_err(internal)?;
    // link_filtered has put a capsfilter between them.
    pipeline.sync_children_states().map_err(internal)
}

/// Puts the decoder between the first video pad of a parser and the appsink.
#[derive(Clone)]
struct Plug {
    pipeline: gst::glib::WeakRef<gst::Pipeline>,
    convert: gst::glib::WeakRef<gst::Element>,
    shared: Arc<Shared>,
    live: bool,
    threads: u32,
    software: bool,
    avoid: Vec<String>,
}

impl Plug {
    fn take_pads_of(self, parser: &gst::Element) {
        let shared = self.shared.clone();
        parser.connect_no_more_pads(move |_| {
            let mut facts = shared.facts();
            if facts.codec.is_none() {
                facts.failure.get_or_insert(Failure::Unsupported("there is no video in it".into()));
            }
        });
        parser.connect_pad_added(move |_, pad| {
            if let Err(failure) = self.take(pad) {
                self.shared.fail(failure);
            }
        });
    }

    fn take(&self, pad: &gst::Pad) -> Result<(), Failure> {
        let (Some(pipeline), Some(convert)) = (self.pipeline.upgrade(), self.convert.upgrade()) else {
            return Ok(());
        };
        let caps = pad.current_caps().unwrap_or_else(|| pad.query_caps(None));
        let Some(name) = caps.structure(0).map(|s| s.name().to_string()) else {
            return self.take_later(&pipeline, pad);
        };
        if !(name.starts_with("video/") || name.starts_with("image/")) || self.shared.facts().codec.is_some()
        {
            return discard(&pipeline, pad);
        }
        self.shared.facts().codec = Some(codec_name(&caps, &name));
        let after = convert.static_pad("sink").ok_or_else(|| internal("videoconvert has no sink"))?;
        if name == "video/x-raw" {
            self.watch(pad);
            pad.link(&after).map_err(internal)?;
            return Ok(());
        }
        let decoder = decoder::create(&caps, self.software, self.threads, &self.avoid)?;
        self.shared.facts().decoder = decoder.factory().map(|f| f.name().to_string());
        pipeline.add(&decoder).map_err(internal)?;
        let (Some(into), Some(out)) = (decoder.static_pad("sink"), decoder.static_pad("src")) else {
            return Err(internal("the decoder has no pads"));
        };
        out.link(&after).map_err(internal)?;
        if self.live {
            // The network's thread only hands over; decoding has its own.
            let queue = make("queue")?;
            queue.set_property("max-size-buffers", 0u32);
            queue.set_property("max-size-bytes", 0u32);
            queue.set_property("max-size-time", 0u64);
            pipeline.add(&queue).map_err(internal)?;
            queue.link(&decoder).map_err(internal)?;
            let entry = queue.static_pad("sink").ok_or_else(|| internal("queue has no sink"))?;
            backlog::guard(&queue, &self.shared).ok_or_else(|| internal("queue has no pads"))?;
            decoder.sync_state_with_parent().map_err(internal)?;
            queue.sync_state_with_parent().map_err(internal)?;
            pad.link(&entry).map_err(internal)?;
        } else {
            self.watch(&into);
            decoder.sync_state_with_parent().map_err(internal)?;
            pad.link(&into).map_err(internal)?;
        }
        Ok(())
    }

    /// A pad that does not say yet what it carries (HLS): a further parser will.
    fn take_later(&self, pipeline: &gst::Pipeline, pad: &gst::Pad) -> Result<(), Failure> {
        let kinds = gst::StreamType::VIDEO | gst::StreamType::UNKNOWN;
        if pad.stream().is_some_and(|stream| !stream.stream_type().intersects(kinds)) {
            return discard(pipeline, pad);
        }
        let parser = make("parsebin")?;
        pipeline.add(&parser).map_err(internal)?;
        self.clone().take_pads_of(&parser);
        parser.sync_state_with_parent().map_err(internal)?;
        let entry = parser.static_pad("sink").ok_or_else(|| internal("parsebin has no sink"))?;
        pad.link(&entry).map_err(internal)?;
        Ok(())
    }

    /// Notes that data come.
    fn watch(&self, pad: &gst::Pad) {
        let shared = self.shared.clone();
        pad.add_probe(gst::PadProbeType::BUFFER, move |_, _| {
            shared.data_arrived();
            gst::PadProbeReturn::Ok
        });
    }
}

/// Sound and further streams go nowhere; some sources fail if they cannot get rid of them.
fn discard(pipeline: &gst::Pipeline, pad: &gst::Pad) -> Result<(), Failure> {
    let sink = make("fakesink")?;
    sink.set_property("async", false);
    sink.set_property("sync", false);
    pipeline.add(&sink).map_err(internal)?;
    sink.sync_state_with_parent().map_err(internal)?;
    let entry = sink.static_pad("sink").ok_or_else(|| internal("fakesink has no sink"))?;
    pad.link(&entry).map_err(internal)?;
    Ok(())
}

/// `h264`, `h265`, `jpeg`, `mpeg4`, ...
fn codec_name(caps: &gst::Caps, name: &str) -> String {
    let short = name.split('/').nth(1).unwrap_or(name).trim_start_matches("x-");
    let version = caps.structure(0).and_then(|s| s.get::<i32>("mpegversion").ok());
    match (short, version) {
        ("mpeg", Some(version)) => format!("mpeg{version}"),
        _ => short.to_owned(),
    }
}

/// Tells the decoder that padded rows are welcome: otherwise it copies each frame into packed ones.
fn accept_video_meta(sink: &gst_app::AppSink) {
    let Some(pad) = sink.static_pad("sink") else { return };
    pad.add_probe(gst::PadProbeType::QUERY_DOWNSTREAM, |_, info| {
        if let Some(query) = info.query_mut()
            && let gst::QueryViewMut::Allocation(allocation) = query.view_mut()
        {
            allocation.add_allocation_meta::<gst_video::VideoMeta>(None);
            return gst::PadProbeReturn::Handled;
        }
        gst::PadProbeReturn::Ok
    });
}

fn make(name: &str) -> Result<gst::Element, Failure> {
    gst::ElementFactory::make(name).build().map_err(|_| {
        Failure::Unsupported(format!("GStreamer has no `{name}` here: install {}", package_of(name)))
    })
}

/// Debian's package that holds an element.
pub(crate) fn package_of(element: &str) -> &'static str {
    match element {
        "rtspsrc" | "v4l2src" | "souphttpsrc" | "qtdemux" => "gstreamer1.0-plugins-good",
        "h264parse" | "h265parse" | "x265enc" | "openh264enc" => "gstreamer1.0-plugins-bad",
        "x264enc" => "gstreamer1.0-plugins-ugly",
        _ => "gstreamer1.0-plugins-base",
    }
}

fn internal(error: impl std::fmt::Display) -> Failure {
    Failure::Other(format!("GStreamer graph: {error}"))
}
