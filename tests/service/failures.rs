//! Cameras that refuse, vanish, freeze or send rubbish: told, retried, and no other camera notices.

use std::time::Instant;

use serde_json::Value;

use super::support::*;

/// The camera is being retried, and the API and the metrics say why.
#[track_caller]
fn check_retrying(service: &Service, name: &str, kinds: &[&str]) {
    let status = service.wait_for_state(name, "retrying");
    let kind = status["last_error_kind"].as_str().unwrap();
    assert!(kinds.contains(&kind), "{status}");
    assert!(!status["last_error"].as_str().unwrap().is_empty(), "{status}");
    assert!(status["next_retry_s"].as_f64().is_some_and(|s| (0.0..=3.0).contains(&s)), "{status}");
    let metrics = service.metrics();
    assert_eq!(metrics.of("gakp_camera_up", name), 0.0, "{name}");
    let failures = format!("gakp_camera_failures_total{{camera=\"{name}\",kind=\"{kind}\"}}");
    assert!(metrics.get(&failures) >= 1.0, "{failures}");
}

/// Reads until the camera is told of again; how far it has come.
fn next_report(socket: &mut Socket) -> (u64, u64, u64) {
    let message = socket.json();
    let number = |field: &str| message[field].as_u64().unwrap_or_else(|| panic!("{field} of {message}"));
    (number("epoch"), number("seq"), number("frame"))
}

#[test]
fn a_failing_camera_is_told_and_retried_and_leaves_the_others_alone() {
    let Some(clip) = clip() else { return };
    let steady = CameraProcess::start(&clip, &[]);
    let mut shaky = CameraProcess::start(&clip, &[]);
    let state = tempfile::tempdir().unwrap();
    let refusing = Refusing::start();
    let cameras = [
        format!("steady={}", steady.url),
        format!("shaky={}", shaky.url),
        format!("refusing=rtsp://{}/live", refusing.address()),
        format!("rubbish=rtsp://{}/live", strange_server(b"220 mail.example ESMTP\r\n\r\n")),
        format!("mute=rtsp://{}/live", strange_server(b"")),
        format!("astray={}-not", steady.url),
    ];
    let args: Vec<_> = cameras.iter().flat_map(|camera| ["--camera", camera]).collect();
    let service = Service::start(state.path(), &args);
    for name in ["steady", "shaky"] {
        service.wait_for_state(name, "live");
        service.wait_for_frames(name, 1);
        assert_eq!(service.metrics().of("gakp_camera_up", name), 1.0);
    }
    let before = service.camera("shaky");

    check_retrying(&service, "refusing", &["refused"]);
    check_retrying(&service, "rubbish", &["garbage", "disconnected", "other"]);
    check_retrying(&service, "astray", &["not_found"]);
    check_retrying(&service, "mute", &["silent"]);
    service.wait_for_frames("steady", 3);

    // Vanishes, and comes back where it was.
    let mut socket = service.socket("/v1/tracks?camera=shaky");
    let (epoch, mut seq, mut frame) = next_report(&mut socket);
    assert_eq!(before["epoch"], epoch);
    let mut follow = |socket: &mut Socket, count: usize| {
        for _ in 0..count {
            let (now, next_seq, next_frame) = next_report(socket);
            assert_eq!((now, next_seq), (epoch, seq + 1), "ids and numbers go on over a reconnection");
            assert!(next_frame > frame, "{next_frame} after {frame}");
            (seq, frame) = (next_seq, next_frame);
        }
    };
    follow(&mut socket, 3);
    shaky.kill();
    check_retrying(&service, "shaky", &["disconnected", "refused"]);
    service.wait_for_frames("steady", 3);
    shaky.restart();
    recovered(&service, 1);
    follow(&mut socket, 3);

    // Freezes: the connection stands, nothing comes. Noticed within 5 s, here with room for a busy
    // machine.
    shaky.process.signal("STOP");
    let since = Instant::now();
    check_retrying(&service, "shaky", &["silent"]);
    let took = since.elapsed();
    eprintln!("the frozen camera was noticed after {took:?}");
    assert!(took.as_secs() < 15, "{took:?}");
    service.wait_for_frames("steady", 3);
    shaky.process.signal("CONT");
    recovered(&service, 2);
    follow(&mut socket, 3);

    // What was wrong from the start still is, and nothing of it did harm.
    for name in ["refusing", "rubbish", "astray", "mute"] {
        let status = service.camera(name);
        assert_eq!(
            (&status["frames_in"], &status["reconnects"]),
            (&Value::from(0), &Value::from(0)),
            "{status}"
        );
    }
    let status = service.camera("steady");
    assert_eq!((&status["reconnects"], &status["last_error"]), (&Value::from(0), &Value::Null), "{status}");
    let log = service.stop();
    assert!(!log.contains("panicked"), "{log}");
}

/// The shaky camera is live again, for the `times`th time.
#[track_caller]
fn recovered(service: &Service, times: u64) {
    let status = service.wait_for_state("shaky", "live");
    assert!(status["reconnects"].as_u64().unwrap() >= times, "{status}");
    assert_eq!(status["next_retry_s"], Value::Null, "{status}");
    assert_eq!(service.metrics().of("gakp_camera_up", "shaky"), 1.0);
}
