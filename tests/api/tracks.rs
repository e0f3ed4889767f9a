//! `/v1/tracks`: JSON, protobuf, filters, slow clients, foreign origins.

use std::sync::Arc;
use std::time::Duration;

use futures::SinkExt;
use gakp::api::KeepAlive;
use gakp::publish::HubConfig;
use gakp::publish::wire::{self, track_message::Message as Payload};
use gakp::types::{BBox, FrameTracks, TrackId, TrackReport};
use prost::Message as _;
use serde_json::json;
use tokio::io::AsyncReadExt as _;
use tokio_tungstenite::tungstenite::Message;

use super::support::*;

fn report(camera: &str, seq: u64) -> Arc<FrameTracks> {
    Arc::new(tracks(camera, 3, seq, (320, 240), BBox::new(10.0, 20.0, 30.5, 60.0)))
}

async fn two_cameras() -> Server {
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/gate");
    server.cameras.put("yard", "rtsp://host/yard");
    server
}

#[tokio::test]
async fn json_is_what_everyone_gets_who_asks_for_nothing_else() {
    let server = two_cameras().await;
    for protocol in [None, Some("gakp.v1.json")] {
        let headers: Vec<_> = protocol.map(|p| ("sec-websocket-protocol", p)).into_iter().collect();
        let mut socket = server.socket("/v1/tracks", &headers).await.ok().unwrap();
        assert_eq!(socket.protocol.as_deref(), protocol);
        server.hub.publish(report("gate", 5));
        assert_eq!(
            socket.json().await,
            json!({
                "camera": "gate", "epoch": 3, "seq": 5, "frame": 10,
                "capture_ts": "2026-01-02T03:04:05.200000000Z", "clock": "media", "width": 320, "height": 240,
                "tracks": [{
                    "id": 7, "state": "confirmed", "class": "person", "box": [10.0, 20.0, 30.5, 60.0],
                    "confidence": 0.9, "link": 0.8, "velocity": [25.0, 0.0], "matched": true,
                }],
                "ended": [],
            })
        );
    }
    server.stop().await;
}

#[tokio::test]
async fn protobuf_for_those_who_ask_even_among_others() {
    let server = two_cameras().await;
    for offer in ["gakp.v1.protobuf", "gakp.v1.json, gakp.v1.protobuf"] {
        let mut socket =
            server.socket("/v1/tracks", &[("sec-websocket-protocol", offer)]).await.ok().unwrap();
        assert_eq!(socket.protocol.as_deref(), Some("gakp.v1.protobuf"));
        server.hub.publish(report("gate", 5));
        let message = wire::TrackMessage::decode(&socket.binary().await[..]).unwrap();
        let Some(Payload::Frame(frame)) = message.message else { panic!("not a frame") };
        assert_eq!((frame.camera.as_str(), frame.epoch, frame.seq, frame.frame), ("gate", 3, 5, 10));
        assert_eq!((frame.tracks[0].id, frame.tracks[0].w), (7, 30.5));
    }
    server.stop().await;
}

#[tokio::test]
async fn a_filter_lets_only_its_cameras_through() {
    let server = two_cameras().await;
    server.cameras.put("dock", "rtsp://host/dock");
    let mut one = server.socket("/v1/tracks?camera=yard", &[]).await.ok().unwrap();
    let mut two = server.socket("/v1/tracks?camera=yard&camera=dock", &[]).await.ok().unwrap();
    for (camera, seq) in [("gate", 0), ("dock", 1), ("yard", 2), ("gate", 3)] {
        server.hub.publish(report(camera, seq));
    }
    server.hub.publish(report("yard", 4));
    let seen = async |socket: &mut Socket| {
        let message = socket.json().await;
        (message["camera"].as_str().unwrap().to_owned(), message["seq"].as_u64().unwrap())
    };
    for expected in [("yard", 2), ("yard", 4)] {
        assert_eq!(seen(&mut one).await, (expected.0.to_owned(), expected.1));
    }
    for expected in [("dock", 1), ("yard", 2), ("yard", 4)] {
        assert_eq!(seen(&mut two).await, (expected.0.to_owned(), expected.1));
    }
    server.stop().await;
}

