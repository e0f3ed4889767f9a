//! Camera -> frames.
//!
//! [`start`] opens a [`SourceSpec`] on a thread of its own and hands every decoded frame, and
//! everything else that happens, to a sink. A camera is reconnected for ever: its door is knocked at before GStreamer
//! goes in, and its connection can be cut when GStreamer does not come out.
//!
//! ```text
//! rtspsrc -> depayloader \
//! urisourcebin, filesrc, v4l2src -> parsebin -> [queue] -> decoder -> videoconvert -> appsink -> sink
//! videotestsrc ---------------------------------------------------^
//! ```
//!
//! Queues, all bounded: encoded video before a camera's decoder, at most 2 s old and 200 frames (then
//! skipped up to the next key frame and reported as [`SourceEvent::Skipped`]); 3 decoded frames before
//! the sink (then the decoder waits). Nothing else is dropped, but for damaged frames
//! ([`SourceEvent::Corrupt`]) and, over UDP, packets that come too late.

mod backlog;
mod backoff;
mod clock;
mod decoder;
mod failure;
mod graph;
mod knock;
mod line;
pub mod memory;
mod pattern;
mod picture;
mod source;
mod spec;
#[cfg(feature = "testcam")]
pub mod testcam;
mod timeline;
mod url;
mod writer;

pub use failure::Failure;
pub use pattern::TestPattern;
pub use source::{Opened, RawFrame, SourceEvent, SourceHandle, start};
pub use spec::{Pacing, SourceError, SourceSpec, Transport};
pub use url::SourceUrl;
pub use writer::{Pixels, VideoWriter, WriterError};

/// Starts GStreamer, once.
pub(crate) fn init() -> Result<(), SourceError> {
    gstreamer::init().map_err(|e| SourceError::Gstreamer(e.to_string()))
}
