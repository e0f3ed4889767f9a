//! What WebSockets and Server-Sent Events carry, as the service encodes it, against the document's schemas.

use gakp::analytics::{Direction, Happening, Point, RuleId, What};
use gakp::publish::{EVENT_KINDS, EventFilter, EventHub, Gap, encode_gap_json, encode_json};
use gakp::types::{
    BBox, CameraId, CaptureTime, ClassId, Clock, Epoch, FrameTracks, MediaTime, TrackId, TrackReport,
    TrackState,
};
use serde_json::{Value, json};

use super::tools::*;

fn report() -> FrameTracks {
    let track = |id, state| TrackReport {
        id: TrackId(id),
        state,
        class: ClassId(0),
        bbox: BBox::new(-1.5, 2.345, 30.0, 60.1),
        confidence: 0.91234,
        link: 0.5,
        velocity: [-0.001, -12.345],
        matched: true,
    };
    FrameTracks {
        camera: CameraId::new("gate").unwrap(),
        epoch: Epoch(2),
        seq: 7,
        frame: 9,
        time: MediaTime(0),
        capture: CaptureTime { unix_ns: 1_767_323_045_000_000_006, clock: Clock::Rtcp },
        width: 640,
        height: 480,
        tracks: (1..).zip(TrackState::ALL).map(|(id, state)| track(id, state)).collect(),
        ended: vec![TrackId(9)],
    }
}

/// One event of each kind.
fn events() -> Vec<Value> {
    let hub = EventHub::new(["person".to_owned()].into());
    let (line, zone) = (RuleId::new("door").unwrap(), RuleId::new("queue").unwrap());
    for what in [
        What::Crossed { line, direction: Direction::In },
        What::Entered { zone: zone.clone() },
        What::Left { zone: zone.clone(), dwell: 2.5 },
        What::Loitering { zone: zone.clone(), dwell: 120.0 },
        What::Crowded { zone: zone.clone(), occupancy: 9 },
        What::Cleared { zone, occupancy: 8 },
    ] {
        let crowd = matches!(what, What::Crowded { .. } | What::Cleared { .. });
        let track = (!crowd).then_some((TrackId(3), ClassId(0)));
        hub.publish(&report(), &Happening { track, place: Point { x: 0.5, y: 1.0 }, what });
    }
    let recent = hub.recent(&EventFilter::default(), usize::MAX);
    recent.iter().map(|event| serde_json::from_slice(&event.json).unwrap()).collect()
}

#[test]
fn messages_are_as_described() {
    let parse = |json: &[u8]| serde_json::from_slice::<Value>(json).unwrap();
    let gap = Gap { camera: CameraId::new("gate").unwrap(), epoch: Epoch(2), first: 5, last: 6 };
    let (tracks, gap) = (parse(&encode_json(&report(), &["person".into()])), parse(&encode_gap_json(&gap)));
    let (missed, events) = (json!({"gap": {"missed": 5}}), events());
    let case = |schema: &str, message: &Value, valid: bool| json!({"schema": schema, "message": message, "valid": valid});
    let mut cases = vec![];
    for (message, schemas) in [
        (&tracks, ["Report", "TrackMessage"]),
        (&gap, ["Gap", "TrackMessage"]),
        (&missed, ["EventsMissed", "EventMessage"]),
    ] {
        cases.extend(schemas.map(|schema| case(schema, message, true)));
    }
    cases.push(case("EventList", &json!({"events": events}), true));
    for event in &events {
        cases.push(case("EventMessage", event, true));
        // Each lacks nothing and has nothing of another kind.
        for other in EVENT_KINDS {
            let same = |a: &str, b: &str| [a, b].iter().all(|kind| event["type"] == *kind || other == *kind);
            let alike = same("zone.left", "zone.loitering") || same("zone.crowded", "zone.cleared");
            if event["type"] != other && !alike {
                let mut event = event.clone();
                event["type"] = json!(other);
                cases.push(case("EventMessage", &event, false));
            }
        }
    }
    for (schema, message) in
        [("Report", &tracks), ("Gap", &gap), ("Event", &events[0]), ("EventsMissed", &missed)]
    {
        for field in message.as_object().unwrap().keys() {
            let mut less = message.clone();
            less.as_object_mut().unwrap().remove(field);
            cases.push(case(schema, &less, false));
        }
        let mut more = message.clone();
        more["more"] = json!(1);
        cases.push(case(schema, &more, false));
    }
    let mut wrong = tracks.clone();
    wrong["tracks"][0]["confidence"] = json!(1.5);
    cases.push(case("Report", &wrong, false));
    wrong = tracks.clone();
    wrong["capture_ts"] = json!("2026-01-02T03:04:05Z");
    cases.push(case("Report", &wrong, false));
    assert_eq!(events.len(), EVENT_KINDS.len());
    assert_eq!(mistakes(&closed(), &Value::Array(cases)), "");
}