#[tokio::test]
async fn tracks_are_chosen_and_thinned() {
    let server = two_cameras().await;
    let mut people =
        server.socket("/v1/tracks?class=person&state=confirmed&min_confidence=0.5", &[]).await.ok().unwrap();
    let mut cars = server.socket("/v1/tracks?class=car", &[]).await.ok().unwrap();
    let mut slow = server.socket("/v1/tracks?camera=gate&rate=5", &[]).await.ok().unwrap();
    for seq in 0..11 {
        let mut report = FrameTracks::clone(&report("gate", seq));
        report.ended = vec![TrackId(100 + seq)];
        server.hub.publish(Arc::new(report));
    }
    let message = people.json().await;
    assert_eq!((message["seq"].as_u64(), message["tracks"][0]["id"].as_u64()), (Some(0), Some(7)));
    let message = cars.json().await;
    assert_eq!((message["seq"].as_u64(), &message["tracks"]), (Some(0), &json!([])));
    // 25 a second come, 5 go: each fifth, with the ends of those between.
    for (seq, ended) in [(0, vec![100]), (5, (101..=105).collect()), (10, (106..=110).collect::<Vec<u64>>())]
    {
        let message = slow.json().await;
        assert_eq!((message["seq"].as_u64(), &message["ended"]), (Some(seq), &json!(ended)));
    }
    server.stop().await;
}

#[tokio::test]
async fn the_same_comes_as_server_sent_events() {
    let server = two_cameras().await;
    let mut stream = server.open("GET", "/v1/tracks/stream?camera=yard", &[], b"").await;
    let mut text = String::new();
    let mut read = async |until: &str| {
        while !text.contains(until) {
            let mut bytes = [0; 4096];
            let n = patiently("an event", stream.read(&mut bytes)).await.unwrap();
            assert!(n > 0, "{text}");
            text += std::str::from_utf8(&bytes[..n]).unwrap();
        }
        std::mem::take(&mut text)
    };
    let head = read("\r\n\r\n").await;
    assert!(head.to_lowercase().contains("content-type: text/event-stream"), "{head}");
    server.hub.publish(report("gate", 0));
    server.hub.publish(report("yard", 1));
    let event = read("\n\n").await;
    let json = event.trim().strip_prefix("event: tracks\ndata: ").unwrap_or_else(|| panic!("{event:?}"));
    let message: serde_json::Value = serde_json::from_str(json).unwrap();
    assert_eq!((&message["camera"], message["seq"].as_u64()), (&"yard".into(), Some(1)));
    let since = std::time::Instant::now();
    server.stop().await;
    assert!(since.elapsed() < std::time::Duration::from_secs(5), "an open stream does not hold up the end");
}

#[tokio::test]
async fn who_may_not_or_cannot_is_told_why() {
    let server = two_cameras().await;
    let own = format!("http://{}", server.addr);
    assert!(server.socket("/v1/tracks", &[("origin", &own)]).await.is_ok());
    for (path, origin, status, kind) in [
        ("/v1/tracks", Some("http://evil.example"), 403, "forbidden-origin"),
        ("/v1/cameras/gate/live", Some("http://evil.example"), 403, "forbidden-origin"),
        ("/v1/tracks", Some("null"), 403, "forbidden-origin"),
        ("/v1/tracks?camera=nope", None, 404, "unknown-camera"),
        ("/v1/tracks?camera=gate&camera=nope", None, 404, "unknown-camera"),
        ("/v1/tracks?camera=", None, 400, "bad-request"),
        ("/v1/tracks?cam=gate", None, 400, "bad-request"),
        ("/v1/tracks?class=dog", None, 400, "bad-request"),
        ("/v1/tracks?state=gone", None, 400, "bad-request"),
        ("/v1/tracks?min_confidence=2", None, 400, "bad-request"),
        ("/v1/tracks?rate=0", None, 400, "bad-request"),
        ("/v1/tracks?rate=NaN", None, 400, "bad-request"),
        ("/v1/cameras/nope/live", None, 404, "unknown-camera"),
    ] {
        let headers: Vec<_> = origin.map(|o| ("origin", o)).into_iter().collect();
        let Err(refusal) = server.socket(path, &headers).await else {
            panic!("{path} {origin:?} was let in")
        };
        assert_eq!(refusal.status, status, "{path} {origin:?}");
        assert_eq!(refusal.json()["type"], format!("urn:gakp:problem:{kind}"), "{path} {origin:?}");
    }
    server.stop().await;
}

