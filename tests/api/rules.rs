//! Lines, zones, counts, heat maps and events at the edge.

use gakp::publish::{Hub, HubConfig};
use gakp::types::{BBox, FrameTracks, MediaTime};
use serde_json::json;

use super::support::*;

const JSON: &[(&str, &str)] = &[("Content-Type", "application/json")];
const DOOR: &str = r#"{"id":"door","points":[[0.5,1],[0.5,0]]}"#;
const FLOOR: &str = r#"{"id":"floor","points":[[0,0],[1,0],[1,1],[0,1]],"loiter_s":30,"capacity":5}"#;

#[tokio::test]
async fn lines_and_zones_are_added_replaced_and_removed() {
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/x");
    assert_eq!(server.get("/v1/cameras/gate/lines").await.json(), json!({"lines": []}));
    let door = json!({"id": "door", "points": [[0.5, 1.0], [0.5, 0.0]], "anchor": "foot"});
    let added = server.post("/v1/cameras/gate/lines", DOOR).await;
    assert_eq!((added.status, added.json()), (201, door.clone()));
    assert!(added.head.contains("location: /v1/cameras/gate/lines/door"), "{}", added.head);
    assert_eq!(server.get("/v1/cameras/gate/lines/door").await.json(), door);
    let floor = server.post("/v1/cameras/gate/zones", FLOOR).await;
    assert_eq!((floor.status, floor.json()["capacity"].as_u64()), (201, Some(5)));

    let moved = r#"{"id":"door","points":[[0.2,1],[0.2,0]],"anchor":"centre"}"#;
    let put = server.request("PUT", "/v1/cameras/gate/lines/door", JSON, moved.as_bytes()).await;
    assert_eq!((put.status, put.json()["anchor"].as_str()), (200, Some("centre")));
    let zones = server.get("/v1/cameras/gate/zones").await.json();
    assert_eq!(zones["zones"][0]["id"], "floor", "{zones}");

    for (path, what) in [("lines/door", "lines"), ("zones/floor", "zones")] {
        let path = format!("/v1/cameras/gate/{path}");
        assert_eq!(server.request("DELETE", &path, &[], b"").await.status, 204);
        assert_eq!(server.get(&path).await.status, 404);
        let left = server.get(&format!("/v1/cameras/gate/{what}")).await.json();
        assert_eq!(left[what], json!([]));
    }
    server.stop().await;
}

