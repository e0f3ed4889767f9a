//! A mistake gives one clear message and exit code 2, and nothing is half-started.

use std::fs;
use std::io::ErrorKind;
use std::net::TcpListener;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Output;

use super::support::*;

/// Exit code 2, nothing on standard output, one message that names `expected`; it is returned.
#[track_caller]
fn refused(args: &[&str], env: &[(&str, &str)], expected: &[&str]) -> String {
    let Output { status, stdout, stderr } = run_to_end(args, env);
    let text = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(2), "{args:?} ended with {status}: {text}");
    assert!(stdout.is_empty(), "{args:?} printed {:?}", String::from_utf8_lossy(&stdout));
    // Clap says `error:` and how it is used, everything else is one line.
    let messages: Vec<_> =
        text.lines().filter(|line| line.starts_with("gakp: ") || line.starts_with("error: ")).collect();
    let [message] = messages[..] else { panic!("{args:?}: not one message: {text}") };
    if message.starts_with("gakp: ") {
        assert_eq!(text.lines().last(), Some(message), "{args:?}: more lines than one: {text}");
    }
    for part in expected {
        assert!(message.contains(part), "{args:?}: no {part:?} in {message:?}");
    }
    for level in [" WARN ", " ERROR ", "panicked"] {
        assert!(!text.contains(level), "{args:?}: more than one complaint: {text}");
    }
    text
}

/// What a service that must not start would have touched.
struct Untouched {
    camera: TcpListener,
    folder: tempfile::TempDir,
}

impl Untouched {
    fn new() -> Self {
        let camera = TcpListener::bind("127.0.0.1:0").unwrap();
        camera.set_nonblocking(true).unwrap();
        Self { camera, folder: tempfile::tempdir().unwrap() }
    }

    fn file(&self, name: &str, text: &str) -> String {
        let path = self.folder.path().join(name);
        fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    }

    /// `gakp serve` with a good camera and whatever else is wrong is refused; the camera was not
    /// opened, no port was announced, no state was written.
    #[track_caller]
    fn check(&self, args: &[&str], env: &[(&str, &str)], expected: &[&str]) -> String {
        let state = self.folder.path().join("state");
        let good = format!("good=rtsp://user:hunter2@{}/live", self.camera.local_addr().unwrap());
        let mut all = vec!["serve", "--camera", &good, "--state-dir", state.to_str().unwrap()];
        if !args.contains(&"--listen") {
            all.extend(["--listen", "127.0.0.1:0"]);
        }
        all.extend(args);
        let text = refused(&all, env, expected);
        assert!(!text.contains("the page is at"), "{args:?}: {text}");
        assert!(!text.contains("hunter2"), "{args:?}: a password in {text}");
        assert!(!state.exists(), "{args:?}: state was written");
        let called = self.camera.accept().map(|_| ()).map_err(|e| e.kind());
        assert_eq!(called, Err(ErrorKind::WouldBlock), "{args:?}: the camera was opened");
        text
    }
}