/// A client that does not read for a while misses reports; it is told exactly which, and another
/// client beside it misses none.
#[tokio::test]
async fn a_slow_client_is_told_what_it_missed() {
    const REPORTS: u64 = 3000;
    let hub = HubConfig { capacity: 8, ..HubConfig::default() };
    let server = Server::start_with(hub, KeepAlive::default()).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let mut slow = server.narrow_socket("/v1/tracks", &[]).await;
    let mut quick = server.socket("/v1/tracks", &[]).await.ok().unwrap();
    for seq in 0..REPORTS {
        let mut report = Arc::unwrap_or_clone(report("gate", seq));
        // Some 10 kB a report: the kernel's buffers cannot hold them all.
        let one: TrackReport = report.tracks[0];
        report.tracks = vec![one; 60];
        server.hub.publish(Arc::new(report));
        assert_eq!(quick.json().await["seq"], seq, "the quick one misses nothing");
    }
    let (mut next, mut missed) = (0, 0);
    while next < REPORTS {
        let message = slow.json().await;
        let (first, last) = match message.get("gap") {
            Some(gap) => {
                assert_eq!((&message["camera"], &message["epoch"]), (&json!("gate"), &json!(3)));
                assert!(message.get("seq").is_none(), "a gap is told apart from a report");
                (gap["first"].as_u64().unwrap(), gap["last"].as_u64().unwrap())
            }
            None => (message["seq"].as_u64().unwrap(), message["seq"].as_u64().unwrap()),
        };
        assert_eq!(first, next, "no hole without announcement, nothing twice");
        if message.get("gap").is_some() {
            missed += last - first + 1;
        }
        next = last + 1;
    }
    assert!(missed > 0, "the test was too gentle");
    assert_eq!(server.hub.metrics().dropped_by_lag.get(), missed);
    server.stop().await;
}

/// A client that does not even answer a ping is gone, though its connection stands; one that reads,
/// and so answers, stays.
#[tokio::test]
async fn a_client_that_says_nothing_is_dropped() {
    let keep_alive = KeepAlive { ping_every: Duration::from_millis(50), dead_after: Duration::from_secs(3) };
    let server = Server::start_with(HubConfig::default(), keep_alive).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let mut alive = server.socket("/v1/tracks", &[]).await.ok().unwrap();
    let _mute = server.socket("/v1/tracks", &[]).await.ok().unwrap();
    let subscribers = server.hub.metrics().subscribers.clone();
    assert_eq!(subscribers.get(), 2);
    let listening = tokio::spawn(async move { alive.json().await });
    eventually("the mute client to be dropped", || subscribers.get() == 1).await;
    server.hub.publish(report("gate", 0));
    assert_eq!(listening.await.unwrap()["seq"], 0, "the other one is still there");
    server.stop().await;
}

/// Rubbish from one client ends that client.
#[tokio::test]
async fn a_client_that_floods_is_closed_and_others_stay() {
    let server = two_cameras().await;
    let mut good = server.socket("/v1/tracks", &[]).await.ok().unwrap();
    let mut bad = server.socket("/v1/tracks", &[]).await.ok().unwrap();
    bad.stream.send(Message::Text("x".repeat(100_000).into())).await.unwrap();
    let hub = server.hub.clone();
    eventually("the flooding client to be gone", || hub.metrics().subscribers.get() == 1).await;
    good.stream.send(Message::Text("hello".into())).await.unwrap();
    server.hub.publish(report("gate", 0));
    assert_eq!(good.json().await["seq"], 0);
    server.stop().await;
}
