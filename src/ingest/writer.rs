//! Frames -> an MP4 file (H.264), for annotated copies.

use std::path::Path;
use std::time::{Duration, Instant};

use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;
use gstreamer_video as gst_video;

use super::graph::package_of;
use super::init;
use crate::types::{Image, MediaTime, YuvMatrix, YuvRange};

/// What pixels a [`VideoWriter`] is given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pixels {
    /// Packed RGB, 3 bytes a pixel.
    Rgb,
    /// [`Image`]s, of this range and matrix.
    I420(YuvRange, YuvMatrix),
}

/// Why a video could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriterError {
    /// No encoder, no muxer.
    #[error("cannot write video: GStreamer has no {0}")]
    Missing(String),
    /// The file cannot be created.
    #[error("cannot write video {path:?}: {source}")]
    File {
        /// Which.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// A frame of the wrong size or kind.
    #[error("cannot write this frame: {0}")]
    Frame(String),
    /// Encoding or writing failed, in GStreamer's words.
    #[error("writing video {path:?} failed: {what}")]
    Failed {
        /// Which.
        path: String,
        /// Why.
        what: String,
    },
}

/// Writes an MP4 file. Without [`VideoWriter::finish`] the file cannot be played.
pub struct VideoWriter {
    path: String,
    size: (u32, u32),
    pixels: Pixels,
    info: gst_video::VideoInfo,
    pipeline: gst::Pipeline,
    source: gst_app::AppSrc,
    first: Option<MediaTime>,
    last_ns: Option<u64>,
}

impl VideoWriter {
    /// Creates the file. `fps` is what the file announces; the frames' own times count.
    /// An odd last row or column is cut off, as H.264 needs even sizes.
    pub fn create(
        path: &Path,
        (width, height): (u32, u32),
        fps: f64,
        pixels: Pixels,
    ) -> Result<Self, WriterError> {
        init().map_err(|e| WriterError::Missing(e.to_string()))?;
        let shown = path.display().to_string();
        let file = |source| WriterError::File { path: shown.clone(), source };
        // GStreamer would report it only with the first frame.
        std::fs::File::create(path).map_err(file)?;
        if width < 2 || height < 2 {
            return Err(WriterError::Frame(format!("{width}x{height} is too small")));
        }
        let rate = gst::Fraction::approximate_f64(fps).filter(|r| r.numer() > 0);
        let rate = rate.unwrap_or(gst::Fraction::new(25, 1));
        let format = match pixels {
            Pixels::Rgb => gst_video::VideoFormat::Rgb,
            Pixels::I420(..) => gst_video::VideoFormat::I420,
        };
        let mut info = gst_video::VideoInfo::builder(format, width, height).fps(rate);
        let colorimetry;
        if let Pixels::I420(range, matrix) = pixels {
            colorimetry = gst_video::VideoColorimetry::new(
                if range == YuvRange::Full {
                    gst_video::VideoColorRange::Range0_255
                } else {
                    gst_video::VideoColorRange::Range16_235
                },
                if matrix == YuvMatrix::Bt709 {
                    gst_video::VideoColorMatrix::Bt709
                } else {
                    gst_video::VideoColorMatrix::Bt601
                },
                gst_video::VideoTransferFunction::Bt709,
                gst_video::VideoColorPrimaries::Bt709,
            );
            info = info.colorimetry(&colorimetry);
        }
        let failed =
            |e: gst::glib::BoolError| WriterError::Failed { path: shown.clone(), what: e.to_string() };
        let info = info.build().map_err(failed)?;

        let source = gst_app::AppSrc::builder()
            .caps(&info.to_caps().map_err(failed)?)
            .format(gst::Format::Time)
            .block(true)
            .max_buffers(4)
            .max_bytes(0)
            .build();
        let crop = make("videocrop")?;
        crop.set_property("right", (width % 2) as i32);
        crop.set_property("bottom", (height % 2) as i32);
        let (encoder, parser, muxer, sink) =
            (encoder()?, make("h264parse")?, make("mp4mux")?, make("filesink")?);
        sink.set_property("location", path);
        let chain = [source.upcast_ref(), &crop, &make("videoconvert")?, &encoder, &parser, &muxer, &sink];
        let pipeline = gst::Pipeline::new();
        pipeline.add_many(chain).map_err(failed)?;
        gst::Element::link_many(chain).map_err(failed)?;
        let writer = Self {
            path: shown,
            size: (width, height),
            pixels,
            info,
            pipeline,
            source,
            first: None,
            last_ns: None,
        };
        writer.pipeline.set_state(gst::State::Playing).map_err(|e| writer.error(e.to_string()))?;
        Ok(writer)
    }

