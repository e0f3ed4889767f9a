//! A file as encoded frames in memory, ready to be sent again and again.

use std::path::Path;
use std::time::{Duration, Instant};

use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;

use super::{Codec, TestCameraError};
use crate::ingest::{decoder, graph::package_of};

/// More than this is refused: it all lies in memory.
const MOST_BYTES: usize = 1 << 30;

/// Encoded frames in decoding order, with continuous times.
pub(super) struct Footage {
    pub codec: Codec,
    /// Of the byte stream.
    pub caps: gst::Caps,
    pub units: Vec<Unit>,
    /// Length of one round.
    pub round: gst::ClockTime,
}

impl Footage {
    /// The key frame from which frame `at` of the round, or one soon after, is decoded.
    pub fn key_from(&self, at: usize) -> usize {
        let later = self.units.iter().enumerate().skip(at).find(|(_, unit)| unit.key);
        later.map_or(0, |(index, _)| index)
    }
}

/// One encoded frame.
pub(super) struct Unit {
    pub data: gst::Buffer,
    pub pts: gst::ClockTime,
    pub dts: gst::ClockTime,
    pub key: bool,
}

/// What to make of a file.
#[derive(Clone, Copy)]
pub(super) struct Form {
    /// H.264 and H.265 are taken as they are unless this asks for the other; anything else is transcoded.
    pub codec: Option<Codec>,
    /// Instead of the file's own times.
    pub fps: Option<f64>,
    /// Half the width and height.
    pub halved: bool,
}

/// Reads a file.
pub(super) fn load(path: &Path, form: Form) -> Result<Footage, TestCameraError> {
    let fps = form.fps;
    let shown = path.display().to_string();
    let failed = |what: String| TestCameraError::Video { path: shown.clone(), what };
    std::fs::File::open(path).map_err(|cause| TestCameraError::File { path: shown.clone(), cause })?;

    let pipeline = gst::Pipeline::new();
    let source = make("filesrc")?;
    source.set_property("location", path);
    let parser = make("parsebin")?;
    let sink = gst_app::AppSink::builder().sync(false).max_buffers(16).enable_last_sample(false).build();
    pipeline.add_many([&source, &parser, sink.upcast_ref()]).map_err(|e| failed(e.to_string()))?;
    source.link(&parser).map_err(|e| failed(e.to_string()))?;

    // What the streaming thread reports: the chosen codec, or why it could not be completed.
    let (report, told) = std::sync::mpsc::sync_channel(16);
    let (weak, end) = (pipeline.downgrade(), sink.clone());
    parser.connect_pad_added(move |_, pad| {
        let Some(pipeline) = weak.upgrade() else { return };
        if end.sinks_are_linked() {
            return;
        }
        if let Some(outcome) = plug(&pipeline, pad, end.upcast_ref(), form).transpose() {
            // Full only if a file has more than 16 broken video streams.
            let _ = report.try_send(outcome);
        }
    });

    let stopped = Stopped(pipeline.clone());
    pipeline.set_state(gst::State::Playing).map_err(|e| failed(e.to_string()))?;
    let bus = pipeline.bus().ok_or_else(|| failed("no bus".into()))?;
    let (mut raw, mut bytes, mut last) = (Vec::new(), 0usize, Instant::now());
    let mut caps = None;
    loop {
        if let Some(sample) = sink.try_pull_sample(gst::ClockTime::from_mseconds(20)) {
            last = Instant::now();
            caps = caps.or_else(|| sample.caps_owned());
            if let Some(buffer) = sample.buffer() {
                bytes += buffer.size();
                if bytes > MOST_BYTES {
                    return Err(failed(format!(
                        "more than {} MiB of video: use a shorter clip",
                        MOST_BYTES >> 20
                    )));
                }
                let data = buffer.map_readable().map_err(|e| failed(e.to_string()))?.to_vec();
                raw.push(Raw {
                    data,
                    pts: buffer.pts().map(gst::ClockTime::nseconds),
                    key: !buffer.flags().contains(gst::BufferFlags::DELTA_UNIT),
                });
            }
            continue;
        }
        if let Some(message) = bus.pop_filtered(&[gst::MessageType::Eos, gst::MessageType::Error]) {
            match message.view() {
                gst::MessageView::Error(error) => return Err(failed(error.error().to_string())),
                _ => break,
            }
        }
        if let Some(failure) = told.try_iter().find_map(Result::err) {
            return Err(failure);
        }
        if last.elapsed() > Duration::from_secs(10) {
            return Err(failed("there is no video in it".into()));
        }
        // An appsink that is not running yet does not wait.
        std::thread::sleep(Duration::from_millis(2));
    }
    drop(stopped);
    let caps = caps.ok_or_else(|| failed("there is no video in it".into()))?;
    let codec = match caps.structure(0).map(|s| s.name().as_str()) {
        Some("video/x-h265") => Codec::H265,
        Some("video/mpeg") => Codec::Mpeg4,
        _ => Codec::H264,
    };
    // Nobody can decode what comes before the first key frame.
    let first = raw.iter().position(|unit| unit.key).ok_or_else(|| failed("it has no key frame".into()))?;
    raw.drain(..first);
    let announced = caps.structure(0).and_then(|s| s.get::<gst::Fraction>("framerate").ok());
    let announced = announced.filter(|f| f.numer() > 0 && f.denom() > 0);
    let step_ns = match (fps, announced) {
        (Some(fps), _) => (1e9 / fps).round() as u64,
        (None, Some(rate)) => 1_000_000_000 * rate.denom() as u64 / rate.numer() as u64,
        (None, None) => 40_000_000,
    };
    let (units, round) = retime(raw, step_ns, fps.is_some());
    Ok(Footage { codec, caps, units, round: gst::ClockTime::from_nseconds(round) })
}

