//! Webhooks of a running service: remembered, and those of the configuration read again.

use std::os::unix::fs::PermissionsExt;

use serde_json::{Value, json};

use super::receiver::*;
use super::support::*;

#[test]
fn webhooks_are_remembered_and_those_of_the_configuration_read_again() {
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (config, state) = (folder.path().join("gakp.toml"), folder.path().join("state"));
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (router, posts) = receiver(ok);
    let address = runtime.block_on(listen(router));
    let hook = |name: &str, more: &str| {
        format!("[[webhook]]\nname = \"{name}\"\nurl = \"http://{address}/hooks/{name}-T0KEN\"\n{more}\n")
    };
    let secret_file = folder.path().join("alarm.secret");
    std::fs::write(&secret_file, SECRET).unwrap();
    std::fs::write(
        &config,
        hook("stays", "") + &hook("changes", "secret_file = \"alarm.secret\"") + &hook("goes", ""),
    )
    .unwrap();
    let start = || Service::start(&state, &["--config", config.to_str().unwrap()]);
    let service = start();
    let all = |service: &Service| -> Vec<(String, String)> {
        let list = service.get("/v1/webhooks").json();
        let text = |hook: &Value, key: &str| hook[key].as_str().unwrap().to_owned();
        list["webhooks"]
            .as_array()
            .unwrap()
            .iter()
            .map(|hook| (text(hook, "name"), text(hook, "source")))
            .collect()
    };
    let pair = |name: &str, source: &str| (name.to_owned(), source.to_owned());
    let added =
        json!({"name": "added", "url": format!("http://{address}/hooks/added-T0KEN"), "secret": SECRET});
    assert_eq!(service.post("/v1/webhooks", &added).status, 201);
    let by_file = |name: &str| pair(name, "configuration");
    assert_eq!(all(&service), [by_file("stays"), by_file("changes"), by_file("goes"), pair("added", "api")]);
    let refused = service.delete("/v1/webhooks/goes");
    assert!(refused.status == 409 && refused.body.contains("configured-webhook"), "{refused:?}");

    // The file is read again: a name that is taken, then a secret, a webhook that goes, one that comes.
    std::fs::write(&secret_file, SECRET.replace("MDEy", "MDEx")).unwrap();
    let changed = "secret_file = \"alarm.secret\"";
    let next = hook("stays", "") + &hook("changes", changed) + &hook("comes", "");
    std::fs::write(&config, next.clone() + &hook("added", "")).unwrap();
    let taken = service.request("POST", "/v1/reload", None);
    assert!(taken.status == 400 && taken.body.contains("one of this name was added"), "{taken:?}");
    assert_eq!(all(&service).len(), 4, "nothing changed");
    std::fs::write(&config, next).unwrap();
    let done = service.request("POST", "/v1/reload", None).json();
    assert_eq!(done["webhooks"], json!(["goes", "changes", "comes"]), "{done}");
    assert_eq!((&done["restart"], &done["mqtt"]), (&json!([]), &json!(false)));
    assert_eq!(done["failed"], json!([]));
    assert_eq!(all(&service), [by_file("stays"), by_file("changes"), by_file("comes"), pair("added", "api")]);
    let trial = |service: &Service, name: &str| {
        service.request("POST", &format!("/v1/webhooks/{name}/test"), None).json()["delivered"].clone()
    };
    assert_eq!(trial(&service, "changes"), true);
    let post = posts.lock().unwrap().pop().unwrap();
    assert!(post.headers.contains_key("webhook-signature") && !post.is_signed(), "by the new secret");

    // Remembered, readable by its owner alone; a name of both is a mistake at the start, too.
    let log = service.stop();
    assert!(!log.contains("T0KEN") && !log.contains("whsec_"), "{log}");
    let file = state.join("webhooks.json");
    assert_eq!(std::fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
    std::fs::write(&config, hook("added", "")).unwrap();
    let output = run_to_end(
        &["serve", "--state-dir", state.to_str().unwrap(), "--config", config.to_str().unwrap()],
        &[],
    );
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(
        output.status.code() == Some(2) && said.contains("webhook \"added\": one of this name"),
        "{said}"
    );
    std::fs::write(&config, hook("stays", "")).unwrap();
    let service = start();
    assert_eq!(all(&service), [by_file("stays"), pair("added", "api")]);
    assert_eq!(trial(&service, "added"), true);
    assert!(posts.lock().unwrap().pop().unwrap().is_signed());
    // Another address of the same configuration, by SIGHUP.
    std::fs::write(&config, "").unwrap();
    service.process.signal("HUP");
    eventually("its end", || (all(&service) == [pair("added", "api")]).then_some(()));
    assert_eq!(service.delete("/v1/webhooks/added").status, 204);
    service.stop();
    assert!(all(&start()).is_empty());
    // Of a later version, perhaps: kept, told, and mended over REST; the others work.
    let kept = |name: &str, kind: &str| {
        json!({"anywhere": true, "webhook": {"name": name, "url": format!("http://{address}/hooks/T0KEN"),
               "types": [kind]}})
    };
    let both = json!({"webhooks": [kept("later", "line.vanished"), kept("works", "line.crossed")]});
    std::fs::write(&file, both.to_string()).unwrap();
    let service = start();
    assert_eq!(all(&service), [pair("later", "api"), pair("works", "api")]);
    assert_eq!((trial(&service, "later"), trial(&service, "works")), (json!(false), json!(true)));
    let later = service.get("/v1/webhooks/later").json();
    let error = later["last_error"].as_str().unwrap();
    assert!(error.contains("cannot be used any more") && error.contains("line.vanished"), "{later}");
    assert_eq!((&later["types"], &later["timeout_s"]), (&json!(["line.vanished"]), &json!(10.0)));
    assert_eq!(service.metrics().get("gakp_webhook_up{webhook=\"later\"}"), 0.0);
    assert_eq!(service.request("POST", "/v1/reload", None).json()["webhooks"], json!([]));
    let patch = service.request("PATCH", "/v1/webhooks/later", Some(r#"{"types": ["line.crossed"]}"#));
    assert_eq!(patch.json()["last_error"], Value::Null, "{patch:?}");
    assert_eq!(trial(&service, "later"), true);
    assert_eq!(all(&service), [pair("later", "api"), pair("works", "api")]);
    let log = service.stop();
    assert!(log.contains("line.vanished") && !log.contains("T0KEN"), "{log}");
    assert!(!std::fs::read_to_string(&file).unwrap().contains("vanished"));
    // Damaged: said, and left as it is.
    std::fs::write(&file, "{\"webhooks\": [").unwrap();
    let output = run_to_end(&["serve", "--state-dir", state.to_str().unwrap()], &[]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(2) && said.contains("webhooks.json is damaged"), "{said}");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "{\"webhooks\": [");
}
