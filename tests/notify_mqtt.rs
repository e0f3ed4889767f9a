//! MQTT against a real mosquitto (Debian's) and the real service: topics, Home Assistant's discovery, availability,
//! a broker that restarts.
#![cfg(all(feature = "cli", feature = "service", feature = "testcam"))]

#[path = "mqtt/broker.rs"]
mod broker;
#[path = "service/support.rs"]
mod support;

use std::collections::BTreeMap;
use std::path::Path;

use broker::{Broker, PASSWORD};
use serde_json::{Value, json};
use support::*;

/// `gakp serve` with the demo film as camera `demo`, a line and a zone, and a broker; `None` without the models.
fn service(state: &Path, broker: &Broker, more: &str) -> Option<Service> {
    let film = film()?;
    let secret = state.join("broker.password");
    std::fs::write(&secret, format!("{PASSWORD}\n")).unwrap();
    let config = format!(
        "[mqtt]\nurl = \"mqtt://{}\"\nuser = \"gakp\"\npassword_file = \"broker.password\"\n{more}\n\
         [[camera]]\nid = \"demo\"\nurl = \"{}\"\nloop = true\n\
         [[camera.lines]]\nid = \"door\"\npoints = [[0.5, 1.0], [0.5, 0.0]]\n\
         [[camera.lines]]\nid = \"back\"\npoints = [[0.1, 1.0], [0.1, 0.0]]\n\
         [[camera.zones]]\nid = \"floor\"\npoints = [[0, 0], [1, 0], [1, 1], [0, 1]]\n",
        broker.address,
        film.display()
    );
    let file = state.join("gakp.toml");
    std::fs::write(&file, config).unwrap();
    Some(Service::start(state, &["--config", file.to_str().unwrap()]))
}

/// Discovery documents among what is retained: by topic.
fn entities(retained: &BTreeMap<String, String>) -> BTreeMap<String, Value> {
    let found = retained.iter().filter(|(topic, _)| topic.starts_with("homeassistant/"));
    found.map(|(topic, text)| (topic.clone(), serde_json::from_str(text).expect(text))).collect()
}

fn connected(service: &Service) -> bool {
    service.metrics().get("gakp_mqtt_connected") == 1.0
}

