//! What the tracker says about one frame.

use super::{BBox, CameraId, CaptureTime, ClassId, Epoch, MediaTime, TrackId};

/// A track's stage of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TrackState {
    /// Not believed: just born, or matched to a detection that its past speaks against.
    Tentative,
    /// Believed and in view, or missed for a moment in which its predicted box still stands.
    Confirmed,
    /// Believed, but not seen now; may be found again.
    Lost,
}

impl TrackState {
    /// All states, in the order of life.
    pub const ALL: [TrackState; 3] = [TrackState::Tentative, TrackState::Confirmed, TrackState::Lost];

    /// The name used on the wire.
    pub fn as_str(self) -> &'static str {
        match self {
            TrackState::Tentative => "tentative",
            TrackState::Confirmed => "confirmed",
            TrackState::Lost => "lost",
        }
    }
}

/// One track at one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackReport {
    /// Identity within the camera's epoch.
    pub id: TrackId,
    /// Stage of life.
    pub state: TrackState,
    /// Class of its detections.
    pub class: ClassId,
    /// Filtered box in pixels (predicted, when not matched in this frame).
    pub bbox: BBox,
    /// Score of its last detection, `[0, 1]`.
    pub confidence: f64,
    /// Link probability of this frame's match, `[0, 1]`; 0 when it was not matched, 1 at birth.
    pub link: f64,
    /// Velocity of the centre in pixels per second.
    pub velocity: [f64; 2],
    /// Whether a detection of this frame was matched to it (false: the box is a prediction).
    pub matched: bool,
}

/// Everything the tracker says about one frame of one camera.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameTracks {
    /// Whose.
    pub camera: CameraId,
    /// The generation of track ids.
    pub epoch: Epoch,
    /// Number of this report: grows by one with every report of the camera within its epoch.
    pub seq: u64,
    /// 0-based index of the decoded frame within the epoch.
    pub frame: u64,
    /// Place on the camera's time line.
    pub time: MediaTime,
    /// When the frame was captured.
    pub capture: CaptureTime,
    /// Width of the frame in pixels.
    pub width: u32,
    /// Height of the frame in pixels.
    pub height: u32,
    /// Live tracks in the order of their ids.
    pub tracks: Vec<TrackReport>,
    /// Tracks that died at this frame, in the order of their ids.
    pub ended: Vec<TrackId>,
}
