//! SIGTERM: everything ends in order and in time, whatever the cameras do.

use std::io::Write;
use std::net::TcpStream;
use std::time::Instant;

use super::support::*;

#[test]
fn sigterm_drains_and_ends_with_0_whatever_the_cameras_do() {
    let Some(clip) = clip() else { return };
    let (live, frozen) = (CameraProcess::start(&clip, &[]), CameraProcess::start(&clip, &[]));
    let state = tempfile::tempdir().unwrap();
    let refusing = Refusing::start();
    let cameras = [
        format!("live={}", live.url),
        format!("frozen={}", frozen.url),
        format!("refusing=rtsp://{}/live", refusing.address()),
        format!("mute=rtsp://{}/live", strange_server(b"")),
        "generated=test:?fps=5".to_owned(),
    ];
    let mut args = vec!["--threads", "2"];
    cameras.iter().for_each(|camera| args.extend(["--camera", camera]));
    let mut service = Service::start(state.path(), &args);
    for name in ["live", "frozen", "generated"] {
        service.wait_for_frames(name, 1);
    }
    service.wait_for_state("refusing", "retrying");
    frozen.process.signal("STOP");
    let mut client = service.socket("/v1/tracks");
    client.json();
    let mut silent = service.socket("/v1/tracks?camera=refusing");

    let since = Instant::now();
    service.process.signal("TERM");
    assert_eq!(client.closed(), 1001);
    assert_eq!(silent.closed(), 1001);
    let status = service.process.wait();
    let took = since.elapsed();
    let log = service.process.log();
    assert_eq!(status.code(), Some(0), "{log}");
    eprintln!("ended after {took:?}");
    // The bound is 5 s; the rest is for a machine that is busy with other tests.
    assert!(took.as_secs() < 10, "{took:?}: {log}");
    assert!(log.contains("draining"), "{log}");
    assert!(!log.contains("took too long") && !log.contains("panicked"), "{log}");
}

#[test]
fn a_second_sigterm_ends_at_once() {
    if models().is_none() {
        return;
    }
    let state = tempfile::tempdir().unwrap();
    let mut service = Service::start(state.path(), &["--camera", "generated=test:?fps=5"]);
    // A request that never arrives in full is what draining waits for.
    let mut request = TcpStream::connect(service.address).unwrap();
    let head = "POST /v1/cameras HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{";
    request.write_all(head.as_bytes()).unwrap();
    service.wait_for_frames("generated", 1);

    service.process.signal("TERM");
    eventually("the drain to begin", || service.process.log().contains("draining").then_some(()));
    service.process.signal("TERM");
    let status = service.process.wait();
    let log = service.process.log();
    assert_eq!(status.code(), Some(0), "{log}");
    assert!(log.contains("told twice"), "{log}");
    assert!(!log.contains("cut off"), "it did not wait for the request: {log}");
}

/// Before there is anything to drain a signal ends the service as well.
#[test]
fn sigterm_while_starting_ends_with_0() {
    if models().is_none() {
        return;
    }
    let state = tempfile::tempdir().unwrap();
    let folder = state.path().to_str().unwrap();
    let mut process = Process::start(&["serve", "--listen", "127.0.0.1:0", "--state-dir", folder]);
    eventually("a first line of the log", || (!process.log().is_empty()).then_some(()));
    process.signal("TERM");
    assert_eq!(process.wait().code(), Some(0), "{}", process.log());
}