#[test]
fn wrong_settings_are_told_before_anything_starts() {
    let service = Untouched::new();
    let config = |text: &str| service.file("gakp.toml", text);
    let missing = service.folder.path().join("missing.mp4");
    let missing = format!("a={}", missing.display());
    let short = service.file("short", "not a secret");
    for (args, expected) in [
        (vec!["--camera", "a=ftp://u:hunter2@host/x"], vec!["camera \"a\"", "no scheme `ftp`", "rtsp://"]),
        (vec!["--camera", "a=rtsp:/u:hunter2@host"], vec!["camera \"a\"", "`rtsp://...`"]),
        (vec!["--camera", "rtsp://u:hunter2@host/x"], vec!["--camera", "NAME=URL"]),
        (vec!["--camera", "rtsp://u:hunter2@host/x?a=1"], vec!["--camera", "NAME=URL"]),
        (vec!["--camera", "a b=rtsp://u:hunter2@host/x"], vec!["--camera", "\"a b\"", "letter or digit"]),
        (vec!["--camera", "good=rtsp://u:hunter2@host/x"], vec!["two cameras are named \"good\""]),
        (vec!["--camera", &missing], vec!["camera \"a\"", "missing.mp4"]),
        (vec!["--max-cameras", "0"], vec!["max_cameras is 0"]),
        (vec!["--threads", "0"], vec!["models.threads: 0 is none", "at least 1"]),
        (vec!["--provider", "gpu"], vec!["provider", "\"gpu\"", "auto, cpu, cuda, tensorrt"]),
        (vec!["--listen", "localhost"], vec!["--listen", "localhost"]),
        (
            vec!["--listen", "0.0.0.0:0"],
            vec!["0.0.0.0:0", "no token yet", "gakp token create NAME --role admin"],
        ),
        (vec!["--listen", "[::]:0"], vec!["no token yet"]),
        (vec!["--tls-cert", &missing], vec!["--tls-key"]),
        (
            vec!["--tls-cert", &missing, "--tls-key", &missing],
            vec!["cannot read a certificate", "missing.mp4"],
        ),
        (vec!["--admin-token-file", &missing], vec!["the admin's token", "missing.mp4"]),
        (vec!["--admin-token-file", &short], vec!["32 or more visible ASCII characters"]),
        (vec!["--no-such-flag"], vec!["--no-such-flag"]),
        (vec!["--config", "nowhere.toml"], vec!["configuration nowhere.toml", "No such file"]),
        (vec!["--log", "loud"], vec!["--log", "log level \"loud\"", "error, warn, info, debug, trace"]),
        (
            vec!["--log", "info,gakp=loud"],
            vec!["--log", "log level \"info,gakp=loud\"", "error, warn, info, debug or trace"],
        ),
    ] {
        service.check(&args, &[], &expected);
    }
    for (text, expected) in [
        ("liste = \"127.0.0.1:1\"", vec!["gakp.toml", "line 1", "unknown field `liste`"]),
        ("[models]\nthread = 2", vec!["gakp.toml", "line 2", "unknown field `thread`"]),
        (
            "[[camera]]\nid = \"a\"\nurl = \"rtsp://u:hunter2@h/s\"\ntransprot = \"tcp\"",
            vec!["gakp.toml", "line 4", "transprot"],
        ),
        ("[[camera]]\nid = \"good\"\nurl = \"rtsp://u:hunter2@h/s\"", vec!["two cameras are named \"good\""]),
        ("[tracker]\nhigh_score = 7", vec!["gakp.toml", "tracker.high_score = 7"]),
        ("max_cameras = \"many\"", vec!["gakp.toml", "line 1", "\"many\""]),
        ("this is no TOML", vec!["gakp.toml", "line 1"]),
        ("[[webhook]]\nurl = \"ftp://u:hunter2@h/\"", vec!["webhook \"webhook-1\"", "http:// or https://"]),
        (
            "[mqtt]\nurl = \"mqtt://h\"\nuser = \"u\"\npassword_file = \"none\"",
            vec!["mqtt: cannot read password_file", "none"],
        ),
    ] {
        service.check(&["--config", &config(text)], &[], &expected);
    }
}

/// A folder that is a copy of the repository's models, down to links to its files.
fn copy_of_models(models: &Path, copy: &Path) {
    fs::create_dir_all(copy.join("cache")).unwrap();
    for folder in ["", "cache"] {
        for entry in fs::read_dir(models.join(folder)).unwrap().map(Result::unwrap) {
            if entry.path().is_file() {
                symlink(entry.path().canonicalize().unwrap(), copy.join(folder).join(entry.file_name()))
                    .unwrap();
            }
        }
    }
}

/// In `copy`, the detector that `auto` takes on a CPU.
fn detector(copy: &Path) -> PathBuf {
    copy.join("cache/nanodet-g-int8.onnx")
}