    /// Adds a picture; its range and matrix must be those announced. Blocks while the encoder is behind.
    pub fn write(&mut self, image: &Image, time: MediaTime) -> Result<(), WriterError> {
        if self.pixels != Pixels::I420(image.range, image.matrix) || self.size != (image.width, image.height)
        {
            return Err(WriterError::Frame(format!("{image:?} into {:?} {:?}", self.size, self.pixels)));
        }
        let mut bytes = vec![0u8; self.info.size()];
        for i in 0..3 {
            let ((from, from_stride), (w, h)) = (image.plane(i), image.plane_size(i));
            let (at, stride) = (self.info.offset()[i], self.info.stride()[i] as usize);
            for (row, from) in from.chunks(from_stride).take(h).enumerate() {
                bytes[at + row * stride..][..w].copy_from_slice(&from[..w]);
            }
        }
        self.push(bytes, time)
    }

    /// Adds a picture of packed RGB rows without padding. Blocks while the encoder is behind.
    pub fn write_rgb(&mut self, rgb: &[u8], time: MediaTime) -> Result<(), WriterError> {
        let (row, rows) = (self.size.0 as usize * 3, self.size.1 as usize);
        if self.pixels != Pixels::Rgb || rgb.len() != row * rows {
            return Err(WriterError::Frame(format!(
                "{} bytes into {:?} {:?}",
                rgb.len(),
                self.size,
                self.pixels
            )));
        }
        let stride = self.info.stride()[0] as usize;
        let mut bytes = vec![0u8; self.info.size()];
        for (to, from) in bytes.chunks_mut(stride).zip(rgb.chunks(row)) {
            to[..row].copy_from_slice(from);
        }
        self.push(bytes, time)
    }

    fn push(&mut self, bytes: Vec<u8>, time: MediaTime) -> Result<(), WriterError> {
        let first = *self.first.get_or_insert(time);
        let ns = u64::try_from(time.0 - first.0).ok().filter(|&ns| self.last_ns.is_none_or(|last| ns > last));
        let ns =
            ns.ok_or_else(|| WriterError::Frame("its time is not later than the last frame's".into()))?;
        self.last_ns = Some(ns);
        let mut buffer = gst::Buffer::from_mut_slice(bytes);
        if let Some(buffer) = buffer.get_mut() {
            buffer.set_pts(gst::ClockTime::from_nseconds(ns));
        }
        let pushed = self.source.push_buffer(buffer);
        let problem = self.bus_error();
        match (pushed, problem) {
            (_, Some(what)) => Err(self.error(what)),
            (Err(flow), None) => Err(self.error(flow.to_string())),
            (Ok(_), None) => Ok(()),
        }
    }

    /// Encodes what is left and closes the file. A file without frames is an error.
    pub fn finish(self) -> Result<(), WriterError> {
        if self.first.is_none() {
            return Err(self.error("there were no frames".into()));
        }
        self.source.end_of_stream().map_err(|e| self.error(e.to_string()))?;
        let bus = self.pipeline.bus().ok_or_else(|| self.error("no bus".into()))?;
        let deadline = Instant::now() + Duration::from_secs(120);
        let wait = gst::ClockTime::from_seconds(120);
        match bus.timed_pop_filtered(wait, &[gst::MessageType::Eos, gst::MessageType::Error]) {
            Some(message) => match message.view() {
                gst::MessageView::Error(e) => Err(self.error(describe(e))),
                _ => Ok(()),
            },
            None if Instant::now() >= deadline => Err(self.error("the encoder does not finish".into())),
            None => Err(self.error("the pipeline was torn down".into())),
        }
    }

    fn bus_error(&self) -> Option<String> {
        let message = self.pipeline.bus()?.pop_filtered(&[gst::MessageType::Error])?;
        match message.view() {
            gst::MessageView::Error(e) => Some(describe(e)),
            _ => None,
        }
    }

    fn error(&self, what: String) -> WriterError {
        WriterError::Failed { path: self.path.clone(), what }
    }
}

impl Drop for VideoWriter {
    fn drop(&mut self) {
        // Failing to stop leaves nothing more to do.
        let _ = self.pipeline.set_state(gst::State::Null);
    }
}

fn describe(error: &gst::message::Error) -> String {
    format!("{} ({})", error.error(), error.debug().unwrap_or_default())
}

/// x264 where it is installed, else OpenH264.
fn encoder() -> Result<gst::Element, WriterError> {
    if let Ok(encoder) = make("x264enc") {
        encoder.set_property_from_str("speed-preset", "veryfast");
        encoder.set_property_from_str("pass", "qual");
        encoder.set_property_from_str("quantizer", "20");
        return Ok(encoder);
    }
    let encoder = make("openh264enc")?;
    encoder.set_property_from_str("rate-control", "quality");
    encoder.set_property_from_str("bitrate", "6000000");
    Ok(encoder)
}

fn make(name: &str) -> Result<gst::Element, WriterError> {
    gst::ElementFactory::make(name)
        .build()
        .map_err(|_| WriterError::Missing(format!("`{name}`: install {}", package_of(name))))
}
