//! What the ingest tests share: clips whose frames carry their number, and a sink that records.
#![allow(dead_code)] // each test binary uses its part

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use gakp::ingest::{Opened, Pixels, RawFrame, SourceEvent, SourceHandle, SourceSpec, VideoWriter, start};
use gakp::types::{CameraId, Image, MediaTime, Plane, YuvMatrix, YuvRange};
use tempfile::TempPath;

/// Nothing here takes longer, even on a loaded machine.
pub const PATIENCE: Duration = Duration::from_secs(40);

pub fn id(name: &str) -> CameraId {
    CameraId::new(name).unwrap()
}

/// The luma of frame `n` of a numbered clip, as a number: it repeats after 50 frames.
pub fn brightness_index(n: usize) -> usize {
    n % 50
}

/// A small H.264 clip in a temporary file. Frame `n` is plain grey of luma `30 + 4 (n mod 50)`.
pub struct Clip(TempPath);

impl Clip {
    pub fn numbered(frames: usize, fps: f64) -> Self {
        Self::numbered_sized(frames, fps, (160, 120))
    }

    pub fn numbered_sized(frames: usize, fps: f64, (width, height): (u32, u32)) -> Self {
        let path = tempfile::Builder::new().suffix(".mp4").tempfile().unwrap().into_temp_path();
        let pixels = Pixels::I420(YuvRange::Limited, YuvMatrix::Bt601);
        let mut writer = VideoWriter::create(&path, (width, height), fps, pixels).unwrap();
        for n in 0..frames {
            let luma = (width * height) as usize;
            let mut bytes = vec![128u8; luma + luma / 2];
            bytes[..luma].fill(30 + 4 * brightness_index(n) as u8);
            let (w, h) = (width as usize, height as usize);
            let planes = [
                Plane { offset: 0, stride: w },
                Plane { offset: w * h, stride: w / 2 },
                Plane { offset: w * h * 5 / 4, stride: w / 2 },
            ];
            let image = Image::i420(
                (width, height),
                YuvRange::Limited,
                YuvMatrix::Bt601,
                planes,
                std::sync::Arc::new(bytes),
            );
            writer.write(&image.unwrap(), MediaTime::from_secs(n as f64 / fps)).unwrap();
        }
        writer.finish().unwrap();
        Self(path)
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The same video without a container.
    pub fn as_byte_stream(&self) -> Clip {
        self.through(
            ".h264",
            "qtdemux ! h264parse config-interval=-1 ! video/x-h264,stream-format=byte-stream",
        )
    }

    /// Runs the file through a piece of a GStreamer pipeline.
    pub fn through(&self, suffix: &str, elements: &str) -> Clip {
        use gstreamer as gst;
        use gstreamer::prelude::*;
        gst::init().unwrap();
        let path = tempfile::Builder::new().suffix(suffix).tempfile().unwrap().into_temp_path();
        let text = format!(
            "filesrc location=\"{}\" ! {elements} ! filesink location=\"{}\"",
            self.0.display(),
            path.display()
        );
        let pipeline = gst::parse::launch(&text).unwrap();
        pipeline.set_state(gst::State::Playing).unwrap();
        let ended = pipeline.bus().unwrap().timed_pop_filtered(
            gst::ClockTime::from_seconds(30),
            &[gst::MessageType::Eos, gst::MessageType::Error],
        );
        pipeline.set_state(gst::State::Null).unwrap();
        match ended.expect("the clip was not made in time").view() {
            gst::MessageView::Eos(_) => Clip(path),
            other => panic!("{other:?}"),
        }
    }
}

/// The number that a frame of a numbered clip carries.
pub fn index_of(image: &Image) -> usize {
    let ((bytes, stride), (w, h)) = (image.plane(0), image.plane_size(0));
    let sum: u64 = bytes.chunks(stride).take(h).flat_map(|row| &row[..w]).map(|&b| u64::from(b)).sum();
    let mean = sum as f64 / (w * h) as f64;
    ((mean - 30.0) / 4.0).round() as usize
}

/// Everything that a source said. Pictures are read at once: holding them starves a decoder's pool.
#[derive(Default)]
pub struct Recorder {
    pub events: Vec<SourceEvent>,
    indices: Vec<usize>,
}

impl Recorder {
    pub fn run_to_end(spec: SourceSpec) -> Self {
        Self::run_to_end_slowly(spec, Duration::ZERO)
    }