#[test]
fn wrong_models_are_told_before_anything_starts() {
    let Some(models) = models() else { return };
    let service = Untouched::new();
    let with = |name: &str, spoil: &dyn Fn(&Path)| {
        let copy = service.folder.path().join(name);
        copy_of_models(&models, &copy);
        spoil(&copy);
        copy.to_str().unwrap().to_owned()
    };
    let gone = with("gone", &|copy| fs::remove_file(detector(copy)).unwrap());
    let flipped = with("flipped", &|copy| {
        let mut bytes = fs::read(detector(copy)).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::remove_file(detector(copy)).unwrap();
        fs::write(detector(copy), bytes).unwrap();
    });
    let no_link = with("no-link", &|copy| fs::remove_file(copy.join("gakp-gru.onnx")).unwrap());
    let no_library =
        with("no-library", &|copy| fs::remove_file(copy.join("cache/libonnxruntime.so")).unwrap());
    let no_manifest = service.folder.path().to_str().unwrap().to_owned();
    let text = service.file("library.so", "this is no library");
    for (args, expected) in [
        (vec!["--models", &gone], vec!["nanodet-g-int8", "is missing", "deploy/setup.sh models"]),
        (vec!["--models", &flipped], vec!["nanodet-g-int8", "sha256", "is expected"]),
        (vec!["--models", &no_link], vec!["gakp-gru", "is missing"]),
        (vec!["--models", &no_manifest], vec!["manifest.toml", "No such file"]),
        (vec!["--models", &no_library], vec!["ONNX Runtime cannot be loaded", "no-library/cache"]),
        (
            vec!["--onnxruntime", "/nowhere/libonnxruntime.so"],
            vec!["ONNX Runtime", "/nowhere/libonnxruntime.so"],
        ),
        (vec!["--onnxruntime", &text], vec!["ONNX Runtime cannot be loaded", "library.so"]),
        (vec!["--detector", "yolo-99"], vec!["no detect model named \"yolo-99\"", "nanodet-g-int8"]),
        (vec!["--link", "none"], vec!["link"]),
        (vec!["--classes", "unicorn"], vec!["unicorn"]),
        (vec!["--detector-size", "100x100"], vec!["100"]),
        (vec!["--detector-size", "big"], vec!["--detector-size", "WIDTHxHEIGHT"]),
        (vec!["--score-threshold", "7"], vec!["7"]),
    ] {
        service.check(&args, &[], &expected);
    }
    // The library that the set-up installs knows the CPU only; no machine's GPU makes it another.
    service.check(&["--provider", "cuda"], &[], &["provider cuda was asked for", "use `auto` or `cpu`"]);
    service.check(&[], &[("ORT_DYLIB_PATH", "/nowhere/ort.so")], &["ONNX Runtime", "/nowhere/ort.so"]);
}

#[test]
fn a_taken_port_and_a_bad_state_folder_are_told() {
    if models().is_none() {
        return;
    }
    let service = Untouched::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    service.check(&["--listen", &address], &[], &["cannot listen on", &address, "--listen"]);

    let file = service.file("file", "");
    let below = format!("{file}/state");
    let damaged = service.folder.path().join("damaged");
    fs::create_dir(&damaged).unwrap();
    fs::write(damaged.join("cameras.json"), "{\"epoch\": 1, \"cam").unwrap();
    for (state, expected) in [
        (below.as_str(), vec!["cannot", "file/state", "--state-dir"]),
        (damaged.to_str().unwrap(), vec!["cameras.json is damaged", "mend it or move it away"]),
    ] {
        refused(&["serve", "--listen", "127.0.0.1:0", "--state-dir", state], &[], &expected);
    }
    let kept = fs::read_to_string(damaged.join("cameras.json")).unwrap();
    assert!(kept.ends_with("\"cam"), "a damaged file is not overwritten");
}