#[test]
fn counts_and_entities_come_and_go_with_what_is_watched() {
    let Some(mut broker) = Broker::start() else { return };
    let state = tempfile::tempdir().unwrap();
    let Some(service) = service(state.path(), &broker, "tracks = true\nonvif = true\ntracks_rate = 10")
    else {
        return;
    };
    let listener = broker.listen("gakp/#");
    let count = |retained: &BTreeMap<String, String>| {
        let text = retained.get("gakp/demo/line/door")?;
        let counts: Value = serde_json::from_str(text).expect(text);
        Some(counts["in"].as_u64().unwrap() + counts["out"].as_u64().unwrap())
    };
    // They rise while people walk.
    let first = eventually("somebody to cross", || count(&listener.newest()).filter(|n| *n > 0));
    eventually("more to cross", || count(&listener.newest()).filter(|n| *n > first));
    let newest = listener.newest();
    assert_eq!(newest["gakp/status"], "online");
    let zone: Value = serde_json::from_str(&newest["gakp/demo/zone/floor"]).unwrap();
    assert!(zone["occupancy"].is_u64() && zone["entries"].as_u64() > Some(0), "{zone}");
    let camera: Value = serde_json::from_str(&newest["gakp/demo/state"]).unwrap();
    assert_eq!(camera, json!({"state": "up", "camera_state": "live", "reason": null, "kind": null}));
    let event: Value = serde_json::from_str(&newest["gakp/demo/event"]).unwrap();
    assert!(event["camera"] == "demo" && event["type"].is_string() && event["id"].is_string(), "{event}");
    let tracks: Value = serde_json::from_str(&newest["gakp/demo/tracks"]).unwrap();
    assert!(tracks["camera"] == "demo" && tracks["tracks"].is_array(), "{tracks}");

    // ONVIF: from the middle of the picture, upwards.
    let object = eventually("a person by ONVIF", || {
        let newest = listener.newest();
        let frame: Value =
            serde_json::from_str(newest.get("gakp/onvif-mj/VideoAnalytics/demo/gakp")?).unwrap();
        assert_eq!(frame["Frame"][0]["@Source"], "demo");
        assert!(frame["Frame"][0]["@UtcTime"].as_str().unwrap().ends_with('Z'), "{frame}");
        Some(frame["Frame"][0]["Object"].get(0)?.clone())
    });
    let shape = &object["Appearance"]["Shape"];
    let side = |name: &str| shape["BoundingBox"][name].as_f64().unwrap();
    assert!(side("@left") < side("@right") && side("@bottom") < side("@top"), "{object}");
    assert!(["@left", "@top", "@right", "@bottom"].iter().all(|name| side(name).abs() < 1.5), "{object}");
    assert_eq!(object["Appearance"]["Class"]["Type"][0]["#text"], "Human");
    assert!(object["@ObjectId"].is_u64());

    // Home Assistant: what is retained is what it needs.
    let found = entities(&broker.retained());
    let mut ids: Vec<_> = found.values().map(|entity| entity["unique_id"].as_str().unwrap()).collect();
    ids.sort_unstable();
    let expected =
        ["line/back/in", "line/back/out", "line/door/in", "line/door/out", "state", "zone/floor/occupancy"];
    assert_eq!(ids, expected.map(|id| format!("gakp/demo/{id}")));
    for (topic, entity) in &found {
        let levels: Vec<_> = topic.split('/').collect();
        assert!(
            matches!(levels[..], ["homeassistant", "sensor" | "binary_sensor", _, _, "config"]),
            "{topic}"
        );
        let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        assert!(levels[2..4].iter().all(|level| level.chars().all(allowed)), "{topic}");
        assert!(newest.contains_key(entity["state_topic"].as_str().unwrap()), "{entity}");
        assert_eq!(entity["availability_topic"], "gakp/status");
        assert_eq!(entity["device"]["identifiers"], json!(["gakp/demo"]));
        assert!(entity["origin"]["name"].is_string() && entity["value_template"].is_string(), "{entity}");
    }

    // A line that is deleted goes at once, and all that is said of it.
    assert_eq!(service.delete("/v1/cameras/demo/lines/back").status, 204);
    eventually("the line to go", || {
        let retained = broker.retained();
        (!retained.keys().any(|topic| topic.contains("back"))).then_some(())
    });
    assert_eq!(entities(&broker.retained()).len(), 4);

    // Home Assistant has started: it is told everything again.
    let discovered =
        || service.metrics().get("gakp_mqtt_messages_total{kind=\"discovery\",outcome=\"sent\"}");
    let before = discovered();
    broker.publish("homeassistant/status", "online");
    eventually("all entities again", || (discovered() >= before + 4.0).then_some(()));

    // A camera goes with all that is its.
    assert_eq!(service.delete("/v1/cameras/demo").status, 204);
    eventually("the camera to go", || (broker.retained().keys().eq(["gakp/status"])).then_some(()));

    // At the end it says so itself.
    let log = service.stop();
    assert_eq!(broker.retained()["gakp/status"], "offline");
    assert!(!log.contains(PASSWORD), "{log}");
    assert!(!broker.log().contains("exceeded timeout"), "{}", broker.log());
    broker.stop();
}