    pub fn run_to_end_slowly(spec: SourceSpec, nap: Duration) -> Self {
        let (mut live, mut seen) = (Live::start_slow(spec, nap), Self::default());
        while let Some(event) = live.next() {
            seen.add(event);
        }
        live.stop();
        seen
    }

    pub fn run_for_frames(spec: SourceSpec, count: usize) -> Self {
        let (mut live, mut seen) = (Live::start(spec), Self::default());
        while seen.indices.len() < count {
            seen.add(live.next().expect("the source ended early"));
        }
        live.stop();
        seen
    }

    pub fn add(&mut self, event: SourceEvent) {
        if let SourceEvent::Frame(frame) = &event {
            self.indices.push(index_of(&frame.image));
        }
        self.events.push(event);
    }

    pub fn frames(&self) -> impl Iterator<Item = &RawFrame> {
        self.events.iter().filter_map(|e| if let SourceEvent::Frame(frame) = e { Some(frame) } else { None })
    }

    pub fn indices(&self) -> Vec<usize> {
        self.indices.clone()
    }

    pub fn opened(&self) -> &Opened {
        self.events
            .iter()
            .find_map(|e| if let SourceEvent::Opened(opened) = e { Some(opened) } else { None })
            .unwrap_or_else(|| panic!("never opened: {:?}", self.events))
    }
}

/// A running source whose events come through a bounded channel.
pub struct Live {
    events: mpsc::Receiver<SourceEvent>,
    handle: SourceHandle,
}

impl Live {
    pub fn start(spec: SourceSpec) -> Self {
        Self::start_slow(spec, Duration::ZERO)
    }

    fn start_slow(spec: SourceSpec, nap: Duration) -> Self {
        let (sender, events) = mpsc::sync_channel(1000);
        let handle = start(&id("test"), spec, move |event| {
            std::thread::sleep(nap);
            if sender.send(event).is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        });
        Self { events, handle: handle.unwrap() }
    }

    /// The next event; `None` when the source is finished.
    pub fn next(&mut self) -> Option<SourceEvent> {
        match self.events.recv_timeout(PATIENCE) {
            Ok(event) => Some(event),
            Err(mpsc::RecvTimeoutError::Disconnected) => None,
            Err(mpsc::RecvTimeoutError::Timeout) => panic!("nothing happened for {PATIENCE:?}"),
        }
    }

    /// Reads on until `wanted` gives something.
    pub fn wait<T>(&mut self, what: &str, mut wanted: impl FnMut(&SourceEvent) -> Option<T>) -> T {
        let begun = Instant::now();
        while let Some(event) = self.next() {
            if let Some(found) = wanted(&event) {
                return found;
            }
            assert!(begun.elapsed() < PATIENCE, "no {what} within {PATIENCE:?}");
        }
        panic!("the source ended before {what}");
    }

    pub fn wait_frame(&mut self) -> RawFrame {
        self.wait("frame", |e| if let SourceEvent::Frame(frame) = e { Some(frame.clone()) } else { None })
    }

    pub fn wait_lost(&mut self) -> (gakp::ingest::Failure, Option<Duration>) {
        self.wait("loss", |e| match e {
            SourceEvent::Lost { reason, retry_in } => Some((reason.clone(), *retry_in)),
            _ => None,
        })
    }

    pub fn stop(self) {
        drop(self.events);
        self.handle.stop();
    }
}