#[test]
fn wrong_inputs_of_the_offline_commands_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let sequence = |name: &str, ini: &str, det: &str| {
        fs::create_dir_all(folder.path().join(name).join("det")).unwrap();
        fs::write(folder.path().join(name).join("seqinfo.ini"), ini).unwrap();
        fs::write(folder.path().join(name).join("det/det.txt"), det).unwrap();
        path(name)
    };
    let ini =
        "[Sequence]\nname=S\nimDir=img1\nframeRate=25\nseqLength=10\nimWidth=640\nimHeight=480\nimExt=.jpg\n";
    let good = sequence("good", ini, "1,-1,10,10,20,40,0.9,-1,-1,-1\n");
    let bad_row = sequence("bad-row", ini, "1,-1,10,10,20,40,0.9,-1,-1,-1\n2,-1,ten,10,20,40,0.9,-1,-1,-1\n");
    let too_late = sequence("too-late", ini, "11,-1,10,10,20,40,0.9,-1,-1,-1\n");
    let bad_ini = sequence("bad-ini", "[Sequence]\nname=S\n", "");
    fs::create_dir(folder.path().join("empty")).unwrap();
    let (empty, missing) = (path("empty"), path("missing.mp4"));
    fs::write(path("text.mp4"), "this is no video").unwrap();
    fs::write(path("rows.txt"), "rows of an earlier run").unwrap();
    let (out, text) = (path("rows.txt"), path("text.mp4"));
    let nowhere = path("nowhere/rows.txt");

    for (args, expected) in [
        (vec!["track", &bad_row, "--out", &out], vec!["bad-row/det/det.txt", "line 2", "\"ten\""]),
        (vec!["track", &too_late, "--out", &out], vec!["too-late/det/det.txt", "line 1", "11"]),
        (vec!["track", &bad_ini, "--out", &out], vec!["bad-ini/seqinfo.ini"]),
        (vec!["track", &empty, "--out", &out], vec!["empty is no MOTChallenge sequence", "seqinfo.ini"]),
        (vec!["track", &good, &bad_row, "--out", &path("many")], vec!["bad-row/det/det.txt", "line 2"]),
        (vec!["track", &missing, "--out", &out], vec!["missing.mp4", "No such file"]),
        (vec!["track", "gopher://host/x", "--out", &out], vec!["no scheme `gopher`"]),
        (vec!["track", &good, &text, "--out", &out], vec!["mixed"]),
        (vec!["track", &text, &text, "--out", &out], vec!["several inputs"]),
        (vec!["track", &good, "--out", &out, "--video", &path("x.mp4")], vec!["--video needs a video"]),
        (vec!["track", &text, "--out", &out, "--second-half"], vec!["--second-half"]),
        (vec!["track", &good, "--out", &nowhere], vec!["nowhere"]),
        (vec!["track", &good, "--out", &empty], vec!["empty", "folder"]),
        (vec!["track", "--out", &out], vec!["required arguments"]),
        (vec!["eval", "--gt", &empty, "--results", &empty], vec!["no sequence in", "empty"]),
        (vec!["eval", "--gt", &path("no"), "--results", &empty], vec!["cannot read folder"]),
        (vec!["camera", &missing, "--listen", "127.0.0.1:0"], vec!["missing.mp4", "No such file"]),
        (vec!["camera", &text, "--listen", "127.0.0.1:0"], vec!["text.mp4"]),
        (vec!["camera", &text, "--user", "me"], vec!["required arguments"]),
        (vec!["fly"], vec!["fly"]),
    ] {
        refused(&args, &[], &expected);
    }
    if models().is_some() {
        // What the source finds out when it opens the file is in the log as well.
        let ended = run_to_end(&["track", &text, "--out", &out], &[]);
        let told = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(2), "{told}");
        assert!(
            told.lines().last().unwrap().ends_with("text.mp4: unsupported: this is not a video"),
            "{told}"
        );
        refused(&["track", &good, "--out", &out, "--link", "nobody"], &[], &["\"nobody\""]);
    }
    assert_eq!(fs::read_to_string(&out).unwrap(), "rows of an earlier run", "a mistake costs nothing");
    assert!(!Path::new(&path("many")).join("good.txt").exists(), "all inputs are read before any is written");
    assert!(!Path::new(&path("x.mp4")).exists());
}

#[test]
fn a_test_camera_names_a_taken_port() {
    let Some(clip) = clip() else { return };
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    refused(&["camera", clip.to_str().unwrap(), "--listen", &address], &[], &["cannot listen on", &address]);
}
