//! Python's gRPC as the client: another implementation than the service's.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::io::{BufRead, BufReader, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use gakp::publish::wire::{TrackMessage, track_message::Message as Payload};
use prost::Message as _;
use serde_json::Value;

/// Long enough for any step on a busy machine; reaching it is a failure.
const PATIENCE: Duration = Duration::from_secs(60);

/// The tests' own Python; `None`, said loudly, without the set-up. Where the environment has `CI` that is a failure.
pub fn python() -> Option<PathBuf> {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv-tests/bin/python");
    if !python.exists() {
        assert!(std::env::var_os("CI").is_none(), "{} is missing; CI must have it", python.display());
        eprintln!("SKIPPED: {} is missing: run `bash deploy/setup.sh test-packages`", python.display());
        return None;
    }
    Some(python)
}

/// Runs Python to its end.
pub fn run(python: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(python);
    command.current_dir(env!("CARGO_MANIFEST_DIR")).env("PYTHONDONTWRITEBYTECODE", "1").env("NO_PROXY", "*");
    command.args(args).output().unwrap()
}

/// What Python makes of `proto/`.
pub struct Stubs {
    python: PathBuf,
    folder: tempfile::TempDir,
}

impl Stubs {
    /// `None` as for [`python`].
    pub fn make() -> Option<Self> {
        let (python, folder) = (python()?, tempfile::tempdir().unwrap());
        let out = folder.path().to_str().unwrap();
        let (messages, calls) = (format!("--python_out={out}"), format!("--grpc_python_out={out}"));
        let files = ["proto/tracks.proto", "proto/service.proto"];
        let made = run(
            &python,
            &[&["-m", "grpc_tools.protoc", "-I", "proto", &messages, &calls], &files[..]].concat(),
        );
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        Some(Self { python, folder })
    }

    /// Makes calls, as client.py says.
    pub fn call(&self, address: SocketAddr, calls: &Value) -> Calls {
        let mut child = Command::new(&self.python)
            .arg("tests/grpc/client.py")
            .arg(self.folder.path())
            .args([address.to_string(), calls.to_string()])
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (said, input) = (child.stdout.take().unwrap(), child.stdin.take());
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            BufReader::new(said).lines().map_while(Result::ok).all(|line| sender.send(line).is_ok())
        });
        Calls { child, input, lines }
    }
}

/// The client at work; killed when dropped.
pub struct Calls {
    child: Child,
    input: Option<ChildStdin>,
    lines: Receiver<String>,
}

impl Calls {
    #[track_caller]
    fn line(&self) -> String {
        self.lines.recv_timeout(PATIENCE).expect("the client says something")
    }

    /// The next message.
    #[track_caller]
    pub fn message(&self) -> TrackMessage {
        let line = self.line();
        let byte = |at: usize| u8::from_str_radix(&line[at..at + 2], 16);
        let bytes: Result<Vec<u8>, _> = (0..line.len() / 2).map(|n| byte(2 * n)).collect();
        let bytes = bytes.unwrap_or_else(|_| panic!("no message: {line}"));
        TrackMessage::decode(&bytes[..]).unwrap()
    }

    /// The next message, which has camera, and first and last number, of what it tells or announces as lost.
    #[track_caller]
    pub fn told(&self) -> (String, u64, u64, bool) {
        match self.message().message.unwrap() {
            Payload::Frame(frame) => (frame.camera, frame.seq, frame.seq, false),
            Payload::Gap(gap) => (gap.camera, gap.first, gap.last, true),
        }
    }

    /// The call's end, which comes next: code and details.
    #[track_caller]
    pub fn status(&self) -> String {
        let line = self.line();
        line.strip_prefix("status ").unwrap_or_else(|| panic!("no status: {line}")).to_owned()
    }

    /// It has stopped reading.
    #[track_caller]
    pub fn paused(&self) {
        assert_eq!(self.line(), "paused");
    }

    /// Its call has ended, though it does not read.
    #[track_caller]
    pub fn over(&self) {
        assert_eq!(self.line(), "over");
    }

    /// It reads on.
    pub fn resume(&mut self) {
        self.input.as_mut().unwrap().write_all(b"\n").unwrap();
    }

    /// The status after whatever messages.
    #[track_caller]
    pub fn end(&self) -> String {
        loop {
            if let Some(status) = self.line().strip_prefix("status ") {
                return status.to_owned();
            }
        }
    }
}

impl Drop for Calls {
    fn drop(&mut self) {
        // Gone already, perhaps.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