#[test]
fn a_broker_that_restarts_is_found_again_and_a_service_that_dies_is_known_to() {
    let Some(mut broker) = Broker::start() else { return };
    let state = tempfile::tempdir().unwrap();
    let Some(mut service) = service(state.path(), &broker, "") else { return };
    eventually("the connection", || connected(&service).then_some(()));
    eventually("the line", || broker.retained().contains_key("gakp/demo/line/back").then_some(()));

    // It keeps nothing: all must be told again. What happens meanwhile is told afterwards.
    broker.stop();
    eventually("the loss", || (!connected(&service)).then_some(()));
    let newest = service.get("/v1/events?limit=1").json()["events"][0]["id"].clone();
    let missed = eventually("an event meanwhile", || {
        let event = service.get("/v1/events?limit=1").json()["events"][0]["id"].clone();
        (event.is_string() && event != newest).then_some(event)
    });
    broker.restart();
    let listener = broker.listen("gakp/#");
    eventually("the connection again", || connected(&service).then_some(()));
    eventually("what happened meanwhile", || {
        let events = listener.all("gakp/demo/event");
        events.iter().any(|text| serde_json::from_str::<Value>(text).unwrap()["id"] == missed).then_some(())
    });
    eventually("the entities again", || (entities(&broker.retained()).len() == 6).then_some(()));
    assert_eq!(broker.retained()["gakp/status"], "online");

    // Killed: the broker says it.
    service.process.signal("KILL");
    service.process.wait();
    eventually("the last will", || (broker.retained()["gakp/status"] == "offline").then_some(()));
    let log = service.process.log();
    assert!(log.contains("no connection to the MQTT broker") && !log.contains(PASSWORD), "{log}");
    drop(service);

    // What an earlier run left and is no more goes, too.
    let config = state.path().join("gakp.toml");
    let text = std::fs::read_to_string(&config).unwrap();
    let from = text.find("[[camera.lines]]\nid = \"back\"").unwrap();
    let to = text.find("[[camera.zones]]").unwrap();
    std::fs::write(&config, format!("{}{}", &text[..from], &text[to..])).unwrap();
    let service = Service::start(state.path(), &["--config", config.to_str().unwrap()]);
    eventually("what is left over to go", || {
        let retained = broker.retained();
        let gone = !retained.keys().any(|topic| topic.contains("back"));
        (gone && retained.contains_key("gakp/demo/line/door") && entities(&retained).len() == 4).then_some(())
    });
    let log = service.stop();
    assert!(!log.contains(PASSWORD), "{log}");
}

#[test]
fn a_wrong_password_is_said_and_the_rest_goes_on() {
    let Some(broker) = Broker::start() else { return };
    let state = tempfile::tempdir().unwrap();
    let Some(film) = film() else { return };
    let config = format!(
        "[mqtt]\nurl = \"mqtt://gakp:wrong-{PASSWORD}@{}\"\n[[camera]]\nid = \"demo\"\nurl = \"{}\"\nloop = true\n",
        broker.address,
        film.display()
    );
    let file = state.path().join("gakp.toml");
    std::fs::write(&file, config).unwrap();
    let service = Service::start(state.path(), &["--config", file.to_str().unwrap()]);
    let refused = "no connection to the MQTT broker";
    eventually("the refusal", || service.process.log().contains(refused).then_some(()));
    service.wait_for_frames("demo", 5);
    assert!(!connected(&service));
    let log = service.stop();
    assert!(!log.contains(PASSWORD) && log.contains("NotAuthorized"), "{log}");
}

#[test]
fn a_broker_may_speak_tls_to_those_who_trust_it() {
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    let broker = Broker::start_with(|folder| {
        std::fs::write(folder.join("cert.pem"), made.cert.pem()).unwrap();
        std::fs::write(folder.join("key.pem"), made.signing_key.serialize_pem()).unwrap();
        format!("certfile {0}/cert.pem\nkeyfile {0}/key.pem\n", folder.display())
    });
    let (Some(broker), Some(_)) = (broker, models()) else { return };
    let state = tempfile::tempdir().unwrap();
    std::fs::write(state.path().join("ca.pem"), made.cert.pem()).unwrap();
    let config = format!(
        "[mqtt]\nurl = \"mqtts://localhost:{}\"\nuser = \"gakp\"\npassword = \"{PASSWORD}\"\nca_file = \"ca.pem\"\n\
         [[webhook]]\nname = \"chat\"\nurl = \"http://127.0.0.1:9/T0KEN\"\n",
        broker.address.port()
    );
    let file = state.path().join("gakp.toml");
    std::fs::write(&file, config).unwrap();
    let service = Service::start(state.path(), &["--config", file.to_str().unwrap()]);
    eventually("the connection", || connected(&service).then_some(()));
    // On the way, the answer about webhooks.
    let webhooks = service.get("/v1/webhooks").json();
    assert_eq!(webhooks["webhooks"][0]["url"], "http://127.0.0.1:9/...");
    let log = service.stop();
    assert!(!log.contains(PASSWORD) && !log.contains("T0KEN"), "{log}");
}

