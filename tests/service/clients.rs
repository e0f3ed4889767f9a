//! The Python client that gakp ships, against the running service.

use std::collections::BTreeSet;
use std::path::Path;

use super::grpc_client::{python, run};
use super::support::*;

#[test]
fn the_python_client_sees_what_is_sent() {
    let Some(python) = python() else { return };
    let state = tempfile::tempdir().unwrap();
    let Some(service) = Service::demo(state.path()) else { return };
    let url = format!("http://{}", service.address);
    let mut socket = service.socket("/v1/tracks?camera=demo&state=confirmed");
    let example = ["clients/python/example.py", &url, "--camera", "demo", "--messages", "30"];
    let said = run(&python, &example);
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    let printed: BTreeSet<String> =
        String::from_utf8(said.stdout).unwrap().lines().map(str::to_owned).collect();
    assert!(!printed.is_empty(), "30 reports and nobody in them");

    // The same, as JSON: all that was printed was sent. The first line names the epoch and where to stop.
    let number = |line: &str, at: usize| line.split(' ').nth(at).unwrap().parse::<u64>().unwrap();
    let last = printed.iter().map(|line| number(line, 2)).max().unwrap();
    let mut sent = BTreeSet::new();
    loop {
        let report = socket.json();
        for track in report["tracks"].as_array().unwrap() {
            let line = [&report["epoch"], &report["seq"], &track["id"]].map(ToString::to_string).join(" ");
            sent.insert(format!("demo {line}"));
        }
        if report["seq"].as_u64().unwrap() >= last {
            break;
        }
    }
    for line in &printed {
        let name: Vec<_> = line.split(' ').take(4).collect();
        assert!(sent.contains(&name.join(" ")), "{line} was never sent");
    }

    // What trying again would not mend is told.
    let refused = run(&python, &["clients/python/example.py", &url, "--camera", "nobody"]);
    let why = String::from_utf8(refused.stderr).unwrap();
    assert!(refused.status.code() == Some(1) && why.contains("there is no camera \"nobody\""), "{why}");
    service.stop();
}

#[test]
fn the_python_messages_are_those_of_the_schema() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    let (python_out, pyi_out) = (format!("--python_out={out}"), format!("--pyi_out={out}"));
    let made = ["-m", "grpc_tools.protoc", "-I", "proto", &python_out, &pyi_out, "proto/tracks.proto"];
    let said = run(&python, &made);
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    for name in ["tracks_pb2.py", "tracks_pb2.pyi"] {
        let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/python/gakp_client").join(name);
        let (kept, made) = (std::fs::read(kept).unwrap(), std::fs::read(folder.path().join(name)).unwrap());
        assert!(kept == made, "{name} is out of date: clients/python/README.md says how it is made");
    }
}
