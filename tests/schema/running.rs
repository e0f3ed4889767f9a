//! The running service against the document: schemathesis' requests, and what it cannot send or wait for.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

use serde_json::{Value, json};

use super::support::*;
use super::tools::*;

/// Longest that one run may take.
const LIMIT: Duration = Duration::from_secs(90);

/// Cameras that cost next to nothing and lead nowhere outside the service.
const URLS: [&str; 2] = ["test:?fps=1&width=64&height=48", "test:?fps=2&width=96&height=64&pattern=snow"];

/// A receiver that nobody is.
const RECEIVER: &str = "http://127.0.0.1:9/hook";

/// What does not end, and gRPC, which schemathesis does not speak: tests/api/grpc.rs.
const ENDLESS: [&str; 6] = [
    "--exclude-operation-id",
    "stream",
    "--exclude-operation-id",
    "trackStream",
    "--exclude-operation-id",
    "subscribe",
];

/// The document as it is tried: closed, and where a request would open whatever is made up (a host, a file) only
/// harmless values are left. Examples name what is there.
fn tried(token: &str) -> Value {
    let mut document = closed();
    let schemas = &mut document["components"]["schemas"];
    schemas["NewCamera"]["properties"]["url"] = json!({"enum": URLS});
    schemas["CameraPatch"]["properties"]["url"] = json!({"enum": [URLS[0], URLS[1], null]});
    for schema in ["NewWebhook", "WebhookPatch"] {
        schemas[schema]["properties"]["url"] = json!({"enum": [RECEIVER]});
    }
    document["components"]["parameters"]["CameraId"]["example"] = json!("demo");
    let post = |document: &mut Value, path: &str, example: Value| {
        let content = &mut document["paths"][path]["post"]["requestBody"]["content"]["application/json"];
        *content = json!({"schema": content["schema"], "example": example});
    };
    post(&mut document, "/v1/cameras", json!({"id": "new", "url": URLS[0]}));
    post(&mut document, "/v1/webhooks", json!({"name": "alarm", "url": RECEIVER}));
    post(&mut document, "/v1/session", json!({"token": token}));
    // schemathesis takes events apart and judges each; messages.rs holds their data to its schema.
    let stream = &mut document["paths"]["/v1/tracks/stream"]["get"]["responses"]["200"]["content"];
    stream["text/event-stream"] = json!({"schema": {
        "type": "object", "additionalProperties": false, "required": ["event", "data"],
        "properties": {"event": {"enum": ["tracks", "gap"]}, "data": {"type": "string"}},
    }});
    document
}

/// The statuses that were seen of each operation.
type Seen = BTreeMap<String, BTreeSet<u64>>;

/// Lets schemathesis try the service; fails with its report if it finds anything.
#[track_caller]
fn try_out(service: &Service, document: &Value, args: &[&str], seen: &mut Seen) {
    let folder = tempfile::tempdir().unwrap();
    let (file, log) = (folder.path().join("openapi.json"), folder.path().join("log.har"));
    std::fs::write(&file, document.to_string()).unwrap();
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/schema/schemathesis.toml");
    let mut command = Command::new(tool("schemathesis"));
    command.arg("--config-file").arg(config).arg("run").arg(file);
    command.args([
        "--url",
        &format!("http://{}", service.address),
        "--checks",
        "all",
        "--seed",
        "1",
        "--no-color",
    ]);
    command.args(["--generation-database", "none", "--request-timeout", "20"]);
    command.args(["--report", "har", "--report-har-path"]).arg(&log).args(args);
    let (well, said) = run(&mut command, folder.path(), "", LIMIT);
    assert!(well, "{said}");
    let log: Value = serde_json::from_slice(&std::fs::read(log).unwrap()).unwrap();
    for entry in log["log"]["entries"].as_array().unwrap() {
        let (request, status) = (&entry["request"], entry["response"]["status"].as_u64().unwrap());
        let url = request["url"].as_str().unwrap().split('?').next().unwrap();
        let path = url.splitn(4, '/').nth(3).unwrap();
        if let Some(operation) = operation(document, request["method"].as_str().unwrap(), path) {
            seen.entry(operation).or_default().insert(status);
        }
    }
}

/// Which operation a request was of.
fn operation(document: &Value, method: &str, path: &str) -> Option<String> {
    let is_of = |template: &str| {
        let (a, b) = (template[1..].split('/'), path.split('/'));
        a.clone().count() == b.clone().count() && a.zip(b).all(|(a, b)| a.starts_with('{') || a == b)
    };
    let paths = document["paths"].as_object().unwrap();
    // What is said literally goes before what is named.
    let item =
        paths.iter().filter(|(path, _)| is_of(path)).min_by_key(|(path, _)| path.matches('{').count())?.1;
    Some(item.get(method.to_lowercase())?["operationId"].as_str()?.to_owned())
}

fn start(state: &Path) -> Service {
    let args = ["--max-cameras", "6", "--camera", "demo=test:?fps=5&width=320&height=240"];
    Service::start(state, &args)
}

