//! REST: cameras, problem documents, health, metrics, the page's files.

use std::sync::atomic::Ordering;

use serde_json::json;

use super::support::*;

#[tokio::test]
async fn a_camera_is_added_shown_and_deleted() {
    let server = Server::start().await;
    assert_eq!(server.get("/v1/cameras").await.json(), json!({"cameras": []}));

    let added = server.post("/v1/cameras", r#"{"id":"gate","url":"rtsp://host/x","transport":"tcp"}"#).await;
    assert_eq!(added.status, 201);
    assert!(added.head.contains("location: /v1/cameras/gate"), "{}", added.head);
    let expected = json!({
        "id": "gate", "url": "rtsp://host/x", "state": "live", "since": "2026-01-02T03:04:05.678Z",
        "last_error": null, "last_error_kind": null, "next_retry_s": null, "reconnects": 0, "epoch": 1,
        "width": 320, "height": 240, "fps": 25.0, "frames_in": 10, "tracked": 8, "dropped": {"stale": 2},
        "tracks": {"tentative": 0, "confirmed": 1, "lost": 0},
    });
    assert_eq!(added.json(), expected);
    assert_eq!(server.get("/v1/cameras/gate").await.json(), expected);
    assert_eq!(server.get("/v1/cameras").await.json(), json!({"cameras": [expected]}));

    let deleted = server.request("DELETE", "/v1/cameras/gate", &[], b"").await;
    assert_eq!((deleted.status, deleted.text()), (204, ""));
    assert_eq!(server.get("/v1/cameras/gate").await.status, 404);
    server.stop().await;
}

#[tokio::test]
async fn a_body_that_never_comes_is_not_waited_for() {
    let server = Server::start().await;
    let headers = [("Content-Type", "application/json"), ("Content-Length", "10")];
    let answer = server.request("POST", "/v1/cameras", &headers, b"").await;
    assert_eq!(answer.status, 400);
    assert!(answer.text().contains("did not arrive"), "{}", answer.text());
    server.stop().await;
}

#[tokio::test]
async fn a_list_comes_in_pages() {
    let server = Server::start().await;
    for name in ["d", "b", "a", "c", "e"] {
        server.cameras.put(name, "rtsp://host/x");
    }
    let (mut pages, mut path) = (vec![], "/v1/cameras?limit=2".to_owned());
    loop {
        let page = server.get(&path).await.json();
        let cameras = page["cameras"].as_array().unwrap();
        pages.push(cameras.iter().map(|c| c["id"].as_str().unwrap().to_owned()).collect::<String>());
        match page["next"].as_str() {
            Some(next) => path = format!("/v1/cameras?limit=2&cursor={next}"),
            None => break,
        }
    }
    assert_eq!(pages, ["ab", "cd", "e"]);
    let all = server.get("/v1/cameras").await.json();
    assert_eq!((all["cameras"].as_array().unwrap().len(), &all["next"]), (5, &serde_json::Value::Null));
    assert_eq!(server.get("/v1/cameras?limit=5").await.json(), all);
    for wrong in ["limit=0", "limit=x", "cursor=%20", "page=2"] {
        assert_eq!(server.get(&format!("/v1/cameras?{wrong}")).await.status, 400, "{wrong}");
    }
    server.stop().await;
}

#[tokio::test]
async fn who_has_an_answer_already_is_told_so() {
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/x");
    let first = server.get("/v1/cameras").await;
    let tag = |head: &str| {
        let line = head.lines().find_map(|line| line.strip_prefix("etag: "));
        line.map(str::to_owned)
    };
    let known = tag(&first.head).expect("a tag");
    let ask = async |tags: &str| server.request("GET", "/v1/cameras", &[("If-None-Match", tags)], b"").await;
    for tags in [known.clone(), format!("\"other\", W/{known}")] {
        let again = ask(&tags).await;
        assert_eq!((again.status, again.text(), tag(&again.head)), (304, "", Some(known.clone())));
    }
    server.cameras.change("gate", |camera| camera.frames_in += 1);
    let changed = ask(&known).await;
    assert_eq!((changed.status, &changed.json()["cameras"][0]["frames_in"]), (200, &json!(11)));
    assert_ne!(tag(&changed.head), Some(known));
    // What is not JSON, and what is refused, has none.
    assert_eq!(tag(&server.get("/metrics").await.head), None);
    assert_eq!(tag(&server.get("/v1/cameras/nope").await.head), None);
    server.stop().await;
}

/// Every error is a problem document with a kind for programs and a detail that names what was wrong.
#[tokio::test]
async fn errors_are_problem_documents() {
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/x");
    let json_type: &[(&str, &str)] = &[("Content-Type", "application/json")];
    let good = r#"{"id":"b","url":"rtsp://host/x"}"#;
    let too_large = format!(r#"{{"id":"b","url":"{}"}}"#, "x".repeat(65 * 1024));
    for (method, path, headers, body, status, kind, detail) in [
        ("GET", "/v1/cameras/nope", json_type, "", 404, "unknown-camera", "\"nope\""),
        ("GET", "/v1/cameras/%3Cb%3E", json_type, "", 404, "unknown-camera", "<b>"),
        ("DELETE", "/v1/cameras/nope", json_type, "", 404, "unknown-camera", "\"nope\""),
        ("GET", "/v1/cameras/nope/snapshot.jpg", json_type, "", 404, "unknown-camera", "\"nope\""),
        ("GET", "/v1/cameras/nope/stream.mjpeg", json_type, "", 404, "unknown-camera", "\"nope\""),
        ("GET", "/v1/cameras/gate/snapshot.jpg", json_type, "", 503, "unavailable", "no picture yet"),
        ("GET", "/v1/cameras/gate/snapshot.jpg?annotate=1", json_type, "", 400, "bad-request", "annotate"),
        ("GET", "/v1/cameras/gate/stream.mjpeg?x=1", json_type, "", 400, "bad-request", "\"x\""),
        ("GET", "/v1/tracks", json_type, "", 426, "websocket-only", "WebSocket"),
        ("GET", "/v1/history/tracks", json_type, "", 503, "no-history", "\"none\""),
        ("GET", "/nowhere", json_type, "", 404, "not-found", "/nowhere"),
        ("PUT", "/v1/cameras", json_type, "", 405, "method-not-allowed", "PUT"),
        (
            "POST",
            "/v1/cameras",
            json_type,
            r#"{"id":"gate","url":"rtsp://h"}"#,
            409,
            "camera-exists",
            "delete it",
        ),
        ("POST", "/v1/cameras", json_type, r#"{"id":"b","url":"nonsense"}"#, 400, "bad-request", "nonsense"),
        ("POST", "/v1/cameras", json_type, r#"{"id":"b c","url":"rtsp://h"}"#, 400, "bad-request", "\"b c\""),
        ("POST", "/v1/cameras", json_type, r#"{"id":"b"}"#, 400, "bad-request", "`url`"),
        (
            "POST",
            "/v1/cameras",
            json_type,
            r#"{"id":"b","url":"x://y","uri":1}"#,
            400,
            "bad-request",
            "`uri`",
        ),
        (
            "POST",
            "/v1/cameras",
            json_type,
            r#"{"id":"b","url":"x://y","transport":"x"}"#,
            400,
            "bad-request",
            "`x`",
        ),
        ("POST", "/v1/cameras", json_type, r#"{"id":"#, 400, "bad-request", "column"),
        ("POST", "/v1/cameras", json_type, "", 400, "bad-request", "EOF"),
        ("POST", "/v1/cameras", &[], good, 415, "media-type", "application/json"),
        (
            "POST",
            "/v1/cameras",
            &[("Content-Type", "text/plain")],
            good,
            415,
            "media-type",
            "application/json",
        ),
        ("POST", "/v1/cameras", json_type, &too_large, 413, "too-large", "65536"),
    ] {
        let case = format!("{method} {path} {}", body.chars().take(60).collect::<String>());
        let answer = server.request(method, path, headers, body.as_bytes()).await;
        assert_eq!(answer.status, status, "{case}: {}", answer.text());
        assert!(answer.head.contains("content-type: application/problem+json"), "{case}: {}", answer.head);
        let problem = answer.json();
        assert_eq!(problem["type"], format!("urn:gakp:problem:{kind}"), "{case}");
        assert_eq!(problem["status"], status, "{case}");
        assert!(!problem["title"].as_str().unwrap().is_empty(), "{case}");
        assert!(problem["detail"].as_str().unwrap().contains(detail), "{case}: {problem}");
    }
    assert_eq!(server.get("/v1/cameras").await.json()["cameras"].as_array().unwrap().len(), 1);
    server.stop().await;
}

#[tokio::test]
async fn the_limit_of_cameras_is_a_conflict() {
    let server = Server::start().await;
    for i in 0..=LIMIT {
        let answer = server.post("/v1/cameras", &format!(r#"{{"id":"c{i}","url":"rtsp://h/{i}"}}"#)).await;
        if i < LIMIT {
            assert_eq!(answer.status, 201);
        } else {
            assert_eq!(answer.status, 409);
            assert_eq!(answer.json()["type"], "urn:gakp:problem:camera-limit");
        }
    }
    server.stop().await;
}

#[tokio::test]
async fn health_readiness_and_metrics() {
    let server = Server::start().await;
    assert_eq!(server.get("/healthz").await.json(), json!({"status": "ok"}));
    assert_eq!(server.get("/readyz").await.json(), json!({"status": "ready"}));
    server.ready.store(false, Ordering::SeqCst);
    let answer = server.get("/readyz").await;
    assert_eq!(answer.status, 503);
    assert_eq!(answer.json(), json!({"status": "not ready", "reasons": ["the detector is not loaded"]}));
    assert_eq!(server.get("/healthz").await.status, 200, "not ready is not dead");

    let subscriber = server.socket("/v1/tracks", &[]).await.ok().unwrap();
    let metrics = server.get("/metrics").await;
    assert!(metrics.head.contains("content-type: text/plain; version=0.0.4"), "{}", metrics.head);
    assert!(metrics.text().contains("\ngakp_hub_subscribers 1\n"), "{}", metrics.text());
    drop(subscriber);
    let hub = server.hub.clone();
    eventually("the subscriber to be gone", || hub.metrics().subscribers.get() == 0).await;
    server.stop().await;
}

#[tokio::test]
async fn the_page_and_its_files_come_with_a_policy() {
    let server = Server::start().await;
    let page = server.get("/").await;
    assert!(page.head.contains("content-type: text/html; charset=utf-8"), "{}", page.head);
    assert!(page.head.contains("content-security-policy: default-src 'none'"), "{}", page.head);
    assert!(page.head.contains("cache-control: no-cache"), "{}", page.head);
    assert!(!page.text().contains("http"), "nothing from elsewhere");
    // What the page names is there and may be kept: its name changes with it. Without the built page it names nothing.
    let text = page.text();
    let names: Vec<&str> = text.split('"').filter(|part| part.starts_with("/page/")).collect();
    assert_eq!(names.is_empty(), option_env!("GAKP_PAGE").is_none(), "{text}");
    for name in names {
        let file = server.get(name).await;
        assert_eq!(file.status, 200, "{name}");
        assert!(file.head.contains("content-security-policy: default-src 'none'"), "{}", file.head);
        assert!(file.head.contains("cache-control: public, max-age=31536000, immutable"), "{}", file.head);
    }
    assert_eq!(server.get("/page/nothing.js").await.status, 404);
    server.stop().await;
}

/// Someone who says nothing holds up nobody, nor the end.
#[tokio::test]
async fn it_stops_in_time_whoever_is_connected() {
    let server = Server::start().await;
    let _silent = tokio::net::TcpStream::connect(server.addr).await.unwrap();
    let mut socket = server.socket("/v1/tracks", &[]).await.ok().unwrap();
    let code = tokio::spawn(async move { socket.closed().await });
    let took = server.stop().await;
    assert_eq!(code.await.unwrap(), 1001);
    // Two seconds are promised; a busy machine may be late, but not by the 15 s of a silent connection.
    assert!(took.as_secs_f64() < 6.0, "{took:?}");
}