#[tokio::test]
async fn what_cannot_be_watched_is_refused_in_words() {
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/x");
    assert_eq!(server.post("/v1/cameras/gate/lines", DOOR).await.status, 201);
    let many = format!(r#"{{"id":"many","points":[{}]}}"#, vec!["[0,0]"; 33].join(","));
    for (method, path, body, status, kind, detail) in [
        ("GET", "/v1/cameras/nope/lines", "", 404, "unknown-camera", "nope"),
        ("POST", "/v1/cameras/nope/lines", DOOR, 404, "unknown-camera", "no camera"),
        ("GET", "/v1/cameras/gate/lines/nope", "", 404, "unknown-rule", "no line \"nope\""),
        ("GET", "/v1/cameras/gate/zones/%20", "", 404, "unknown-rule", "no zone"),
        ("DELETE", "/v1/cameras/gate/zones/door", "", 404, "unknown-rule", "no zone \"door\""),
        ("POST", "/v1/cameras/gate/lines", DOOR, 409, "rule-exists", "PUT replaces"),
        ("PUT", "/v1/cameras/gate/lines/gate", DOOR, 400, "bad-request", "the body is of \"door\""),
        ("POST", "/v1/cameras/gate/lines", r#"{"id":"a","points":[[0,0]]}"#, 400, "bad-request", "1 points"),
        ("POST", "/v1/cameras/gate/lines", &many, 400, "bad-request", "33 points"),
        ("POST", "/v1/cameras/gate/lines", r#"{"id":"a b","points":[]}"#, 400, "bad-request", "\"a b\""),
        (
            "POST",
            "/v1/cameras/gate/zones",
            r#"{"id":"z","points":[[0,0],[2,0],[1,1]]}"#,
            400,
            "bad-request",
            "point 1 of z is (2, 0)",
        ),
        (
            "POST",
            "/v1/cameras/gate/zones",
            r#"{"id":"z","points":[[0,0],[1,0],[1,1]],"loiter_s":-1}"#,
            400,
            "bad-request",
            "loiter_s",
        ),
        ("POST", "/v1/cameras/gate/zones", r#"{"id":"z","point":[]}"#, 400, "bad-request", "unknown field"),
        ("GET", "/v1/cameras/nope/counts", "", 404, "unknown-camera", "nope"),
        ("GET", "/v1/cameras/nope/heatmap", "", 404, "unknown-camera", "nope"),
        ("GET", "/v1/events?type=x", "", 400, "bad-request", "line.crossed"),
        ("GET", "/v1/events?limit=0", "", 400, "bad-request", "limit"),
        ("GET", "/v1/events?camera=nope", "", 404, "unknown-camera", "nope"),
        ("GET", "/v1/events/live", "", 426, "websocket-only", "WebSocket"),
    ] {
        let answer = server.request(method, path, JSON, body.as_bytes()).await;
        let problem = answer.json();
        assert_eq!(answer.status, status, "{method} {path} {body}: {problem}");
        assert_eq!(problem["type"], format!("urn:gakp:problem:{kind}"), "{method} {path} {body}");
        assert!(problem["detail"].as_str().unwrap().contains(detail), "{method} {path} {body}: {problem}");
    }
    // Too many.
    for index in 1..32 {
        let line = DOOR.replace("door", &format!("door-{index}"));
        assert_eq!(server.post("/v1/cameras/gate/lines", &line).await.status, 201, "{index}");
    }
    let refused = server.post("/v1/cameras/gate/lines", &DOOR.replace("door", "last")).await;
    assert!(refused.status == 400 && refused.text().contains("at most 32"), "{}", refused.text());
    server.stop().await;
}

/// A track's frame, its foot at `x`, the middle of the picture's height.
fn at(seq: u64, x: f64) -> FrameTracks {
    let bbox = BBox::new(x - 10.0, 100.0, 20.0, 40.0);
    FrameTracks { time: MediaTime::from_secs(0.1 * seq as f64), ..tracks("gate", 1, seq, (320, 240), bbox) }
}

#[tokio::test]
async fn crossings_are_counted_told_and_kept() {
    let server = Server::start_with(HubConfig::default(), Default::default()).await;
    let _: &Hub = &server.hub;
    server.cameras.put("gate", "rtsp://host/x");
    server.cameras.put("yard", "rtsp://host/y");
    for (path, body) in [("lines", DOOR), ("zones", FLOOR)] {
        assert_eq!(server.post(&format!("/v1/cameras/gate/{path}"), body).await.status, 201);
    }
    let mut all = server.socket("/v1/events/live", &[]).await.unwrap();
    let mut crossings = server.socket("/v1/events/live?camera=gate&type=line.crossed", &[]).await.unwrap();
    for (seq, x) in [100.0, 120.0, 140.0, 180.0, 220.0].into_iter().enumerate() {
        let report = at(seq as u64, x);
        let happened = server.cameras.analyst(&id("gate"), |analyst| analyst.update(&report)).unwrap();
        happened.iter().for_each(|happening| server.events.publish(&report, happening));
    }
    let entered = all.json().await;
    assert_eq!((entered["type"].as_str(), entered["zone"].as_str()), (Some("zone.entered"), Some("floor")));
    let crossed = all.json().await;
    assert_eq!(
        (crossed["type"].as_str(), crossed["line"].as_str(), crossed["direction"].as_str()),
        (Some("line.crossed"), Some("door"), Some("in"))
    );
    assert_eq!(crossings.json().await, crossed, "the one that was asked for");
    assert_ne!(entered["id"], crossed["id"]);

    let recent = server.get("/v1/events").await.json();
    assert_eq!(recent["events"], json!([crossed, entered]), "the newest first");
    let of_kind = server.get("/v1/events?type=zone.entered&limit=5").await.json();
    assert_eq!(of_kind["events"], json!([entered]));
    assert_eq!(server.get("/v1/events?camera=yard").await.json(), json!({"events": []}));

    let counts = server.get("/v1/cameras/gate/counts").await.json();
    assert_eq!(counts["lines"], json!({"door": {"in": 1, "out": 0}}));
    let floor = json!({"occupancy": 1, "entries": 1, "exits": 0, "mean_dwell_s": null, "longest_s": 0.2, "crowded": false});
    assert_eq!(counts["zones"], json!({ "floor": floor }));
    let heat = server.get("/v1/cameras/gate/heatmap").await.json();
    let seconds: f64 = heat["seconds"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).sum();
    assert_eq!((heat["columns"].as_u64(), heat["rows"].as_u64()), (Some(64), Some(36)));
    assert!((seconds - 0.3).abs() < 1e-6, "{seconds}");
    server.stop().await;
}
