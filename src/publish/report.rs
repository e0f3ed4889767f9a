//! A published report, encoded at most once per format however many subscribers send it.

use std::sync::{Arc, OnceLock};

use bytes::Bytes;

use super::{Gap, json, protobuf};
use crate::types::{ClassId, FrameTracks};

/// What the hub hands to subscribers: one frame's tracks, and their wire forms once somebody asked.
#[derive(Debug)]
pub struct Report {
    /// The tracks themselves.
    pub tracks: Arc<FrameTracks>,
    classes: Arc<[String]>,
    json: OnceLock<Bytes>,
    protobuf: OnceLock<Bytes>,
}

impl Report {
    /// Wraps `tracks`; `classes[i]` names class `i`.
    pub fn new(tracks: Arc<FrameTracks>, classes: Arc<[String]>) -> Self {
        Self { tracks, classes, json: OnceLock::new(), protobuf: OnceLock::new() }
    }

    /// The JSON message (UTF-8), encoded by the first caller and shared with the others.
    pub fn json(&self) -> Bytes {
        self.json.get_or_init(|| encode_json(&self.tracks, &self.classes)).clone()
    }

    /// The protobuf message, encoded by the first caller and shared with the others.
    pub fn protobuf(&self) -> Bytes {
        self.protobuf.get_or_init(|| encode_protobuf(&self.tracks, &self.classes)).clone()
    }
}

/// The name of a class on the wire; `class-N` where the table is too short, so that a consumer can
/// still tell classes apart.
pub(crate) fn class_name(classes: &[String], class: ClassId) -> std::borrow::Cow<'_, str> {
    match classes.get(usize::from(class.0)) {
        Some(name) => name.as_str().into(),
        None => format!("class-{}", class.0).into(),
    }
}

/// One frame's tracks as a JSON message (docs/api.md).
pub fn encode_json(tracks: &FrameTracks, classes: &[String]) -> Bytes {
    json::frame(tracks, classes)
}

/// One frame's tracks as a `gakp.v1.TrackMessage`.
pub fn encode_protobuf(tracks: &FrameTracks, classes: &[String]) -> Bytes {
    protobuf::frame(tracks, classes)
}

/// A gap as a JSON message: told apart by its field `gap`.
pub fn encode_gap_json(gap: &Gap) -> Bytes {
    json::gap(gap)
}

/// A gap as a `gakp.v1.TrackMessage`.
pub fn encode_gap_protobuf(gap: &Gap) -> Bytes {
    protobuf::gap(gap)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::types::{
        BBox, CameraId, CaptureTime, Clock, Epoch, MediaTime, TrackId, TrackReport, TrackState,
    };

    /// A report with something in every field.
    pub(crate) fn example() -> (FrameTracks, Vec<String>) {
        let track = TrackReport {
            id: TrackId(3),
            state: TrackState::Confirmed,
            class: ClassId(0),
            bbox: BBox::new(-1.5, 2.345_1, 30.0, 60.129),
            confidence: 0.912_34,
            link: 0.5,
            velocity: [-0.001, -12.345_1],
            matched: true,
        };
        let lost = TrackReport {
            id: TrackId(4),
            state: TrackState::Lost,
            class: ClassId(9),
            bbox: BBox::new(0.0, 0.0, 1.0, 1.0),
            confidence: f64::NAN,
            link: 0.0,
            velocity: [0.0, 0.0],
            matched: false,
        };
        let tracks = FrameTracks {
            camera: CameraId::new("gate").unwrap(),
            epoch: Epoch(2),
            seq: 7,
            frame: 9,
            time: MediaTime(0),
            capture: CaptureTime { unix_ns: 1_767_323_045_000_000_006, clock: Clock::Rtcp },
            width: 640,
            height: 480,
            tracks: vec![track, lost],
            ended: vec![TrackId(1), TrackId(2)],
        };
        (tracks, vec!["person".to_owned()])
    }

    #[test]
    fn a_report_is_encoded_once() {
        let (tracks, classes) = example();
        let report = Report::new(Arc::new(tracks), classes.into());
        assert_eq!(report.json().as_ptr(), report.json().as_ptr());
        assert_eq!(report.protobuf().as_ptr(), report.protobuf().as_ptr());
    }
}