/// A frame as it came out of the file.
struct Raw {
    data: Vec<u8>,
    pts: Option<u64>,
    key: bool,
}

/// Times from 0 on, every frame decoded before it is shown, and the length of a round in ns.
/// `even` spaces the frames by the step, in the order in which they are shown.
fn retime(raw: Vec<Raw>, step_ns: u64, even: bool) -> (Vec<Unit>, u64) {
    let count = raw.len();
    let mut pts: Vec<u64> = match raw.iter().map(|r| r.pts).collect::<Option<Vec<u64>>>() {
        Some(pts) => pts,
        // A bare stream without times: in the order of the file.
        None => (0..count as u64).map(|i| i * step_ns).collect(),
    };
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by_key(|&i| pts[i]);
    if even {
        for (shown, &i) in order.iter().enumerate() {
            pts[i] = shown as u64 * step_ns;
        }
    }
    let first = order.first().map_or(0, |&i| pts[i]);
    pts.iter_mut().for_each(|p| *p -= first);
    let dts: Vec<u64> = order.iter().map(|&i| pts[i]).collect();
    // With B frames some are shown before their turn in decoding: all are shown later by as much.
    let delay = dts.iter().zip(&pts).map(|(d, p)| d.saturating_sub(*p)).max().unwrap_or(0);
    let round = dts.last().map_or(0, |last| last + step_ns);
    let time = gst::ClockTime::from_nseconds;
    let units = raw
        .into_iter()
        .zip(pts.iter().zip(&dts))
        .map(|(raw, (&pts, &dts))| Unit {
            data: gst::Buffer::from_slice(raw.data),
            pts: time(pts + delay),
            dts: time(dts),
            key: raw.key,
        })
        .collect();
    (units, round)
}

/// Links a parser's pad to the sink: through a parser only, or through decoder and encoder.
/// `None` if the pad is not video.
fn plug(
    pipeline: &gst::Pipeline,
    pad: &gst::Pad,
    sink: &gst::Element,
    form: Form,
) -> Result<Option<()>, TestCameraError> {
    let caps = pad.current_caps().unwrap_or_else(|| pad.query_caps(None));
    let Some(name) = caps.structure(0).map(|s| s.name().to_string()) else { return Ok(None) };
    if !(name.starts_with("video/") || name.starts_with("image/")) {
        return Ok(None);
    }
    let native = match name.as_str() {
        "video/x-h264" => Some(Codec::H264),
        "video/x-h265" => Some(Codec::H265),
        "video/mpeg" if caps.structure(0).and_then(|s| s.get::<i32>("mpegversion").ok()) == Some(4) => {
            Some(Codec::Mpeg4)
        }
        _ => None,
    };
    let codec = form.codec.or(native).unwrap_or(Codec::H264);
    let mut chain = Vec::new();
    if native != Some(codec) || form.halved {
        if name != "video/x-raw" {
            let failed = |e: crate::ingest::Failure| TestCameraError::Missing(e.to_string());
            chain.push(decoder::create(&caps, true, 2, &[]).map_err(failed)?);
        }
        chain.push(make("videoconvert")?);
        if form.halved {
            chain.extend([make("videoscale")?, halved(&caps)?]);
        }
        chain.push(encoder(codec)?);
    }
    let parser = make(match codec {
        Codec::H264 => "h264parse",
        Codec::H265 => "h265parse",
        Codec::Mpeg4 => "mpeg4videoparse",
    })?;
    // Parameter sets before every key frame: a client may come at any time.
    parser.set_property("config-interval", -1i32);
    let filter = make("capsfilter")?;
    let whole = gst::Caps::builder(codec.media_type());
    let filtered = match codec {
        Codec::H264 | Codec::H265 => whole.field("stream-format", "byte-stream").field("alignment", "au"),
        Codec::Mpeg4 => whole.field("mpegversion", 4i32).field("parsed", true),
    };
    filter.set_property("caps", filtered.build());
    chain.extend([parser, filter]);

    let broken = |e: gst::glib::BoolError| TestCameraError::Missing(format!("GStreamer graph: {e}"));
    pipeline.add_many(&chain).map_err(broken)?;
    gst::Element::link_many(chain.iter().chain([sink])).map_err(broken)?;
    for element in chain.iter().rev() {
        element.sync_state_with_parent().map_err(broken)?;
    }
    let entry = chain[0].static_pad("sink");
    let entry = entry.ok_or_else(|| TestCameraError::Missing("an element without a sink pad".into()))?;
    pad.link(&entry).map_err(|e| TestCameraError::Missing(format!("GStreamer graph: {e}")))?;
    Ok(Some(()))
}

