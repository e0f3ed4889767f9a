//! gRPC: the reports of the WebSocket, filters, statuses, slow and mute clients, TLS, the end.

use std::fs;
use std::sync::Arc;
use std::time::Duration;

use gakp::api::KeepAlive;
use gakp::auth::tls::Certificates;
use gakp::auth::{Gate, TokenFile};
use gakp::publish::HubConfig;
use gakp::publish::wire::TrackMessage;
use gakp::types::{BBox, Epoch, FrameTracks, TrackId, TrackReport, TrackState};
use prost::Message as _;
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::auth::Tokens;
use super::grpc_client::{Calls, Stubs};
use super::support::*;

const SUBSCRIBE: &str = "/gakp.v1.Tracks/Subscribe";

fn report(camera: &str, seq: u64) -> FrameTracks {
    tracks(camera, 3, seq, (320, 240), BBox::new(10.0, 20.0, 30.5, 60.0))
}

/// Some 3 kB.
fn large_report(seq: u64) -> Arc<FrameTracks> {
    let mut report = report("gate", seq);
    let one: TrackReport = report.tracks[0];
    report.tracks = vec![one; 60];
    Arc::new(report)
}

async fn subscribers(server: &Server, expected: i64) {
    let subscribers = server.hub.metrics().subscribers.clone();
    eventually(&format!("{expected} subscribers"), || subscribers.get() == expected).await;
}

