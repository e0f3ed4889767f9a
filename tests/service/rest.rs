//! Cameras over REST: remembered, forgotten, and their passwords kept.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use gakp::ingest::testcam::{TestCamera, TestCameraConfig};
use serde_json::json;

use super::support::*;

const PASSWORD: &str = "p4ss-Wort";

fn start(state: &Path) -> Service {
    Service::start(state, &["--log", "info,gakp=debug", "--camera", "generated=test:?fps=5"])
}

#[test]
fn cameras_are_remembered_and_forgotten_and_passwords_kept() {
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let camera = TestCamera::start(TestCameraConfig {
        login: Some(("viewer".into(), PASSWORD.into())),
        ..TestCameraConfig::new(tiny_clip(folder.path()))
    })
    .unwrap();
    let address = camera.address();
    let url = |login: &str, path: &str| format!("rtsp://{login}@{address}{path}");
    let (right, shown) = (format!("viewer:{PASSWORD}"), "viewer:***");
    // Everything that the service says, to be searched for the password.
    let mut said = String::new();
    let mut keep = |response: Response| {
        said += &response.head;
        said += &response.body;
        response
    };

    let service = start(&state);
    let body = json!({"id": "gate", "url": url(&right, "/live"), "transport": "tcp"});
    let added = keep(service.post("/v1/cameras", &body));
    assert_eq!(added.status, 201, "{added:?}");
    assert!(added.head.to_lowercase().contains("location: /v1/cameras/gate"), "{added:?}");
    assert_eq!(added.json()["url"], url(shown, "/live"));
    let first_epoch = added.json()["epoch"].as_u64().unwrap();
    for (id, login, path, kind) in [
        ("locked", "viewer:wrong-p4ss-Wort", "/live", "unauthorized"),
        ("astray", right.as_str(), "/other", "not_found"),
    ] {
        let added = keep(service.post("/v1/cameras", &json!({"id": id, "url": url(login, path)})));
        assert_eq!(added.status, 201, "{added:?}");
        let status = service.wait_for_state(id, "retrying");
        assert_eq!(status["last_error_kind"], kind, "{status}");
        keep(service.get(&format!("/v1/cameras/{id}")));
    }
    service.wait_for_frames("gate", 3);
    for (body, status) in [
        (json!({"id": "gate", "url": url(&right, "/live")}), 409),
        (json!({"id": "bad", "url": format!("ftp://{right}@host/x")}), 400),
        (json!({"id": "bad", "url": format!("rtsp:/{right}@host/x")}), 400),
        (json!({"id": "bad", "url": format!("rtsp://{right}@host:port/x")}), 400),
        (json!({"id": "b a d", "url": url(&right, "/live")}), 400),
        (json!({"id": "bad", "url": url(&right, "/live"), "transprot": "tcp"}), 400),
        (json!({"url": url(&right, "/live")}), 400),
    ] {
        let refused = keep(service.post("/v1/cameras", &body));
        assert_eq!(refused.status, status, "{body}: {refused:?}");
    }
    keep(service.get("/v1/cameras"));
    keep(service.get("/metrics"));
    let file = state.join("cameras.json");
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600, "only the owner reads it");
    let log = service.stop();
    assert!(log.contains("viewer:***"), "the log names the camera: {log}");
    said += &log;
    let mut keep = |response: Response| {
        said += &response.body;
        response
    };

    // The service comes again: so do its cameras, with ids of a new epoch.
    let service = start(&state);
    service.wait_for_frames("gate", 3);
    let gate = keep(service.get("/v1/cameras/gate")).json();
    assert!(gate["epoch"].as_u64().unwrap() > first_epoch, "{gate}");
    assert_eq!((&gate["url"], &gate["state"]), (&json!(url(shown, "/live")), &json!("live")));
    let names = |service: &Service| -> Vec<String> {
        let list = service.get("/v1/cameras").json();
        list["cameras"].as_array().unwrap().iter().map(|c| c["id"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(names(&service), ["astray", "gate", "generated", "locked"]);
    for id in ["gate", "locked"] {
        assert_eq!(service.delete(&format!("/v1/cameras/{id}")).status, 204);
        assert_eq!(service.get(&format!("/v1/cameras/{id}")).status, 404);
        assert_eq!(service.delete(&format!("/v1/cameras/{id}")).status, 404);
    }
    let metrics = keep(service.get("/metrics"));
    assert!(!metrics.body.contains("camera=\"gate\""), "the series of a deleted camera go");
    said += &service.stop();

    let service = start(&state);
    assert_eq!(names(&service), ["astray", "generated"], "what was deleted stays gone");
    // The name is free again, and its ids are not those of the earlier camera of this name.
    let again = service.post("/v1/cameras", &json!({"id": "gate", "url": url(&right, "/live")})).json();
    assert!(again["epoch"].as_u64() > gate["epoch"].as_u64(), "{again}");
    said += &service.stop();
    assert!(!said.contains("p4ss-Wort"), "a password in: {said}");
}

#[test]
fn a_camera_is_paused_changed_and_resumed() {
    let state = tempfile::tempdir().unwrap();
    let Some(service) = Service::demo(state.path()) else { return };
    let patch = |service: &Service, body: &str| service.request("PATCH", "/v1/cameras/demo", Some(body));
    let all = json!({"id": "all", "points": [[0, 0], [1, 0], [1, 1], [0, 1]]});
    assert_eq!(service.post("/v1/cameras/demo/zones", &all).status, 201);
    let entries = |service: &Service| {
        service.get("/v1/cameras/demo/counts").json()["zones"]["all"]["entries"].as_u64().unwrap()
    };
    eventually("somebody in the zone", || (entries(&service) > 0).then_some(()));
    let before = service.camera("demo");

    let paused = patch(&service, r#"{"paused": true}"#);
    assert_eq!((paused.status, paused.json()["state"].as_str()), (200, Some("paused")), "{paused:?}");
    let counted = entries(&service);
    assert!(counted > 0, "what was counted stays");
    assert_eq!(service.get("/v1/cameras/demo/counts").json()["zones"]["all"]["occupancy"], 0);
    assert!(!service.get("/metrics").body.contains("gakp_camera_up{"), "neither up nor down");
    let tracked = service.camera("demo")["tracked"].as_u64().unwrap();
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert_eq!(service.camera("demo")["tracked"].as_u64().unwrap(), tracked, "it rests");
    for (body, status) in [
        (r#"{"url": "ftp://x"}"#, 400),
        (r#"{"url": "/nowhere.mp4"}"#, 400),
        (r#"{"pause": true}"#, 400),
        ("{", 400),
    ] {
        assert_eq!(patch(&service, body).status, status, "{body}");
    }
    assert_eq!(service.camera("demo")["state"], "paused", "what is refused changes nothing");
    service.stop();

    // It is the command line's camera, and stays paused all the same.
    let service = Service::demo(state.path()).unwrap();
    assert_eq!(service.camera("demo")["state"], "paused");
    let resumed = patch(&service, r#"{"paused": false}"#);
    assert_eq!(resumed.status, 200, "{resumed:?}");
    service.wait_for_frames("demo", 3);
    let after = service.camera("demo");
    assert!(after["epoch"].as_u64() > before["epoch"].as_u64(), "{after}");
    assert_eq!(service.metrics().of("gakp_camera_up", "demo"), 1.0);
    let other = patch(&service, r#"{"url": "test:?fps=5", "loop": false}"#);
    assert_eq!((other.status, other.json()["url"].as_str()), (200, Some("test:?fps=5")), "{other:?}");
    service.wait_for_state("demo", "live");
    assert_eq!(service.delete("/v1/cameras/demo").status, 204);
    assert_eq!(patch(&service, "{}").status, 404);
    service.stop();
}
