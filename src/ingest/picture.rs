//! A decoded buffer of GStreamer, seen as an [`Image`] without a copy.

use std::sync::Arc;

use gstreamer as gst;
use gstreamer_video as gst_video;

use crate::types::{Image, PixelBuffer, Plane, YuvMatrix, YuvRange};

/// A decoder's buffer, mapped for as long as somebody holds the picture.
struct Mapped(gst::MappedBuffer<gst::buffer::Readable>);

impl PixelBuffer for Mapped {
    fn bytes(&self) -> &[u8] {
        self.0.as_slice()
    }
}

/// Wraps an I420 buffer. `None` when it is not what its caps promise.
pub(crate) fn image(buffer: gst::Buffer, info: &gst_video::VideoInfo) -> Option<Image> {
    // The meta tells the real layout: decoders pad their rows. The caps alone give the packed one.
    let layout = |offset: &[usize], stride: &[i32]| -> Option<[Plane; 3]> {
        let plane = |i: usize| {
            Some(Plane { offset: *offset.get(i)?, stride: usize::try_from(*stride.get(i)?).ok()? })
        };
        Some([plane(0)?, plane(1)?, plane(2)?])
    };
    let planes = match buffer.meta::<gst_video::VideoMeta>() {
        Some(meta) => layout(meta.offset(), meta.stride())?,
        None => layout(info.offset(), info.stride())?,
    };
    let range = match info.colorimetry().range() {
        gst_video::VideoColorRange::Range0_255 => YuvRange::Full,
        _ => YuvRange::Limited,
    };
    let matrix = match info.colorimetry().matrix() {
        gst_video::VideoColorMatrix::Bt709 | gst_video::VideoColorMatrix::Bt2020 => YuvMatrix::Bt709,
        gst_video::VideoColorMatrix::Bt601 | gst_video::VideoColorMatrix::Fcc => YuvMatrix::Bt601,
        // What players assume of a stream that does not say.
        _ if info.height() > 576 => YuvMatrix::Bt709,
        _ => YuvMatrix::Bt601,
    };
    let mapped = buffer.into_mapped_buffer_readable().ok()?;
    Image::i420((info.width(), info.height()), range, matrix, planes, Arc::new(Mapped(mapped)))
}

/// Seconds from 1900, where NTP counts from, to 1970.
const NTP_TO_UNIX: i64 = 2_208_988_800;

/// The camera's own wall clock at capture (Unix ns), where its RTCP sender reports told it.
pub(crate) fn rtcp_time(buffer: &gst::BufferRef) -> Option<i64> {
    buffer
        .iter_meta::<gst::ReferenceTimestampMeta>()
        .find(|meta| meta.reference().structure(0).is_some_and(|s| s.name() == "timestamp/x-ntp"))
        .and_then(|meta| i64::try_from(meta.timestamp().nseconds()).ok())
        .map(|ntp| ntp - NTP_TO_UNIX * 1_000_000_000)
}