#[test]
fn the_running_service_keeps_to_the_document() {
    let schemathesis = tool("schemathesis");
    assert!(schemathesis.exists());
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut seen = Seen::new();

    // Open to everybody. First the stream of tracks, while its camera is sure to have some: of a stream one event is
    // read. Then without deleting cameras, so that the one that is known stays; then with.
    let service = start(&folder.path().join("open"));
    service.wait_for_frames("demo", 1);
    let document = tried("none");
    let open = ["--exclude-checks", "ignored_auth"];
    let fuzz = ["--phases", "examples,coverage,fuzzing", "--max-examples", "20"];
    let only_tracks = ["--include-operation-id", "trackStream"];
    try_out(&service, &document, &[&open[..], &fuzz, &only_tracks].concat(), &mut seen);
    let lasting = [&open[..], &fuzz, &ENDLESS, &["--exclude-operation-id", "removeCamera"]].concat();
    try_out(&service, &document, &lasting, &mut seen);
    let passing = [
        "--include-tag",
        "cameras",
        "--include-tag",
        "lines and zones",
        "--include-tag",
        "masks",
        "--max-examples",
        "10",
    ];
    try_out(&service, &document, &[&open[..], &passing].concat(), &mut seen);
    assert_eq!(service.get("/readyz").status, 200);
    assert!(!service.stop().contains("panicked"));

    // By an operator who may see pictures: with the token, with a wrong one, without.
    let state = folder.path().join("locked");
    let create =
        ["token", "--state-dir", state.to_str().unwrap(), "create", "desk", "--role", "operator", "--video"];
    let Output { status, stdout, .. } = run_to_end(&create, &[]);
    assert!(status.success());
    let token = String::from_utf8(stdout).unwrap().trim().to_owned();
    let service = start(&state);
    let header = format!("Authorization: Bearer {token}");
    let args = ["--header", &header, "--phases", "examples,coverage,fuzzing", "--max-examples", "5"];
    try_out(&service, &tried(&token), &[&args[..], &ENDLESS].concat(), &mut seen);
    assert_eq!(service.get("/readyz").status, 200);
    assert!(!service.stop().contains("panicked"));

    // Each was answered as it is when all is well, not only refused.
    let document = super::tools::document();
    for item in document["paths"].as_object().unwrap().values() {
        for operation in item.as_object().unwrap().values().filter(|value| value.is_object()) {
            let name = operation["operationId"].as_str().unwrap();
            let first = operation["responses"].as_object().unwrap().keys().next().unwrap().parse().unwrap();
            let well = if first == 101 { 426 } else { first };
            let statuses = seen.get(name).cloned().unwrap_or_default();
            println!("{name}: {statuses:?}");
            // There is nobody in the test picture to be remembered: tests/service/history.rs asks for tracks.
            let elsewhere = ["stream", "subscribe", "historyTrack", "historySnapshot"].contains(&name);
            assert!(elsewhere || statuses.contains(&well), "{name} was never answered {well}: {statuses:?}");
        }
    }
}

/// The head of an answer to a request as it is given, and its body's beginning.
fn raw(service: &Service, request: &str) -> String {
    let mut stream = TcpStream::connect(service.address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "{request} HTTP/1.0\r\nHost: {}\r\n\r\n", service.address).unwrap();
    let mut bytes = [0; 4096];
    let mut text = String::new();
    while !text.contains("\r\n\r\n") {
        let got = stream.read(&mut bytes).unwrap();
        assert!(got > 0, "{text}");
        text += &String::from_utf8_lossy(&bytes[..got]);
    }
    text.to_lowercase()
}

#[test]
fn what_no_generator_tries_is_answered_as_described() {
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let service = start(&folder.path().join("state"));
    let served = service.get("/v1/openapi.json");
    assert!(served.status == 200 && served.json() == document());
    assert!(served.head.to_lowercase().contains("content-type: application/json"), "{}", served.head);

    // A path that is no UTF-8.
    for path in ["", "/snapshot.jpg", "/lines", "/lines/door", "/counts"] {
        let refused = service.get(&format!("/v1/cameras/%ff{path}"));
        assert_eq!(refused.status, 400, "{path}");
        assert_eq!(refused.json()["type"], "urn:gakp:problem:bad-request");
        assert!(
            refused.head.to_lowercase().contains("content-type: application/problem+json"),
            "{}",
            refused.head
        );
    }
    // Arrays are no objects, however well their items would fit.
    let door = json!([[0.5, 1], [0.5, 0]]);
    for (path, body) in [
        ("/v1/cameras", json!(["new", URLS[0], null, false, false, [], []])),
        ("/v1/cameras", json!({"id": "new", "url": URLS[0], "lines": [["door", door, "foot"]]})),
        ("/v1/cameras/demo/lines", json!(["door", door, "foot"])),
        ("/v1/session", json!(["token"])),
    ] {
        let refused = service.post(path, &body);
        assert_eq!(refused.status, 400, "{body}: {refused:?}");
    }
    // To JSON 8.0 is 8.
    let zone = |capacity: Value| json!({"id": "z", "points": [[0, 0], [1, 0], [1, 1]], "capacity": capacity});
    for (capacity, status) in
        [(json!(8.0), 201), (json!(8.5), 400), (json!(-1), 400), (json!(4_294_967_296u64), 400)]
    {
        let answer = service.post("/v1/cameras/demo/zones", &zone(capacity));
        assert_eq!(answer.status, status, "{answer:?}");
    }
    assert_eq!(service.get("/v1/cameras/demo/zones/z").json()["capacity"], 8);
    // Live pictures.
    let head = raw(&service, "GET /v1/cameras/demo/stream.mjpeg");
    assert!(
        head.contains(" 200 ") && head.contains("content-type: multipart/x-mixed-replace; boundary="),
        "{head}"
    );
    assert!(head.contains("cache-control: no-store"), "{head}");
    for (path, status) in [("none/stream.mjpeg", 404), ("demo/stream.mjpeg?annotate=maybe", 400)] {
        assert_eq!(service.get(&format!("/v1/cameras/{path}")).status, status, "{path}");
    }
    service.stop();
}
