//! `gakp token`, and a service that asks for tokens.

use std::fs;
use std::process::Output;

use serde_json::json;

use super::support::*;

/// What `gakp token` prints, which must end well.
#[track_caller]
fn token(state: &str, args: &[&str]) -> String {
    let all = [&["token", "--state-dir", state], args].concat();
    let Output { status, stdout, stderr } = run_to_end(&all, &[]);
    assert!(status.success(), "{args:?}: {}", String::from_utf8_lossy(&stderr));
    String::from_utf8(stdout).unwrap()
}

#[test]
fn tokens_are_made_listed_asked_for_and_revoked() {
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let state_text = state.to_str().unwrap();
    let admin = token(state_text, &["create", "boss", "--role", "admin"]).trim().to_owned();
    let viewer = token(state_text, &["create", "wall"]).trim().to_owned();
    assert!(admin.starts_with("gakp_") && admin.len() > 60 && admin != viewer);
    let list = token(state_text, &["list"]);
    assert!(list.contains("boss\tadmin\tvideo") && list.contains("wall\tviewer\tno video"), "{list}");
    assert!(!list.contains(&admin[8..]));
    for (args, expected) in [
        (vec!["create", "wall"], "a token named \"wall\" exists"),
        (vec!["create", "a b"], "\"a b\" is not usable"),
        (vec!["create", "x", "--role", "king"], "viewer, operator, admin"),
        (vec!["revoke", "nobody"], "no token named \"nobody\""),
    ] {
        let all = [&["token", "--state-dir", state_text], &args[..]].concat();
        let Output { status, stderr, .. } = run_to_end(&all, &[]);
        let text = String::from_utf8(stderr).unwrap();
        assert!(status.code() == Some(2) && text.contains(expected), "{args:?}: {text}");
    }

    let secret = folder.path().join("secret");
    fs::write(&secret, "0123456789abcdef0123456789abcdef\n").unwrap();
    let args =
        ["--log", "debug", "--camera", "demo=test:?fps=5", "--admin-token-file", secret.to_str().unwrap()];
    let service = Service::start(&state, &args);
    assert_eq!(service.get("/v1/cameras").status, 401);
    assert_eq!(service.get("/metrics").status, 401);
    assert_eq!(service.get("/healthz").status, 200);
    let new = json!({"id": "new", "url": "test:?fps=5"}).to_string();
    for (bearer, get, post) in [
        (viewer.as_str(), 200, 403),
        (admin.as_str(), 200, 201),
        ("0123456789abcdef0123456789abcdef", 200, 409),
    ] {
        assert_eq!(service.request_as(bearer, "GET", "/v1/cameras", None).status, get);
        assert_eq!(service.request_as(bearer, "POST", "/v1/cameras", Some(&new)).status, post);
    }
    assert_eq!(service.request_as(&viewer, "GET", "/v1/cameras/demo/snapshot.jpg", None).status, 403);
    // Made and revoked while it runs.
    let later = token(state_text, &["create", "later", "--video"]).trim().to_owned();
    eventually("the new token to be known", || {
        (service.request_as(&later, "GET", "/v1/cameras", None).status == 200).then_some(())
    });
    token(state_text, &["revoke", "later"]);
    eventually("the token to be gone", || {
        (service.request_as(&later, "GET", "/v1/cameras", None).status == 401).then_some(())
    });
    let log = service.stop();
    for secret in [&admin, &viewer, &later, "0123456789abcdef0123456789abcdef"] {
        assert!(!log.contains(secret), "a token is in the log: {log}");
    }
}
