//! The JSON form of the track stream. Wire types live here and nowhere further in.
//!
//! Numbers are rounded to what they can mean: pixels and pixels per second to 0.01, probabilities to
//! 0.0001. `capture_ts` keeps nanoseconds, so that JSON and protobuf say the same instant.

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Serialize, Serializer};

use super::{Gap, report::class_name};
use crate::types::{FrameTracks, TrackReport};

#[derive(Serialize)]
struct Frame<'a> {
    camera: &'a str,
    epoch: u64,
    seq: u64,
    frame: u64,
    capture_ts: CaptureTs,
    clock: &'static str,
    width: u32,
    height: u32,
    tracks: Vec<Track<'a>>,
    ended: Vec<u64>,
}

#[derive(Serialize)]
struct Track<'a> {
    id: u64,
    state: &'static str,
    class: std::borrow::Cow<'a, str>,
    #[serde(rename = "box")]
    bbox: [f64; 4],
    confidence: f64,
    link: f64,
    velocity: [f64; 2],
    matched: bool,
}

#[derive(Serialize)]
struct GapMessage<'a> {
    camera: &'a str,
    epoch: u64,
    gap: Hole,
}

#[derive(Serialize)]
struct Hole {
    first: u64,
    last: u64,
}

/// RFC 3339 with nine decimals, in UTC.
pub(crate) struct CaptureTs(pub(crate) i64);

impl Serialize for CaptureTs {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // Every i64 of nanoseconds is a date between the years 1677 and 2262.
        let at = Timestamp::from_nanosecond(i128::from(self.0)).map_err(serde::ser::Error::custom)?;
        serializer.collect_str(&format_args!("{at:.9}"))
    }
}

/// `value` rounded to a multiple of `1 / per_unit`; what is no number becomes 0, never `null`.
pub(super) fn round(value: f64, per_unit: f64) -> f64 {
    let rounded = (value * per_unit).round() / per_unit;
    // Adding zero turns -0 into 0.
    if rounded.is_finite() { rounded + 0.0 } else { 0.0 }
}

fn pixels(value: f64) -> f64 {
    round(value, 100.0)
}

fn probability(value: f64) -> f64 {
    round(value, 10_000.0)
}

impl<'a> Track<'a> {
    fn new(track: &TrackReport, classes: &'a [String]) -> Self {
        let b = track.bbox;
        Self {
            id: track.id.0,
            state: track.state.as_str(),
            class: class_name(classes, track.class),
            bbox: [b.x, b.y, b.w, b.h].map(pixels),
            confidence: probability(track.confidence),
            link: probability(track.link),
            velocity: track.velocity.map(pixels),
            matched: track.matched,
        }
    }
}

pub(super) fn frame(report: &FrameTracks, classes: &[String]) -> Bytes {
    encode(&Frame {
        camera: report.camera.as_str(),
        epoch: report.epoch.0,
        seq: report.seq,
        frame: report.frame,
        capture_ts: CaptureTs(report.capture.unix_ns),
        clock: report.capture.clock.as_str(),
        width: report.width,
        height: report.height,
        tracks: report.tracks.iter().map(|track| Track::new(track, classes)).collect(),
        ended: report.ended.iter().map(|id| id.0).collect(),
    })
}

pub(super) fn gap(gap: &Gap) -> Bytes {
    encode(&GapMessage {
        camera: gap.camera.as_str(),
        epoch: gap.epoch.0,
        gap: Hole { first: gap.first, last: gap.last },
    })
}

pub(super) fn encode(message: &impl Serialize) -> Bytes {
    // Serialising fails for maps with keys that are no strings and for failing Serialize
    // implementations; these structs have neither.
    serde_json::to_vec(message).expect("wire structs always serialise").into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::publish::report::tests::example;
    use crate::types::{CameraId, Epoch};

    #[test]
    fn a_frame_is_exactly_this() {
        let (tracks, classes) = example();
        let expected = concat!(
            r#"{"camera":"gate","epoch":2,"seq":7,"frame":9,"capture_ts":"2026-01-02T03:04:05.000000006Z","#,
            r#""clock":"rtcp","width":640,"height":480,"tracks":[{"id":3,"state":"confirmed","class":"person","#,
            r#""box":[-1.5,2.35,30.0,60.13],"confidence":0.9123,"link":0.5,"velocity":[0.0,-12.35],"matched":true},"#,
            r#"{"id":4,"state":"lost","class":"class-9","box":[0.0,0.0,1.0,1.0],"confidence":0.0,"link":0.0,"#,
            r#""velocity":[0.0,0.0],"matched":false}],"ended":[1,2]}"#,
        );
        assert_eq!(std::str::from_utf8(&frame(&tracks, &classes)).unwrap(), expected);
    }

    #[test]
    fn a_gap_is_exactly_this() {
        let hole = Gap { camera: CameraId::new("gate").unwrap(), epoch: Epoch(2), first: 5, last: 6 };
        let expected = r#"{"camera":"gate","epoch":2,"gap":{"first":5,"last":6}}"#;
        assert_eq!(std::str::from_utf8(&gap(&hole)).unwrap(), expected);
    }

    #[test]
    fn every_instant_has_a_date() {
        for ns in [i64::MIN, -1, 0, i64::MAX] {
            assert!(serde_json::to_string(&CaptureTs(ns)).is_ok(), "{ns}");
        }
    }
}
