//! The vocabulary of the flow: boxes, detections, embeddings, identifiers, times, frames, tracks.
//!
//! Pure: no I/O, no clock, no serialization. Wire forms live at the edge (`publish`).

mod bbox;
mod detection;
mod frame;
mod ids;
mod time;
mod tracks;

pub use bbox::BBox;
pub use detection::{Detection, Embedding};
pub use frame::{Frame, Image, PixelBuffer, Plane, YuvMatrix, YuvRange};
pub use ids::{CameraId, CameraIdError, ClassId, Epoch, TrackId, is_name};
pub use time::{CaptureTime, Clock, MediaTime};
pub use tracks::{FrameTracks, TrackReport, TrackState};
