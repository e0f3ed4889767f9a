//! The protobuf form of the track stream, `proto/tracks.proto`.

use bytes::Bytes;
use prost::Message;

use super::{Gap, report::class_name};
use crate::types::{Clock, FrameTracks, TrackReport, TrackState};

/// The messages of `proto/tracks.proto` (package `gakp.v1`), generated.
#[allow(missing_docs, clippy::doc_markdown)]
pub mod wire {
    include!(concat!(env!("OUT_DIR"), "/gakp.v1.rs"));
}

use wire::track_message::Message as Payload;

/// A finite `f32`: what is no number becomes 0, as in the JSON form.
fn number(value: f64) -> f32 {
    let value = value as f32;
    if value.is_finite() { value } else { 0.0 }
}

fn track(track: &TrackReport, classes: &[String]) -> wire::Track {
    let state = match track.state {
        TrackState::Tentative => wire::TrackState::Tentative,
        TrackState::Confirmed => wire::TrackState::Confirmed,
        TrackState::Lost => wire::TrackState::Lost,
    };
    wire::Track {
        id: track.id.0,
        state: state.into(),
        class: class_name(classes, track.class).into_owned(),
        x: number(track.bbox.x),
        y: number(track.bbox.y),
        w: number(track.bbox.w),
        h: number(track.bbox.h),
        confidence: number(track.confidence),
        link: number(track.link),
        vx: number(track.velocity[0]),
        vy: number(track.velocity[1]),
        matched: track.matched,
    }
}

pub(super) fn frame(report: &FrameTracks, classes: &[String]) -> Bytes {
    let clock = match report.capture.clock {
        Clock::Rtcp => wire::Clock::Rtcp,
        Clock::Arrival => wire::Clock::Arrival,
        Clock::Media => wire::Clock::Media,
    };
    encode(Payload::Frame(wire::FrameTracks {
        camera: report.camera.as_str().to_owned(),
        epoch: report.epoch.0,
        seq: report.seq,
        frame: report.frame,
        capture_unix_ns: report.capture.unix_ns,
        clock: clock.into(),
        width: report.width,
        height: report.height,
        tracks: report.tracks.iter().map(|t| track(t, classes)).collect(),
        ended: report.ended.iter().map(|id| id.0).collect(),
    }))
}

pub(super) fn gap(gap: &Gap) -> Bytes {
    encode(Payload::Gap(wire::Gap {
        camera: gap.camera.as_str().to_owned(),
        epoch: gap.epoch.0,
        first: gap.first,
        last: gap.last,
    }))
}

fn encode(message: Payload) -> Bytes {
    wire::TrackMessage { message: Some(message) }.encode_to_vec().into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::publish::report::tests::example;
    use crate::types::{CameraId, Epoch};

    fn decode(bytes: Bytes) -> Payload {
        wire::TrackMessage::decode(bytes).unwrap().message.unwrap()
    }

    #[test]
    fn a_frame_comes_back() {
        let (tracks, classes) = example();
        let Payload::Frame(frame) = decode(frame(&tracks, &classes)) else { panic!("not a frame") };
        assert_eq!((frame.camera.as_str(), frame.epoch, frame.seq, frame.frame), ("gate", 2, 7, 9));
        assert_eq!(frame.capture_unix_ns, tracks.capture.unix_ns);
        assert_eq!(frame.clock(), wire::Clock::Rtcp);
        assert_eq!((frame.width, frame.height, frame.ended), (640, 480, vec![1, 2]));
        let [first, second] = &frame.tracks[..] else { panic!("two tracks") };
        assert_eq!(
            (first.id, first.state(), first.class.as_str()),
            (3, wire::TrackState::Confirmed, "person")
        );
        assert_eq!([first.x, first.y, first.w, first.h], [-1.5, 2.345_1, 30.0, 60.129]);
        assert_eq!((first.confidence, first.link, first.matched), (0.912_34, 0.5, true));
        assert_eq!((first.vx, first.vy), (-0.001, -12.345_1));
        assert_eq!((second.state(), second.class.as_str()), (wire::TrackState::Lost, "class-9"));
        assert_eq!(second.confidence, 0.0, "no NaN on the wire");
    }

    #[test]
    fn a_gap_comes_back() {
        let hole = Gap { camera: CameraId::new("gate").unwrap(), epoch: Epoch(2), first: 5, last: 6 };
        let Payload::Gap(got) = decode(gap(&hole)) else { panic!("not a gap") };
        assert_eq!((got.camera.as_str(), got.epoch, got.first, got.last), ("gate", 2, 5, 6));
    }
}
