//! A frame's tracks as ONVIF metadata in JSON over MQTT (`onvif-mj`, ONVIF Analytics Service Specification, "JSON
//! over MQTT"): the elements of `tt:Frame` by their XML names, attributes with `@` in front, repeated ones as lists.

use bytes::Bytes;
use serde::{Serialize, Serializer};

use crate::types::{BBox, FrameTracks, TrackReport, TrackState};

#[derive(Serialize)]
#[serde(rename_all = "PascalCase")]
struct Message {
    frame: [Frame; 1],
}

#[derive(Serialize)]
struct Frame {
    #[serde(rename = "@UtcTime")]
    utc_time: UtcTime,
    #[serde(rename = "@Source")]
    source: String,
    #[serde(rename = "Object", skip_serializing_if = "Vec::is_empty")]
    objects: Vec<Object>,
}

#[derive(Serialize)]
#[serde(rename_all = "PascalCase")]
struct Object {
    #[serde(rename = "@ObjectId")]
    id: u64,
    appearance: Appearance,
}

#[derive(Serialize)]
#[serde(rename_all = "PascalCase")]
struct Appearance {
    shape: Shape,
    class: Class,
}

#[derive(Serialize)]
#[serde(rename_all = "PascalCase")]
struct Shape {
    bounding_box: Rectangle,
    center_of_gravity: Place,
}

#[derive(Serialize)]
struct Rectangle {
    #[serde(rename = "@left")]
    left: f64,
    #[serde(rename = "@top")]
    top: f64,
    #[serde(rename = "@right")]
    right: f64,
    #[serde(rename = "@bottom")]
    bottom: f64,
}

#[derive(Serialize)]
struct Place {
    #[serde(rename = "@x")]
    x: f64,
    #[serde(rename = "@y")]
    y: f64,
}

#[derive(Serialize)]
struct Class {
    #[serde(rename = "Type")]
    types: [Likely; 1],
}

#[derive(Serialize)]
struct Likely {
    #[serde(rename = "@Likelihood")]
    likelihood: f64,
    #[serde(rename = "#text")]
    text: String,
}

/// Milliseconds, in UTC.
struct UtcTime(i64);

impl Serialize for UtcTime {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // Every i64 of nanoseconds is a date between the years 1677 and 2262.
        let at = jiff::Timestamp::from_nanosecond(i128::from(self.0)).map_err(serde::ser::Error::custom)?;
        serializer.collect_str(&format_args!("{at:.3}"))
    }
}

/// What ONVIF calls a class of ours; any other text is allowed as it is.
fn onvif_class(class: &str) -> &str {
    match class {
        "person" => "Human",
        "bicycle" => "Bicycle",
        "car" | "truck" | "bus" | "motorcycle" => "Vehicle",
        "bird" | "cat" | "dog" | "horse" | "sheep" | "cow" | "elephant" | "bear" | "zebra" | "giraffe" => {
            "Animal"
        }
        other => other,
    }
}

fn shape(bbox: BBox, width: u32, height: u32) -> Shape {
    // From the middle of the picture, -1 to 1, upwards.
    let round = |value: f64| (value * 10_000.0).round() / 10_000.0 + 0.0;
    let x = |pixels: f64| round(2.0 * pixels / f64::from(width.max(1)) - 1.0);
    let y = |pixels: f64| round(1.0 - 2.0 * pixels / f64::from(height.max(1)));
    let (right, bottom) = (bbox.x + bbox.w, bbox.y + bbox.h);
    Shape {
        bounding_box: Rectangle { left: x(bbox.x), top: y(bbox.y), right: x(right), bottom: y(bottom) },
        center_of_gravity: Place { x: x(bbox.x + bbox.w / 2.0), y: y(bbox.y + bbox.h / 2.0) },
    }
}

/// The confirmed tracks of a frame; without any, a frame without objects, as the specification asks.
pub(super) fn frame(report: &FrameTracks, classes: &[String]) -> Bytes {
    let object = |track: &TrackReport| {
        let class = classes.get(usize::from(track.class.0)).map_or("Other", |name| onvif_class(name));
        let likelihood = (track.confidence * 10_000.0).round() / 10_000.0;
        Object {
            id: track.id.0,
            appearance: Appearance {
                shape: shape(track.bbox, report.width, report.height),
                class: Class { types: [Likely { likelihood, text: class.to_owned() }] },
            },
        }
    };
    let confirmed = report.tracks.iter().filter(|track| track.state == TrackState::Confirmed);
    let message = Message {
        frame: [Frame {
            utc_time: UtcTime(report.capture.unix_ns),
            source: report.camera.to_string(),
            objects: confirmed.map(object).collect(),
        }],
    };
    // A struct of numbers and texts always serialises.
    serde_json::to_vec(&message).unwrap_or_default().into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{CameraId, CaptureTime, ClassId, Clock, Epoch, MediaTime, TrackId};

    #[test]
    fn a_frame_is_exactly_this() {
        let track = |id, state| TrackReport {
            id: TrackId(id),
            state,
            class: ClassId(0),
            bbox: BBox::new(160.0, 0.0, 160.0, 240.0),
            confidence: 0.912_34,
            link: 1.0,
            velocity: [0.0, 0.0],
            matched: true,
        };
        let mut report = FrameTracks {
            camera: CameraId::new("gate").unwrap(),
            epoch: Epoch(1),
            seq: 1,
            frame: 1,
            time: MediaTime(0),
            capture: CaptureTime { unix_ns: 1_767_323_045_321_000_000, clock: Clock::Rtcp },
            width: 640,
            height: 480,
            tracks: vec![track(7, TrackState::Confirmed), track(8, TrackState::Tentative)],
            ended: vec![],
        };
        let expected = concat!(
            r#"{"Frame":[{"@UtcTime":"2026-01-02T03:04:05.321Z","@Source":"gate","Object":[{"@ObjectId":7,"#,
            r#""Appearance":{"Shape":{"BoundingBox":{"@left":-0.5,"@top":1.0,"@right":0.0,"@bottom":0.0},"#,
            r#""CenterOfGravity":{"@x":-0.25,"@y":0.5}},"Class":{"Type":[{"@Likelihood":0.9123,"#,
            r##""#text":"Human"}]}}}]}]}"##,
        );
        let classes = ["person".to_owned()];
        assert_eq!(std::str::from_utf8(&frame(&report, &classes)).unwrap(), expected);
        report.tracks.clear();
        let empty = r#"{"Frame":[{"@UtcTime":"2026-01-02T03:04:05.321Z","@Source":"gate"}]}"#;
        assert_eq!(std::str::from_utf8(&frame(&report, &classes)).unwrap(), empty);
    }
}