/// A broker that is told otherwise, and one that lets nobody in for a while: the next has what the one before did not
/// take, and what happened in between.
#[test]
fn no_event_is_lost_between_a_broker_and_the_next() {
    let Some(broker) = Broker::start() else { return };
    let state = tempfile::tempdir().unwrap();
    let Some(service) = service(state.path(), &broker, "") else { return };
    let (file, secret) = (state.path().join("gakp.toml"), state.path().join("broker.password"));
    let listener = broker.listen("gakp/#");
    let ids = |events: Vec<String>| -> Vec<String> {
        let id =
            |text: &String| serde_json::from_str::<Value>(text).unwrap()["id"].as_str().unwrap().to_owned();
        events.iter().map(id).collect()
    };
    let happened = || -> Vec<String> {
        let events = service.get("/v1/events?limit=1000").json()["events"].clone();
        ids(events.as_array().unwrap().iter().rev().map(Value::to_string).collect())
    };
    let more = |what: &str| {
        let before = happened().len();
        eventually(what, || (happened().len() > before).then_some(()));
    };
    let reload = || assert_eq!(service.request("POST", "/v1/reload", None).json()["mqtt"], true);
    eventually("the first event", || (!listener.all("gakp/demo/event").is_empty()).then_some(()));
    std::fs::write(&secret, "wrong").unwrap();
    reload();
    more("an event while nobody is let in");
    std::fs::write(&secret, PASSWORD).unwrap();
    reload();
    let config = std::fs::read_to_string(&file).unwrap();
    for rate in [2, 3, 4] {
        std::fs::write(&file, config.replace("[mqtt]\n", &format!("[mqtt]\nmax_rate = {rate}\n"))).unwrap();
        reload();
    }
    more("an event by the last one");
    let all = happened();
    let mut told = eventually("all of them", || {
        let told = ids(listener.all("gakp/demo/event"));
        told.contains(all.last().unwrap()).then_some(told)
    });
    // What the listener came too late for; and at least once may be twice.
    let first = all.iter().position(|id| *id == told[0]).unwrap();
    let mut seen = std::collections::BTreeSet::new();
    told.retain(|id| seen.insert(id.clone()));
    assert_eq!(told[..all.len() - first], all[first..]);
    assert_eq!(service.metrics().get("gakp_mqtt_messages_total{kind=\"event\",outcome=\"dropped\"}"), 0.0);
    service.stop();
}

#[test]
fn a_broker_comes_and_goes_with_the_configuration() {
    let Some(broker) = Broker::start() else { return };
    if models().is_none() {
        return;
    }
    let state = tempfile::tempdir().unwrap();
    let file = state.path().join("gakp.toml");
    let mqtt = |password: &str| format!("[mqtt]\nurl = \"mqtt://gakp:{password}@{}\"\n", broker.address);
    std::fs::write(&file, "").unwrap();
    let service = Service::start(state.path(), &["--config", file.to_str().unwrap()]);
    let reload = |text: &str| {
        std::fs::write(&file, text).unwrap();
        service.request("POST", "/v1/reload", None).json()["mqtt"].clone()
    };
    let figures = || service.get("/metrics").body.contains("gakp_mqtt_connected");
    assert!(!figures(), "without a broker there is nothing to be alarmed about");
    assert_eq!(reload(&mqtt("wrong")), true);
    eventually("the refusal", || {
        service.process.log().contains("no connection to the MQTT broker").then_some(())
    });
    assert!(figures() && !connected(&service));
    assert_eq!(reload(&mqtt(PASSWORD)), true);
    eventually("the connection", || connected(&service).then_some(()));
    eventually("its word", || (broker.retained().get("gakp/status")? == "online").then_some(()));
    assert_eq!(reload(&mqtt(PASSWORD)), false, "what is the same is left alone");
    // Whether it can be reached is tried beside the one that runs, which stays.
    let output = run_to_end(
        &["check", "--config", file.to_str().unwrap(), "--state-dir", state.path().to_str().unwrap()],
        &[],
    );
    let report = String::from_utf8(output.stdout).unwrap();
    let line = report.lines().find(|line| line.contains("MQTT")).unwrap_or_else(|| panic!("{report}"));
    assert!(line.starts_with("ok") && line.contains("is there"), "{line}");
    assert_eq!(broker.retained()["gakp/status"], "online", "no last will was told");
    assert!(connected(&service));
    assert_eq!(reload(""), true);
    assert!(!figures());
    assert_eq!(broker.retained()["gakp/status"], "offline");
    let log = service.stop();
    assert!(!log.contains(PASSWORD), "{log}");
}
