//! The real binary as a child process, real RTSP cameras.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::{Arc, Mutex, OnceLock, mpsc};
use std::time::{Duration, Instant};

use gakp::ingest::{Pacing, Pixels, SourceEvent, SourceSpec, VideoWriter};
use gakp::types::{CameraId, YuvMatrix, YuvRange};
use serde_json::Value;
use socket2::{Domain, Socket as RawSocket, Type};

#[path = "client.rs"]
mod client;

pub use client::{Metrics, Socket};

/// Long enough for any step on a busy machine; reaching it is a failure.
pub const PATIENCE: Duration = Duration::from_secs(60);

const GAKP: &str = env!("CARGO_BIN_EXE_gakp");

/// The repository's models; `None`, said loudly, without the set-up. Where the environment has `CI`
/// that is a failure.
pub fn models() -> Option<PathBuf> {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    needed(models.join("cache/libonnxruntime.so"), "models").then_some(models)
}

/// The demo film; `None` as for [`models`].
pub fn film() -> Option<PathBuf> {
    let film = models()?.join("cache/vtest.avi");
    needed(&film, "footage").then_some(film)
}

pub fn needed(file: impl AsRef<Path>, part: &str) -> bool {
    let (file, there) = (file.as_ref(), file.as_ref().exists());
    if !there {
        assert!(std::env::var_os("CI").is_none(), "{} is missing; CI must have it", file.display());
        eprintln!("SKIPPED: {} is missing: run `bash deploy/setup.sh {part}`", file.display());
    }
    there
}

/// Frames of [`clip`].
pub const CLIP_FRAMES: usize = 120;

/// The first twelve seconds of the demo film, 768x576 at 10 frames/s, as H.264: what a camera can
/// send as it is. Made once a process.
pub fn clip() -> Option<PathBuf> {
    static CLIP: OnceLock<PathBuf> = OnceLock::new();
    let film = film()?;
    let clip = CLIP.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
        let (part, clip) = (folder.join(format!("{}.mp4", std::process::id())), folder.join("people.mp4"));
        cut(&film, &part, CLIP_FRAMES);
        // Another test binary may have it open: it keeps the file that it opened.
        std::fs::rename(part, &clip).unwrap();
        clip
    });
    Some(clip.clone())
}

/// Writes the first frames of a film to `part`.
fn cut(film: &Path, part: &Path, frames: usize) {
    let mut spec = SourceSpec::parse(film.to_str().unwrap()).unwrap();
    spec.pacing = Pacing::AsFastAsPossible;
    let (done, wait) = mpsc::sync_channel(1);
    let (mut writer, mut left, path) = (None::<VideoWriter>, frames, part.to_owned());
    let source = gakp::ingest::start(&CameraId::new("film").unwrap(), spec, move |event| {
        let SourceEvent::Frame(frame) = event else { return ControlFlow::Continue(()) };
        let image = frame.image;
        let made = writer.get_or_insert_with(|| {
            let pixels = Pixels::I420(image.range, image.matrix);
            VideoWriter::create(&path, (image.width, image.height), 10.0, pixels).unwrap()
        });
        made.write(&image, frame.time).unwrap();
        left -= 1;
        if left > 0 {
            return ControlFlow::Continue(());
        }
        done.send(writer.take()).unwrap();
        ControlFlow::Break(())
    });
    wait.recv_timeout(PATIENCE).expect("the clip").unwrap().finish().unwrap();
    source.unwrap().stop();
}