/// Lets only pictures of half the size through.
fn halved(caps: &gst::Caps) -> Result<gst::Element, TestCameraError> {
    let size = |name| caps.structure(0).and_then(|s| s.get::<i32>(name).ok()).filter(|size| *size >= 4);
    let (Some(width), Some(height)) = (size("width"), size("height")) else {
        return Err(TestCameraError::Missing(format!("a picture that can be halved: {caps}")));
    };
    let filter = make("capsfilter")?;
    let caps =
        gst::Caps::builder("video/x-raw").field("width", width / 4 * 2).field("height", height / 4 * 2);
    filter.set_property("caps", caps.build());
    Ok(filter)
}

/// Good pictures, no B frames, a key frame at least every 50 frames.
fn encoder(codec: Codec) -> Result<gst::Element, TestCameraError> {
    match codec {
        Codec::H264 => {
            let encoder = make("x264enc")?;
            encoder.set_property_from_str("speed-preset", "veryfast");
            encoder.set_property_from_str("pass", "qual");
            encoder.set_property_from_str("quantizer", "18");
            encoder.set_property("bframes", 0u32);
            encoder.set_property("key-int-max", 50u32);
            Ok(encoder)
        }
        Codec::Mpeg4 => Err(TestCameraError::Missing("MPEG-4 part 2 is passed on, not encoded".into())),
        Codec::H265 => {
            let encoder = make("x265enc")?;
            encoder.set_property_from_str("speed-preset", "veryfast");
            encoder.set_property("key-int-max", 50i32);
            encoder.set_property("option-string", "bframes=0:crf=20:log-level=none");
            Ok(encoder)
        }
    }
}

fn make(name: &str) -> Result<gst::Element, TestCameraError> {
    gst::ElementFactory::make(name).build().map_err(|_| {
        TestCameraError::Missing(format!("GStreamer has no `{name}`: install {}", package_of(name)))
    })
}

/// Takes a pipeline down on every way out.
struct Stopped(gst::Pipeline);

impl Drop for Stopped {
    fn drop(&mut self) {
        let _ = self.0.set_state(gst::State::Null);
    }
}

/// Whether the sink already has its stream.
trait Linked {
    fn sinks_are_linked(&self) -> bool;
}

impl Linked for gst_app::AppSink {
    fn sinks_are_linked(&self) -> bool {
        self.static_pad("sink").is_none_or(|pad| pad.is_linked())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Times in steps of 40 ms: those of the file in decoding order, and what is made of them.
    fn check(pts: &[u64], even: bool, expected_pts: &[u64], round: u64) {
        const STEP: u64 = 40_000_000;
        gst::init().unwrap();
        let raw = |&p| Raw { data: vec![0], pts: Some(p * STEP), key: true };
        let (units, length) = retime(pts.iter().map(raw).collect(), STEP, even);
        let steps = |t: gst::ClockTime| t.nseconds() / STEP;
        assert_eq!(units.iter().map(|u| steps(u.pts)).collect::<Vec<_>>(), expected_pts);
        assert_eq!(length, round * STEP);
        let dts: Vec<u64> = units.iter().map(|u| steps(u.dts)).collect();
        assert!(dts.is_sorted() && dts.iter().zip(expected_pts).all(|(d, p)| d <= p), "{dts:?}");
    }

    #[test]
    fn times_begin_at_zero_and_keep_their_distances() {
        check(&[5, 6, 7], false, &[0, 1, 2], 3);
        check(&[0, 1, 5], false, &[0, 1, 5], 6);
        check(&[0, 1, 5], true, &[0, 1, 2], 3);
        // I P B B: decoded 0 3 1 2.
        check(&[2, 5, 3, 4], false, &[1, 4, 2, 3], 4);
        check(&[0, 30, 10, 20], true, &[1, 4, 2, 3], 4);
        check(&[], false, &[], 0);
    }
}
