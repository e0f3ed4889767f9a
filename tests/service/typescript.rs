//! The TypeScript client that gakp ships, against the running service.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::{OnceLock, mpsc};
use std::time::Duration;

use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, WebSocket};
use tokio_tungstenite::tungstenite::{self, Message};

use super::grpc_client::python;
use super::support::*;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/typescript")
}

/// Whether its npm packages are there; said loudly when not. Where the environment has `CI` that is a failure.
fn ready() -> bool {
    let there = folder().join("node_modules/typescript/bin/tsc").exists();
    if !there {
        assert!(std::env::var_os("CI").is_none(), "the client's npm packages are missing; CI must have them");
        eprintln!("SKIPPED: the client's npm packages are missing: run `bash deploy/setup.sh test-packages`");
    }
    there
}

/// Node in the client's folder, which does not wait for ever.
fn node(args: &[&str]) -> Command {
    let mut command = Command::new("timeout");
    command.arg(PATIENCE.as_secs().to_string()).arg("node").args(args).current_dir(folder());
    command.env_remove("GAKP_TOKEN");
    command
}

#[track_caller]
fn well(said: Output) -> String {
    let text = String::from_utf8(said.stdout).unwrap();
    assert!(said.status.success(), "{}: {text}{}", said.status, String::from_utf8_lossy(&said.stderr));
    text
}

/// Builds the client, once; `false` as for [`ready`].
fn built() -> bool {
    static BUILT: OnceLock<()> = OnceLock::new();
    let ready = ready();
    if ready {
        BUILT.get_or_init(|| {
            well(node(&["node_modules/typescript/bin/tsc"]).output().unwrap());
        });
    }
    ready
}

fn token(state: &Path, args: &[&str]) -> String {
    let all = [&["token", "--state-dir", state.to_str().unwrap(), "create"], args].concat();
    well(run_to_end(&all, &[])).trim().to_owned()
}

#[test]
fn the_typescript_client_sees_what_is_sent() {
    let Some(film) = film() else { return };
    if !built() {
        return;
    }
    let state = tempfile::tempdir().unwrap();
    let viewer = token(state.path(), &["wall"]);
    let operator = token(state.path(), &["desk", "--role", "operator"]);
    let service = Service::start(state.path(), &["--camera", &format!("demo={}", film.display()), "--loop"]);
    let url = format!("http://{}", service.address);
    let door = json!({"id": "door", "points": [[0.5, 1.0], [0.5, 0.0]]}).to_string();
    let drawn = service.request_as(&operator, "POST", "/v1/cameras/demo/lines", Some(&door));
    assert_eq!(drawn.status, 201, "{drawn:?}");
    let mut socket = service.socket_as(&viewer, "/v1/tracks?camera=demo&state=confirmed");
    let example = |token: &str, camera: &str| {
        let args = ["dist/example.js", &url, "--token", token, "--camera", camera, "--crossings", "1"];
        node(&args).output().unwrap()
    };
    let said = well(example(&viewer, "demo"));

    // A line for each track of each report, in between and at the end other lines.
    let mut tracks = BTreeMap::new();
    let mut others: Vec<Vec<&str>> = vec![];
    for line in said.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        if words[0] == "demo" {
            let name: [u64; 3] = [1, 2, 3].map(|at| words[at].parse().unwrap());
            let place: [f64; 4] = [4, 5, 6, 7].map(|at| words[at].parse().unwrap());
            assert!(tracks.insert(name, place).is_none(), "{line} twice");
        } else {
            others.push(words);
        }
    }
    // Just what the service sent as JSON meanwhile.
    let ends = tracks.first_key_value().zip(tracks.last_key_value());
    let ([_, first, _], [_, last, _]) = ends.map(|((a, _), (b, _))| (*a, *b)).expect("nobody in the film");
    let mut sent = BTreeSet::new();
    loop {
        let report = socket.json();
        let number = |of: &Value| of.as_u64().unwrap_or_else(|| panic!("{report}"));
        let seq = number(&report["seq"]);
        for track in report["tracks"].as_array().unwrap().iter().filter(|_| (first..=last).contains(&seq)) {
            let name = [number(&report["epoch"]), seq, number(&track["id"])];
            let place = tracks.get(&name).unwrap_or_else(|| panic!("{name:?} is missing"));
            let there: [f64; 4] = serde_json::from_value(track["box"].clone()).unwrap();
            assert!(place.iter().zip(there).all(|(a, b)| (a - b).abs() < 0.1), "{place:?} {track}");
            sent.insert(name);
        }
        if seq >= last {
            break;
        }
    }
    assert!(sent.iter().eq(tracks.keys()), "printed, but never sent");

    // What crossed, and how many did by then.
    let [crossing, count] = &others[..] else { panic!("{others:?}") };
    let ask = |path: &str| service.request_as(&viewer, "GET", path, None).json();
    let events = ask("/v1/events?camera=demo&type=line.crossed&limit=1000");
    let event = events["events"].as_array().unwrap().iter().find(|event| event["id"] == crossing[1]);
    let event = event.unwrap_or_else(|| panic!("{crossing:?} never happened: {events}"));
    let track = event["track"].to_string();
    let way = event["direction"].as_str().unwrap();
    assert_eq!(crossing[2..], ["demo", &track, "door", way]);
    assert_eq!(count[..3], ["count", "demo", "door"]);
    let now = ask("/v1/cameras/demo/counts")["lines"]["door"].clone();
    for (name, counted) in [("in", count[3]), ("out", count[4])] {
        let range = u64::from(name == way)..=now[name].as_u64().unwrap();
        assert!(range.contains(&counted.parse::<u64>().unwrap()), "{name}: {counted}, now {now}");
    }

    // What trying again would not mend is told.
    for (token, camera, why) in [
        ("gakp_wrong", "demo", "refused: the token is not known; it may have been revoked"),
        (viewer.as_str(), "nobody", "refused: there is no camera \"nobody\""),
    ] {
        let refused = example(token, camera);
        let told = String::from_utf8(refused.stderr).unwrap();
        assert!(refused.status.code() == Some(1) && told.starts_with(why), "{told}");
    }
    let script = "
        import { answer, Client, Refused } from 'gakp-client';
        const [url, token] = process.argv.slice(1);
        const path = { id: 'demo', line: 'door' };
        const request = new Client(url, { token }).rest.DELETE('/v1/cameras/{id}/lines/{line}', { params: { path } });
        const error = await answer(request).catch((error) => error);
        console.log(error instanceof Refused, error?.status, error?.type, error?.title);
        console.log(error?.detail);";
    let run = |token: &str| {
        well(node(&["--input-type=module", "--eval", script, "--", &url, token]).output().unwrap())
    };
    let told = run(&viewer);
    let wanted = "true 403 urn:gakp:problem:forbidden Not allowed\ntoken \"wall\" is a viewer's;";
    assert!(told.starts_with(wanted), "{told}");
    assert!(run(&operator).starts_with("false undefined"), "an operator may");
    assert_eq!(ask("/v1/cameras/demo/lines"), json!({"lines": []}));
    service.stop();
}

