//! `gakp check`: one report, whatever is wrong.

use serde_json::Value;

use super::support::*;

/// The verdicts of a report by part, and how the command ended.
fn report(args: &[&str]) -> (Vec<(String, String, String)>, i32) {
    let output = run_to_end(&[&["check", "--json"], args].concat(), &[]);
    let text = String::from_utf8(output.stdout).unwrap();
    let line = |line: &str| -> (String, String, String) {
        let line: Value = serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
        let field = |name: &str| line[name].as_str().unwrap().to_owned();
        (field("part"), field("verdict"), field("text"))
    };
    (text.lines().map(line).collect(), output.status.code().unwrap())
}

#[test]
fn every_part_is_tried_and_reported() {
    let Some(film) = film() else { return };
    let folder = tempfile::tempdir().unwrap();
    let camera = CameraProcess::start(&film, &["--user", "guard", "--password", "g00d-Wort"]);
    let host = camera.url.trim_start_matches("rtsp://").rsplit('@').next().unwrap().to_owned();
    let refusing = Refusing::start();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let (listen, state) = (taken.local_addr().unwrap().to_string(), folder.path().join("state"));
    std::fs::create_dir(&state).unwrap();
    let cameras = [
        format!("right=rtsp://guard:g00d-Wort@{host}"),
        format!("wrong=rtsp://guard:b4d-Wort@{host}"),
        format!("off=rtsp://{}/live", refusing.address()),
        format!("film={}", film.display()),
    ];
    let receiver = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let (there, off) = (receiver.local_addr().unwrap(), refusing.address());
    let config = folder.path().join("gakp.toml");
    let told = format!(
        "[[webhook]]\nname = \"there\"\nurl = \"http://{there}/b4d-Wort\"\n\
         [[webhook]]\nname = \"off\"\nurl = \"http://{off}/b4d-Wort\"\n\
         [mqtt]\nurl = \"mqtt://guard:b4d-Wort@{off}\"\n[traces]\nendpoint = \"http://{there}\"\n"
    );
    std::fs::write(&config, told).unwrap();
    let mut args = vec!["--config", config.to_str().unwrap()];
    args.extend(["--listen", &listen, "--state-dir", state.to_str().unwrap(), "--provider", "cpu"]);
    args.extend(cameras.iter().flat_map(|camera| ["--camera", camera.as_str()]));
    let (parts, code) = report(&args);
    let of = |part: &str| {
        let found = parts.iter().find(|(name, ..)| name == part);
        found
            .map(|(_, verdict, text)| (verdict.as_str(), text.as_str()))
            .unwrap_or_else(|| panic!("{parts:?}"))
    };
    assert_eq!(code, 2, "{parts:?}");
    for (part, verdict, says) in [
        ("configuration", "ok", "4 cameras"),
        ("state folder", "ok", "0 cameras remembered"),
        ("address", "failed", "another"),
        ("models", "ok", "detect"),
        ("GPU", "ok", "cpu"),
        ("history", "note", "will be made"),
        ("webhook there", "ok", "is there"),
        ("webhook off", "failed", "refused"),
        ("MQTT", "failed", "refused"),
        ("traces", "ok", "is there"),
        ("camera right", "ok", "768x576 h264"),
        ("camera wrong", "failed", "check user and password"),
        ("camera off", "failed", "refused"),
        ("camera film", "ok", "768x576"),
    ] {
        let (found, text) = of(part);
        assert!(found == verdict && text.contains(says), "{part}: {found} {text}, not {verdict} {says}");
    }
    assert!(!format!("{parts:?}").contains("Wort"), "a password in {parts:?}");
    assert_eq!(std::fs::read_dir(&state).unwrap().count(), 0, "it leaves no trace");

    // All is well.
    drop(taken);
    let (parts, code) =
        report(&["--listen", &listen, "--state-dir", state.to_str().unwrap(), "--camera", &cameras[0]]);
    assert_eq!(code, 0, "{parts:?}");
    // Nothing can be tried.
    let (parts, code) = report(&["--camera", "x=ftp://nowhere"]);
    assert!(code == 2 && parts.len() == 1 && parts[0].1 == "failed", "{parts:?}");
}
