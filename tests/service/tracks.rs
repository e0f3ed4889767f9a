//! What a subscriber of a real camera gets.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use gakp::publish::wire::{self, track_message::Message as Payload};
use jiff::Timestamp;
use prost::Message as _;
use serde_json::Value;

use super::support::*;

/// The names of an object's fields.
fn fields(value: &Value) -> BTreeSet<&str> {
    value.as_object().unwrap_or_else(|| panic!("no object: {value}")).keys().map(String::as_str).collect()
}

const MESSAGE: [&str; 10] =
    ["camera", "epoch", "seq", "frame", "capture_ts", "clock", "width", "height", "tracks", "ended"];
const TRACK: [&str; 8] = ["id", "state", "class", "box", "confidence", "link", "velocity", "matched"];

/// What one message must be by itself.
fn check_message(message: &Value) {
    assert_eq!(fields(message), MESSAGE.into(), "{message}");
    assert_eq!(message["camera"], "demo");
    assert_eq!((&message["width"], &message["height"]), (&Value::from(768), &Value::from(576)));
    assert!(["rtcp", "arrival"].contains(&message["clock"].as_str().unwrap()), "{message}");
    let age = Timestamp::now().duration_since(capture(message)).as_secs_f64();
    assert!((-5.0..60.0).contains(&age), "captured {age} s ago: {message}");
    for track in message["tracks"].as_array().unwrap() {
        assert_eq!(fields(track), TRACK.into(), "{track}");
        assert!(["tentative", "confirmed", "lost"].contains(&track["state"].as_str().unwrap()), "{track}");
        assert_eq!(track["class"], "person");
        let [x, y, w, h] = numbers(&track["box"]);
        assert!(x < 768.0 && y < 576.0 && x + w > 0.0 && y + h > 0.0 && w > 0.0 && h > 0.0, "{track}");
        let _: [f64; 2] = numbers(&track["velocity"]);
        for probability in ["confidence", "link"] {
            assert!((0.0..=1.0).contains(&track[probability].as_f64().unwrap()), "{track}");
        }
        assert!(track["matched"].is_boolean(), "{track}");
    }
}

fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    serde_json::from_value::<Vec<f64>>(value.clone()).unwrap().try_into().unwrap()
}

fn capture(message: &Value) -> Timestamp {
    message["capture_ts"].as_str().unwrap().parse().unwrap()
}

fn number(message: &Value, field: &str) -> u64 {
    message[field].as_u64().unwrap_or_else(|| panic!("{field} of {message}"))
}

/// Where a confirmed track was first seen.
struct Sighting {
    at: Timestamp,
    centre: [f64; 2],
}

#[test]
fn ids_persist_while_people_move() {
    let Some(clip) = clip() else { return };
    let camera = CameraProcess::start(&clip, &[]);
    let state = tempfile::tempdir().unwrap();
    let service = Service::start(state.path(), &["--camera", &format!("demo={}", camera.url)]);
    let mut json = service.socket("/v1/tracks?camera=demo");
    let mut protobuf = service.protobuf_socket("/v1/tracks");

    let mut sightings: BTreeMap<u64, Sighting> = BTreeMap::new();
    let (mut last, mut over, mut messages) = (None::<Value>, BTreeSet::new(), Vec::new());
    let since = Instant::now();
    // Someone keeps an id for two seconds and moves by half a shoulder at least.
    let walker = 'found: loop {
        assert!(since.elapsed() < PATIENCE, "nobody keeps an id: {last:?}");
        let message = json.json();
        check_message(&message);
        if let Some(last) = &last {
            assert_eq!(message["epoch"], last["epoch"]);
            assert_eq!(number(&message, "seq"), number(last, "seq") + 1, "no hole, nothing twice");
            assert!(number(&message, "frame") > number(last, "frame"));
            assert!(capture(&message) > capture(last), "{message} after {last}");
        }
        let now = capture(&message);
        let tracks = message["tracks"].as_array().unwrap();
        let confirmed: BTreeMap<u64, &Value> = tracks
            .iter()
            .filter(|track| track["state"] == "confirmed")
            .map(|track| (number(track, "id"), track))
            .collect();
        sightings.retain(|id, _| confirmed.contains_key(id));
        for track in tracks {
            assert!(!over.contains(&number(track, "id")), "an id that had ended: {track}");
        }
        over.extend(message["ended"].as_array().unwrap().iter().map(|id| id.as_u64().unwrap()));
        for (id, track) in confirmed {
            let [x, y, w, h] = numbers(&track["box"]);
            let centre = [x + w / 2.0, y + h / 2.0];
            let first = sightings.entry(id).or_insert(Sighting { at: now, centre });
            let moved = (centre[0] - first.centre[0]).hypot(centre[1] - first.centre[1]);
            if now.duration_since(first.at).as_secs_f64() >= 2.0 && moved > 10.0 {
                break 'found id;
            }
        }
        messages.push(message.clone());
        last = Some(message);
    };
    assert!(walker > 0);

    // The other client, which asked for protobuf, was told the same.
    let by_seq: BTreeMap<u64, &Value> = messages.iter().map(|m| (number(m, "seq"), m)).collect();
    let mut compared = 0;
    while compared < messages.len() / 2 {
        let message = wire::TrackMessage::decode(&protobuf.binary()[..]).unwrap();
        let Some(Payload::Frame(frame)) = message.message else { panic!("not a frame: {message:?}") };
        if let Some(json) = by_seq.get(&frame.seq) {
            check_same(&frame, json);
            compared += 1;
        }
    }
    assert!(compared > 5, "only {compared} messages were compared");
    service.stop();
}

/// Protobuf and JSON of one report; JSON is rounded.
fn check_same(frame: &wire::FrameTracks, json: &Value) {
    assert_eq!(json["camera"], frame.camera);
    let whole = [("epoch", frame.epoch), ("frame", frame.frame), ("width", frame.width.into())];
    for (field, value) in whole.into_iter().chain([("height", frame.height.into())]) {
        assert_eq!(number(json, field), value, "{field}");
    }
    assert_eq!(capture(json).as_nanosecond(), i128::from(frame.capture_unix_ns));
    let clock = match frame.clock() {
        wire::Clock::Rtcp => "rtcp",
        wire::Clock::Arrival => "arrival",
        other => panic!("{other:?}"),
    };
    assert_eq!(json["clock"], clock);
    assert_eq!(json["ended"], Value::from(frame.ended.clone()));
    let tracks = json["tracks"].as_array().unwrap();
    assert_eq!(tracks.len(), frame.tracks.len());
    for (json, track) in tracks.iter().zip(&frame.tracks) {
        assert_eq!((number(json, "id"), &json["class"]), (track.id, &Value::from(track.class.clone())));
        let state = format!("TRACK_STATE_{}", json["state"].as_str().unwrap().to_uppercase());
        assert_eq!(track.state().as_str_name(), state);
        assert_eq!(json["matched"], track.matched);
        let [x, y, w, h] = numbers(&json["box"]);
        let [vx, vy] = numbers(&json["velocity"]);
        let [confidence, link] = ["confidence", "link"].map(|field| json[field].as_f64().unwrap());
        for (json, proto, tolerance) in [
            (x, track.x, 0.006),
            (y, track.y, 0.006),
            (w, track.w, 0.006),
            (h, track.h, 0.006),
            (vx, track.vx, 0.006),
            (vy, track.vy, 0.006),
            (confidence, track.confidence, 0.0001),
            (link, track.link, 0.0001),
        ] {
            assert!((json - f64::from(proto)).abs() <= tolerance, "{json} and {proto} of {track:?}");
        }
    }
}