/// Sends an event and goes away; then sends large ones without end. Tells how many were taken when no more are.
fn flood(listener: &TcpListener, stalled: &mpsc::Sender<usize>) {
    const MOST: usize = 2000;
    let accept = || -> WebSocket<TcpStream> {
        let (stream, _) = listener.accept().unwrap();
        stream.set_write_timeout(Some(Duration::from_secs(2))).unwrap();
        tungstenite::accept(stream).unwrap()
    };
    let event = |id: String| Message::text(json!({"id": id, "pad": "x".repeat(64 * 1024)}).to_string());
    let mut socket = accept();
    socket.send(event("1-0".into())).unwrap();
    let away = CloseFrame { code: CloseCode::Away, reason: "restart".into() };
    socket.close(Some(away)).unwrap();
    while socket.read().is_ok() {}
    drop(socket);

    let full = |error: &tungstenite::Error| match error {
        tungstenite::Error::Io(error) => {
            matches!(error.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut)
        }
        _ => false,
    };
    let mut socket = accept();
    let mut told = false;
    for n in 0..MOST {
        let mut sent = socket.send(event(format!("2-{n}")));
        while let Err(error) = sent {
            if !full(&error) {
                return;
            }
            if !told {
                let _ = stalled.send(n);
                told = true;
            }
            sent = socket.flush();
        }
    }
    let _ = stalled.send(MOST);
}

#[test]
fn a_slow_typescript_program_keeps_little_and_comes_back() {
    if !built() {
        return;
    }
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let (tell, stalled) = mpsc::channel();
    let server = std::thread::spawn(move || flood(&listener, &tell));
    let script = "
        import { Client } from 'gakp-client';
        const interrupted = (why) => console.log(why.message);
        for await (const { id } of new Client(process.argv[1], { interrupted }).events()) {
          console.log(id);
          if (id === '2-0') await new Promise((told) => process.stdin.once('data', told));
          if (id === '2-300') break;
        }";
    let mut program = node(&["--input-type=module", "--eval", script, "--", &url]);
    program.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut program = program.spawn().unwrap();
    let taken = stalled.recv_timeout(PATIENCE);
    program.stdin.take().unwrap().write_all(b"go on\n").unwrap();
    let said = well(program.wait_with_output().unwrap());
    server.join().unwrap();
    // Kernels keep some megabytes.
    let taken = taken.expect("neither stalled nor at the end");
    assert!(taken < 400, "{taken} events of 64 KiB were taken by who asked for one");
    let mut wanted = vec!["1-0".to_owned(), "the connection was closed: 1001 restart".to_owned()];
    wanted.extend((0..=300).map(|n| format!("2-{n}")));
    assert!(said.lines().eq(wanted), "{said}");
}

#[test]
fn the_typescript_client_is_that_of_the_schema() {
    let Some(python) = python() else { return };
    if !ready() {
        return;
    }
    let made = tempfile::tempdir().unwrap();
    let out = made.path().to_str().unwrap();
    let rest = made.path().join("rest.ts");
    let args = ["node_modules/openapi-typescript/bin/cli.js", "../../src/api/openapi.json", "--output"];
    well(node(&args).arg(&rest).output().unwrap());
    let messages =
        ["-m", "grpc_tools.protoc", "-I", "../../proto", "../../proto/tracks.proto", "--es_opt=target=ts"];
    let plugin = "--plugin=protoc-gen-es=node_modules/.bin/protoc-gen-es";
    let mut protoc = Command::new(python);
    protoc.current_dir(folder()).args(messages).args([plugin, &format!("--es_out={out}")]);
    well(protoc.output().unwrap());
    for name in ["rest.ts", "tracks_pb.ts"] {
        let kept = std::fs::read(folder().join("src/generated").join(name)).unwrap();
        let made = std::fs::read(made.path().join(name)).unwrap();
        assert!(kept == made, "{name} is out of date: run `npm run generate` in clients/typescript");
    }
}