/// Every filter at once, and none: what comes is byte for byte what the WebSocket sends to those who ask for the same.
#[tokio::test(flavor = "multi_thread")]
async fn reports_and_filters_are_those_of_the_websocket() {
    let Some(stubs) = Stubs::make() else { return };
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/gate");
    server.cameras.put("yard", "rtsp://host/yard");
    let protobuf = [("sec-websocket-protocol", "gakp.v1.protobuf")];
    let all = json!({"camera": ["gate"], "class": ["person"], "state": ["TRACK_STATE_CONFIRMED", "TRACK_STATE_LOST"],
                     "min_confidence": 0.85, "rate": 5.0});
    let cases = [
        (json!({}), "/v1/tracks", 22),
        (json!({"camera": ["yard", "gate"], "class": ["car"]}), "/v1/tracks?class=car", 22),
        (json!({"min_confidence": 0.95}), "/v1/tracks?min_confidence=0.95", 22),
        (all, "/v1/tracks?camera=gate&class=person&state=confirmed&state=lost&min_confidence=0.85&rate=5", 3),
    ];
    let mut clients = vec![];
    for (n, (request, path, messages)) in cases.into_iter().enumerate() {
        let calls = stubs.call(server.addr, &json!([{"request": request, "messages": messages}]));
        subscribers(&server, 2 * n as i64 + 1).await;
        clients.push((calls, server.socket(path, &protobuf).await.unwrap(), messages));
    }
    for seq in 0..11 {
        for camera in ["gate", "yard"] {
            let mut report = report(camera, seq);
            report.ended = vec![TrackId(100 + seq)];
            let other = TrackReport { id: TrackId(8), state: TrackState::Tentative, ..report.tracks[0] };
            report.tracks.push(other);
            server.hub.publish(Arc::new(report));
        }
    }
    for (calls, socket, messages) in &mut clients {
        for _ in 0..*messages {
            let expected = socket.binary().await;
            assert_eq!(calls.message(), TrackMessage::decode(&expected[..]).unwrap());
        }
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_is_told_by_a_status() {
    let Some(stubs) = Stubs::make() else { return };
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/gate");
    let wrong = [
        (json!({"camera": ["gate", "nope"]}), "NOT_FOUND there is no camera \"nope\""),
        (json!({"camera": [""]}), "INVALID_ARGUMENT"),
        (json!({"class": ["dog"]}), "INVALID_ARGUMENT class=\"dog\" is none of the classes person, car"),
        (json!({"state": ["TRACK_STATE_UNSPECIFIED"]}), "INVALID_ARGUMENT state=\"0\" is none of"),
        (json!({"state": [9]}), "INVALID_ARGUMENT state=\"9\" is none of"),
        (json!({"min_confidence": 1.5}), "INVALID_ARGUMENT min_confidence=\"1.5\" must be"),
        (json!({"min_confidence": -0.5}), "INVALID_ARGUMENT"),
        (json!({"rate": 0.0}), "INVALID_ARGUMENT rate=\"0\" must be"),
        (json!({"rate": 1e300}), "INVALID_ARGUMENT"),
        (json!({"camera": ["x".repeat(70_000)]}), "OUT_OF_RANGE"),
    ];
    let mut calls: Vec<_> = wrong.iter().map(|(request, _)| json!({"request": request})).collect();
    calls.push(json!({"method": "/gakp.v1.Tracks/Unsubscribe"}));
    calls.push(json!({"method": "/gakp.v2.Tracks/Subscribe"}));
    let said = stubs.call(server.addr, &json!(calls));
    for (request, expected) in &wrong {
        let status = said.status();
        assert!(status.starts_with(expected), "{request}: {status}");
    }
    assert!(said.status().starts_with("UNIMPLEMENTED nothing is at /gakp.v1.Tracks/Unsubscribe"));
    assert!(said.status().starts_with("UNIMPLEMENTED"));
    // A page of another site that makes its name point here.
    let said = stubs.call(server.addr, &json!([{"authority": "rebind.example:80"}]));
    let status = said.status();
    assert!(status.starts_with("PERMISSION_DENIED without tokens the service answers only"), "{status}");
    subscribers(&server, 0).await;
    // Streams of every form have their seats together.
    let mut streams = vec![];
    for _ in 0..256 {
        streams.push(server.open("GET", "/v1/tracks/stream", &[], b"").await);
    }
    subscribers(&server, 256).await;
    let status = stubs.call(server.addr, &json!([{}])).status();
    assert!(status.starts_with("RESOURCE_EXHAUSTED 256 streams are open"), "{status}");
    drop(streams);

    // What is no gRPC.
    let long = "x".repeat(70_000);
    for (headers, body, status, kind) in [
        (&[][..], "", 415, "media-type"),
        (&[("Content-Type", "application/json")], "{}", 415, "media-type"),
        (&[("Content-Type", "application/grpc-web")], "", 415, "media-type"),
        (&[("Content-Type", "application/grpc")], "", 426, "http2-only"),
        (&[("Content-Type", "application/grpc")], &long, 413, "too-large"),
    ] {
        let answer = server.request("POST", SUBSCRIBE, headers, body.as_bytes()).await;
        assert_eq!(answer.status, status, "{headers:?}");
        assert_eq!(answer.json()["type"], format!("urn:gakp:problem:{kind}"), "{headers:?}");
        assert_eq!(answer.head.contains("upgrade: http/2.0"), status == 426, "{}", answer.head);
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn tokens_are_those_of_the_other_routes() {
    let Some(stubs) = Stubs::make() else { return };
    let tokens = Tokens::new();
    let server = Server::start_behind(tokens.gate(), None).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let token = |name: &str| tokens.bearer(name).replace("Bearer ", "");
    let refused =
        stubs.call(server.addr, &json!([{}, {"token": "gakp_x"}, {"token": &token("viewer")[1..]}]));
    for expected in ["send `Authorization: Bearer TOKEN`", "the token is not known", "the token is not known"]
    {
        let status = refused.status();
        assert!(status.starts_with(&format!("UNAUTHENTICATED {expected}")), "{status}");
    }
    let may: Vec<Calls> = ["viewer", "watcher", "operator", "admin"]
        .map(|name| stubs.call(server.addr, &json!([{"token": token(name)}])))
        .into();
    subscribers(&server, 4).await;
    server.hub.publish(Arc::new(report("gate", 5)));
    may.iter().for_each(|calls| assert_eq!(calls.told(), ("gate".to_owned(), 5, 5, false)));
    // Revoked, though no camera says anything more.
    let path = TokenFile::path(tokens.folder.path());
    let mut file = TokenFile::read(&path).unwrap();
    file.revoke("viewer").unwrap();
    file.write(&path).unwrap();
    assert_eq!(may[0].status(), "UNAUTHENTICATED the token was revoked");
    subscribers(&server, 3).await;
    // The end of the service is the end of what is left.
    let took = server.stop().await;
    may[1..].iter().for_each(|calls| assert_eq!(calls.status(), "UNAVAILABLE the service stops"));
    assert!(took < Duration::from_secs(1), "streams that are read do not hold up the end: {took:?}");
}

/// One that stops reading for a while is told exactly what it missed, and others go on: a WebSocket, and another call
/// over the very same connection.
#[tokio::test(flavor = "multi_thread")]
async fn a_slow_client_is_told_what_it_missed() {
    const REPORTS: u64 = 3000;
    let Some(stubs) = Stubs::make() else { return };
    let hub = HubConfig { capacity: 8, ..HubConfig::default() };
    let server = Server::start_with(hub, KeepAlive::default()).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let mut quick = server.socket("/v1/tracks", &[]).await.unwrap();
    let mut slow = stubs
        .call(server.addr, &json!([{"pause": 1, "messages": 1_000_000, "beside": true}, {"messages": 1}]));
    subscribers(&server, 2).await;
    server.hub.publish(large_report(0));
    quick.json().await;
    assert_eq!(slow.told().1, 0);
    slow.paused();
    subscribers(&server, 3).await;
    for seq in 1..REPORTS {
        server.hub.publish(large_report(seq));
        assert_eq!(quick.json().await["seq"], seq, "the quick one misses nothing");
        if seq == 1 {
            // The call beside, over a connection whose other stream is not read.
            assert_eq!(slow.told(), ("gate".to_owned(), 1, 1, false));
            subscribers(&server, 2).await;
        }
    }
    slow.resume();
    let (mut next, mut missed) = (1, 0);
    while next < REPORTS {
        let (camera, first, last, gap) = slow.told();
        assert_eq!((camera.as_str(), first), ("gate", next), "no hole without announcement, nothing twice");
        missed += if gap { last - first + 1 } else { 0 };
        next = last + 1;
    }
    // What waits is bounded: by the client's window and by what the service holds.
    assert!(missed > REPORTS / 2, "only {missed} of {REPORTS} were missed");
    assert_eq!(server.hub.metrics().dropped_by_lag.get(), missed);
    server.stop().await;
}

/// Reports that a window of 64 KiB does not take, and a ring of 512 does.
const TOO_MANY: u64 = 300;

#[tokio::test(flavor = "multi_thread")]
async fn who_missed_too_much_is_given_up_and_told() {
    let Some(stubs) = Stubs::make() else { return };
    let hub = HubConfig { max_gaps: 4, ..HubConfig::default() };
    let server = Server::start_with(hub, KeepAlive::default()).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let mut calls = stubs.call(server.addr, &json!([{"pause": 1}]));
    subscribers(&server, 1).await;
    (0..TOO_MANY).for_each(|seq| server.hub.publish(large_report(seq)));
    assert_eq!(calls.told().1, 0);
    calls.paused();
    let given_up = server.hub.metrics().given_up.clone();
    assert_eq!(given_up.get(), 0);
    // The camera starts again and again.
    for epoch in 4..1000 {
        server.hub.publish(Arc::new(FrameTracks { epoch: Epoch(epoch), ..report("gate", 0) }));
    }
    assert_eq!(given_up.get(), 1);
    calls.resume();
    assert_eq!(calls.end(), "RESOURCE_EXHAUSTED too slow: missed more than can be accounted for");
    subscribers(&server, 0).await;
    server.stop().await;
}

/// Those who take nothing for ten seconds are given up. Who reads soon after is told why; who does not is cut off, and
/// its other call, over the same connection, goes on.
#[tokio::test(flavor = "multi_thread")]
async fn who_takes_nothing_is_given_up() {
    let Some(stubs) = Stubs::make() else { return };
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/gate");
    server.cameras.put("yard", "rtsp://host/yard");
    let gate = json!({"camera": ["gate"]});
    let mute = json!({"request": gate, "pause": 1, "watch": true, "beside": true});
    let beside = json!({"request": {"camera": ["yard"]}, "messages": 2});
    let mut late = stubs.call(server.addr, &json!([{"request": gate, "pause": 1}]));
    let mute = stubs.call(server.addr, &json!([mute, beside]));
    subscribers(&server, 2).await;
    (0..TOO_MANY).for_each(|seq| server.hub.publish(large_report(seq)));
    for calls in [&late, &mute] {
        assert_eq!(calls.told().1, 0);
        calls.paused();
    }
    subscribers(&server, 3).await;
    server.hub.publish(Arc::new(report("yard", 0)));
    assert_eq!(mute.told(), ("yard".to_owned(), 0, 0, false));
    // Both are gone; the call beside is not.
    subscribers(&server, 1).await;
    late.resume();
    assert_eq!(late.end(), "RESOURCE_EXHAUSTED too slow: took nothing for ten seconds");
    mute.over();
    server.hub.publish(Arc::new(report("yard", 1)));
    assert_eq!(mute.told(), ("yard".to_owned(), 1, 1, false));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn over_tls_beside_http_1() {
    let Some(stubs) = Stubs::make() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (cert, key) = (folder.path().join("cert.pem"), folder.path().join("key.pem"));
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    fs::write(&cert, made.cert.pem()).unwrap();
    fs::write(&key, made.signing_key.serialize_pem()).unwrap();
    let certificates = Certificates::read(&cert, &key).unwrap();
    let server = Server::start_behind(Gate::open(), Some(certificates.server().unwrap())).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let calls = stubs
        .call(server.addr, &json!([{"ca": cert, "messages": 1}, {"ca": cert, "request": {"rate": 0.0}}]));
    subscribers(&server, 1).await;
    server.hub.publish(Arc::new(report("gate", 5)));
    assert_eq!(calls.told(), ("gate".to_owned(), 5, 5, false));
    assert!(calls.status().starts_with("INVALID_ARGUMENT"));
    server.stop().await;
}

/// A connection of HTTP/2 that asks for nothing is told to go, and closed; so is one that does not get as far.
#[tokio::test]
async fn an_idle_connection_is_closed() {
    const SETTINGS: &[u8] = &[0, 0, 0, 4, 0, 0, 0, 0, 0];
    const GOAWAY: u8 = 7;
    let server = Server::start().await;
    let idle = async |sent: &[u8]| {
        let mut stream = TcpStream::connect(server.addr).await.unwrap();
        stream.write_all(sent).await.unwrap();
        let mut bytes = vec![];
        // Reset, where what was sent had not been read.
        let _ = patiently("the end of a connection", stream.read_to_end(&mut bytes)).await;
        bytes
    };
    let greeting = [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", SETTINGS].concat();
    let (told, begun, half) = futures::join!(idle(&greeting), idle(&greeting[..20]), idle(b"PR"));
    let (mut frames, mut rest) = (vec![], &told[..]);
    while let [a, b, c, kind, ..] = rest {
        frames.push(*kind);
        rest = &rest[9 + u32::from_be_bytes([0, *a, *b, *c]) as usize..];
    }
    assert!(frames.contains(&GOAWAY), "{frames:?}");
    assert!(begun.len() < told.len() && half.is_empty());
    assert_eq!(server.get("/healthz").await.status, 200);
    server.stop().await;
}
