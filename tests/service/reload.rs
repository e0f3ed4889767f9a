//! A running service reads its configuration again, and logs otherwise when told to.

use serde_json::json;

use super::support::*;

#[test]
fn a_configuration_is_read_again() {
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (config, state) = (folder.path().join("gakp.toml"), folder.path().join("state"));
    let pattern = |name: &str, fps: u32| {
        format!("[[camera]]\nid = \"{name}\"\nurl = \"test:?fps={fps}&width=320&height=240\"\n")
    };
    let write = |text: String| std::fs::write(&config, text).unwrap();
    write(pattern("stays", 5) + &pattern("changes", 5) + &pattern("goes", 5));
    let service = Service::start(&state, &["--config", config.to_str().unwrap()]);
    let stays = service.camera("stays")["epoch"].clone();
    let line = json!({"id": "door", "points": [[0.5, 1.0], [0.5, 0.0]]});
    assert_eq!(service.post("/v1/cameras/changes/lines", &line).status, 201);

    write(
        "max_cameras = 7\n".to_owned() + &pattern("stays", 5) + &pattern("changes", 7) + &pattern("comes", 5),
    );
    service.process.signal("HUP");
    eventually("the new camera", || (service.get("/v1/cameras/comes").status == 200).then_some(()));
    eventually("its word in the log", || {
        service.process.log().contains("the configuration was read again").then_some(())
    });
    assert_eq!(service.get("/v1/cameras/goes").status, 404);
    assert_eq!(service.camera("stays")["epoch"], stays, "what is the same is left alone");
    assert!(service.camera("changes")["url"].as_str().unwrap().contains("fps=7"));
    let lines = service.get("/v1/cameras/changes/lines").json();
    assert_eq!(lines["lines"][0]["id"], "door", "what was drawn stays");
    service.wait_for_frames("comes", 2);

    // Again, by the API: nothing new but what takes a restart.
    let reload = || service.request("POST", "/v1/reload", None);
    let expected = json!({"cameras": [], "webhooks": [], "mqtt": false, "certificate": false, "restart": ["max_cameras"], "failed": []});
    assert_eq!(reload().json(), expected);
    // A mistake changes nothing, and is told.
    write("colour = \"red\"\n".to_owned() + &pattern("only", 5));
    let refused = reload();
    assert!(refused.status == 400 && refused.body.contains("colour"), "{refused:?}");
    assert_eq!(service.get("/v1/cameras").json()["cameras"].as_array().unwrap().len(), 3);
    // What was changed by hand wins over the file, and is said.
    let patch = service.request("PATCH", "/v1/cameras/stays", Some(r#"{"paused": true}"#));
    assert_eq!(patch.status, 200, "{patch:?}");
    write(pattern("stays", 9));
    let done = reload().json();
    assert!(done["failed"][0].as_str().unwrap().contains("stays"), "{done}");
    assert_eq!(service.camera("stays")["state"], "paused");
    assert_eq!(service.get("/v1/cameras/comes").status, 404, "{done}");

    // Logs.
    assert_eq!(service.get("/v1/log").json(), json!({"level": "info"}));
    let set = |level: &str| service.request("PUT", "/v1/log", Some(&json!({"level": level}).to_string()));
    for wrong in ["loud", "info,gakp=loud"] {
        assert_eq!(set(wrong).status, 400, "{wrong}");
    }
    assert_eq!(set("error").status, 200);
    let before = service.process.log().len();
    assert_eq!(reload().status, 200);
    assert_eq!(&service.process.log()[before..], "", "what is below the level is not told");
    assert_eq!(set("warn,gakp=info").status, 200);
    assert_eq!(reload().status, 200);
    eventually("more in the log", || (service.process.log()[before..].contains("read again")).then_some(()));
    assert_eq!(service.get("/v1/log").json(), json!({"level": "warn,gakp=info"}));
    service.stop();
}