/// The video of a sequence and the folder of its truth; says so where they are missing.
pub fn footage(sequence: &str) -> Option<(PathBuf, PathBuf)> {
    let shared = std::env::var_os("GAKP_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let video = shared.join(format!("data/video/{sequence}.mp4"));
    let truth = shared.join(format!("data/MOT15/train/{sequence}"));
    if video.is_file() && truth.is_dir() {
        return Some((video, truth));
    }
    eprintln!("SKIPPED: no {}: set GAKP_SHARED to the folder that holds the data", video.display());
    None
}

/// Waits until `so` gives something.
#[track_caller]
pub fn eventually<T>(what: &str, mut so: impl FnMut() -> Option<T>) -> T {
    let since = Instant::now();
    loop {
        if let Some(found) = so() {
            return found;
        }
        assert!(since.elapsed() < PATIENCE, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Runs `gakp`, which must end by itself in time.
pub fn run_to_end(args: &[&str], env: &[(&str, &str)]) -> Output {
    // Files take any amount of output without anyone reading.
    let [stdout, stderr] = [(); 2].map(|()| tempfile::NamedTempFile::new().unwrap());
    let mut child = Command::new(GAKP)
        .args(args)
        .env_remove("GAKP_LOG")
        .env_remove("GAKP_MODELS")
        .envs(env.iter().copied())
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .stdin(Stdio::null())
        .stdout(stdout.reopen().unwrap())
        .stderr(stderr.reopen().unwrap())
        .spawn()
        .expect("gakp starts");
    let status = eventually_or(|| child.try_wait().unwrap());
    if status.is_none() {
        child.kill().unwrap();
    }
    let [stdout, stderr] = [stdout, stderr].map(|file| std::fs::read(file.path()).unwrap());
    let log = String::from_utf8_lossy(&stderr);
    let status = status.unwrap_or_else(|| panic!("{args:?} does not end: {log}"));
    Output { status, stdout, stderr }
}

/// A child process that is killed when dropped, and what it writes.
pub struct Process {
    child: Child,
    log: Arc<Mutex<String>>,
}

impl Process {
    /// Starts `gakp`. What it writes to standard error is kept; standard output is the caller's.
    pub fn start(args: &[&str]) -> Self {
        let mut child = Command::new(GAKP)
            .args(args)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .env_remove("GAKP_LOG")
            .env_remove("GAKP_MODELS")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("gakp starts");
        let log = Arc::new(Mutex::new(String::new()));
        let (errors, kept) = (child.stderr.take().unwrap(), log.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(errors).lines().map_while(Result::ok) {
                let mut kept = kept.lock().unwrap();
                kept.push_str(&line);
                kept.push('\n');
            }
        });
        Self { child, log }
    }

    pub fn log(&self) -> String {
        self.log.lock().unwrap().clone()
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal by its name: `TERM`, `STOP`, `CONT`, `KILL`.
    pub fn signal(&self, name: &str) {
        let kill = format!("kill -{name} {}", self.child.id());
        assert!(Command::new("sh").args(["-c", &kill]).status().unwrap().success(), "{kill}");
    }

    /// Waits for its end, which must come.
    #[track_caller]
    pub fn wait(&mut self) -> ExitStatus {
        let log = self.log.clone();
        let child = &mut self.child;
        eventually("the process to end", || {
            child.try_wait().unwrap().or_else(|| {
                assert!(!log.lock().unwrap().contains("panicked"), "{}", log.lock().unwrap());
                None
            })
        })
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Gone already, perhaps.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("--- process {} wrote:\n{}---", self.child.id(), self.log());
        }
    }
}

/// `gakp camera`, a process of its own.
pub struct CameraProcess {
    pub process: Process,
    pub url: String,
    file: PathBuf,
    options: Vec<String>,
}

impl CameraProcess {
    /// Serves `file` on a free port.
    pub fn start(file: &Path, options: &[&str]) -> Self {
        let options = options.iter().map(|o| (*o).to_owned()).collect();
        Self::start_on("127.0.0.1:0", file.to_owned(), options)
    }

    fn start_on(listen: &str, file: PathBuf, options: Vec<String>) -> Self {
        let mut args = vec!["camera", file.to_str().unwrap(), "--listen", listen];
        args.extend(options.iter().map(String::as_str));
        let mut process = Process::start(&args);
        let mut url = String::new();
        let said = process.child.stdout.take().unwrap();
        BufReader::new(said).read_line(&mut url).unwrap();
        assert!(url.starts_with("rtsp://"), "the camera said {url:?} and {}", process.log());
        Self { process, url: url.trim().to_owned(), file, options }
    }

    /// Pulls the plug: every connection is gone and nothing listens any more.
    pub fn kill(&mut self) {
        self.process.signal("KILL");
        self.process.wait();
    }

    /// Plugs it in again, at the same address.
    pub fn restart(&mut self) {
        let address = self.url["rtsp://".len()..].split('/').next().unwrap().to_owned();
        *self = Self::start_on(&address, self.file.clone(), self.options.clone());
    }
}

/// `gakp serve` on a free port.
pub struct Service {
    pub process: Process,
    pub address: SocketAddr,
}

impl Service {
    /// Starts it and waits until it is ready.
    pub fn start(state: &Path, args: &[&str]) -> Self {
        let mut all = vec!["serve", "--listen", "127.0.0.1:0", "--provider", "cpu", "--state-dir"];
        all.push(state.to_str().unwrap());
        all.extend(args);
        let mut process = Process::start(&all);
        let address = eventually("the page's address in the log", || {
            let log = process.log();
            let ended = process.child.try_wait().unwrap();
            assert!(ended.is_none(), "the service ended: {}", process.log());
            let (_, rest) = log.split_once("the page is at http://")?;
            rest.split_once('/')?.0.parse().ok()
        });
        let service = Self { process, address };
        assert_eq!(service.get("/readyz").status, 200);
        service
    }

    /// Starts it with the demo film, over and over, as camera `demo`; `None` as for [`models`].
    pub fn demo(state: &Path) -> Option<Self> {
        let camera = format!("demo={}", film()?.display());
        Some(Self::start(state, &["--camera", &camera, "--loop"]))
    }

    /// Asks it to end and waits until it has; it must end well.
    pub fn stop(mut self) -> String {
        self.process.signal("TERM");
        let status = self.process.wait();
        assert_eq!(status.code(), Some(0), "{}", self.process.log());
        self.process.log()
    }

    pub fn get(&self, path: &str) -> Response {
        self.request("GET", path, None)
    }

    pub fn post(&self, path: &str, body: &Value) -> Response {
        self.request("POST", path, Some(&body.to_string()))
    }

    pub fn delete(&self, path: &str) -> Response {
        self.request("DELETE", path, None)
    }

    pub fn request(&self, method: &str, path: &str, json: Option<&str>) -> Response {
        self.request_with("", method, path, json)
    }

    /// By the bearer of a token.
    pub fn request_as(&self, token: &str, method: &str, path: &str, json: Option<&str>) -> Response {
        self.request_with(&format!("Authorization: Bearer {token}\r\n"), method, path, json)
    }

    /// With more header lines, each with its line break.
    pub fn request_with(&self, headers: &str, method: &str, path: &str, json: Option<&str>) -> Response {
        self.try_request(headers, method, path, json).unwrap()
    }

    /// Of a service that may not be there any more. HTTP/1.0: the answer ends with the connection and has no chunks.
    pub fn try_request(
        &self,
        headers: &str,
        method: &str,
        path: &str,
        json: Option<&str>,
    ) -> std::io::Result<Response> {
        let mut stream = TcpStream::connect(self.address)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        let mut head = format!("{method} {path} HTTP/1.0\r\nHost: {}\r\n{headers}", self.address);
        if let Some(json) = json {
            head += &format!("Content-Type: application/json\r\nContent-Length: {}\r\n", json.len());
        }
        stream.write_all(format!("{head}\r\n{}", json.unwrap_or("")).as_bytes())?;
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes)?;
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n");
        let end = end.ok_or_else(|| std::io::Error::other("no response head"))?;
        let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
        let bytes = bytes.split_off(end + 4);
        let body = String::from_utf8_lossy(&bytes).into_owned();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        Ok(Response { status, head, body, bytes })
    }

    /// What the API says of a camera.
    pub fn camera(&self, name: &str) -> Value {
        self.get(&format!("/v1/cameras/{name}")).json()
    }

    /// Waits until the camera is in a state; what the API then says of it.
    #[track_caller]
    pub fn wait_for_state(&self, name: &str, state: &str) -> Value {
        let mut last = Value::Null;
        let found = eventually_or(|| {
            last = self.camera(name);
            (last["state"] == state).then(|| last.clone())
        });
        found.unwrap_or_else(|| panic!("camera {name} does not become {state}: {last}"))
    }

    /// Waits until the camera has tracked at least `more` frames from now on.
    #[track_caller]
    pub fn wait_for_frames(&self, name: &str, more: u64) {
        let tracked = || self.camera(name)["tracked"].as_u64().unwrap();
        let before = tracked();
        eventually(&format!("{more} frames of {name}"), || (tracked() >= before + more).then_some(()));
    }

    pub fn metrics(&self) -> Metrics {
        let response = self.get("/metrics");
        assert_eq!(response.status, 200);
        Metrics::parse(&response.body)
    }

    pub fn socket(&self, path: &str) -> Socket {
        Socket::open(connect(self.address), self.address, path, None)
    }

    /// By the bearer of a token.
    pub fn socket_as(&self, token: &str, path: &str) -> Socket {
        let bearer = format!("Bearer {token}");
        Socket::open_with(connect(self.address), self.address, path, Some(("authorization", &bearer)))
    }

    pub fn protobuf_socket(&self, path: &str) -> Socket {
        Socket::open(connect(self.address), self.address, path, Some("gakp.v1.protobuf"))
    }

    /// A WebSocket that the kernels of both sides buffer little for: few bytes are announced as
    /// room, and small segments keep the sender's own buffer small.
    pub fn narrow_socket(&self, path: &str) -> Socket {
        let socket = RawSocket::new(Domain::IPV4, Type::STREAM, None).unwrap();
        socket.set_recv_buffer_size(4096).unwrap();
        socket.set_tcp_mss(536).unwrap();
        socket.connect(&self.address.into()).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        Socket::open(socket.into(), self.address, path, None)
    }
}

fn eventually_or<T>(mut so: impl FnMut() -> Option<T>) -> Option<T> {
    let since = Instant::now();
    while since.elapsed() < PATIENCE {
        if let Some(found) = so() {
            return Some(found);
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    None
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

#[derive(Debug)]
pub struct Response {
    pub status: u16,
    pub head: String,
    pub body: String,
    /// The body as it came.
    pub bytes: Vec<u8>,
}

impl Response {
    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|e| panic!("{e}: {self:?}"))
    }
}

/// A port that refuses: it is taken, but nothing listens there.
pub struct Refusing(RawSocket);

impl Refusing {
    pub fn start() -> Self {
        let socket = RawSocket::new(Domain::IPV4, Type::STREAM, None).unwrap();
        socket.bind(&SocketAddr::from(([127, 0, 0, 1], 0)).into()).unwrap();
        Self(socket)
    }

    pub fn address(&self) -> SocketAddr {
        self.0.local_addr().unwrap().as_socket().unwrap()
    }
}

/// Takes connections and answers whatever comes with `answer`, or never when it is empty.
pub fn strange_server(answer: &'static [u8]) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        let mut kept = Vec::new();
        for stream in listener.incoming() {
            let Ok(mut stream) = stream else { return };
            let mut request = [0; 1024];
            let _ = stream.read(&mut request);
            let _ = stream.write_all(answer);
            kept.push(stream);
        }
    });
    address
}

/// A grey clip of 64x64 pixels at 25 frames/s, which costs next to nothing to send and decode.
pub fn tiny_clip(folder: &Path) -> PathBuf {
    use gakp::types::{Image, MediaTime, Plane};
    let path = folder.join("tiny.mp4");
    let (range, matrix) = (YuvRange::Limited, YuvMatrix::Bt601);
    let mut writer = VideoWriter::create(&path, (64, 64), 25.0, Pixels::I420(range, matrix)).unwrap();
    let planes =
        [(0, 64), (64 * 64, 32), (64 * 64 * 5 / 4, 32)].map(|(offset, stride)| Plane { offset, stride });
    let grey = Arc::new(vec![128u8; 64 * 64 * 3 / 2]);
    for n in 0..100 {
        let image = Image::i420((64, 64), range, matrix, planes, grey.clone()).unwrap();
        writer.write(&image, MediaTime::from_secs(f64::from(n) / 25.0)).unwrap();
    }
    writer.finish().unwrap();
    path
}
