//! A server on a free port, cameras that are made up, and small clients.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt};
use gakp::analytics::{Analyst, Heat, Rules};
use gakp::api::{
    ApiConfig, CameraError, CameraPatch, CameraState, CameraStatus, Cameras, Findings, KeepAlive, NewCamera,
    RuleEdit, TrackCounts,
};
use gakp::auth::Gate;
use gakp::notify::{Notifier, NotifyPlan};
use gakp::publish::{EventHub, Hub, HubConfig, Masks, Picture};
use gakp::types::{
    BBox, CameraId, CaptureTime, ClassId, Clock, Epoch, Frame, FrameTracks, Image, MediaTime, Plane, TrackId,
    TrackReport, TrackState, YuvMatrix, YuvRange,
};
use prometheus::Registry;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;
use tokio_rustls::rustls::ServerConfig;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::{Error as WsError, Message};
use tokio_tungstenite::{WebSocketStream, client_async};

/// Long enough for any step on a busy machine; reaching it is a failure.
pub const PATIENCE: Duration = Duration::from_secs(60);
/// How many cameras the made-up service allows.
pub const LIMIT: usize = 4;

pub async fn patiently<T>(what: &str, future: impl Future<Output = T>) -> T {
    match tokio::time::timeout(PATIENCE, future).await {
        Ok(value) => value,
        Err(_) => panic!("waited in vain: {what}"),
    }
}

/// Asks until it is so.
pub async fn eventually(what: &str, mut so: impl FnMut() -> bool) {
    patiently(what, async {
        while !so() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

pub fn id(name: &str) -> CameraId {
    CameraId::new(name).unwrap()
}

type Video = watch::Sender<Option<Arc<Picture>>>;

/// Cameras without a pipeline behind them: what the test puts in comes out.
#[derive(Default)]
pub struct FakeCameras {
    cameras: Mutex<BTreeMap<CameraId, (CameraStatus, Video)>>,
    analysts: Mutex<BTreeMap<CameraId, Analyst>>,
}

impl FakeCameras {
    pub fn put(&self, name: &str, url: &str) -> CameraStatus {
        let status = CameraStatus {
            id: id(name),
            url: url.to_owned(),
            state: CameraState::Live,
            since: "2026-01-02T03:04:05.678Z".parse().unwrap(),
            last_error: None,
            last_error_kind: None,
            next_retry_s: None,
            reconnects: 0,
            epoch: 1,
            width: Some(320),
            height: Some(240),
            fps: Some(25.0),
            frames_in: 10,
            tracked: 8,
            dropped: [("stale".to_owned(), 2)].into(),
            tracks: TrackCounts { tentative: 0, confirmed: 1, lost: 0 },
        };
        self.cameras.lock().unwrap().insert(id(name), (status.clone(), watch::channel(None).0));
        status
    }

    /// As if it had never been.
    pub fn clear(&self, name: &str) {
        self.cameras.lock().unwrap().remove(&id(name));
    }

    pub fn change(&self, name: &str, change: impl FnOnce(&mut CameraStatus)) {
        change(&mut self.cameras.lock().unwrap().get_mut(&id(name)).unwrap().0);
    }

    /// Shows a picture; false when the camera was removed.
    pub fn show(&self, picture: Picture) -> bool {
        let cameras = self.cameras.lock().unwrap();
        let Some((_, video)) = cameras.get(&picture.tracks.camera) else { return false };
        video.send_replace(Some(Arc::new(picture)));
        true
    }

    /// What watches the camera's lines and zones; `None` when there is no such camera.
    pub fn analyst<T>(&self, id: &CameraId, ask: impl FnOnce(&mut Analyst) -> T) -> Option<T> {
        self.get(id)?;
        Some(ask(self.analysts.lock().unwrap().entry(id.clone()).or_default()))
    }

    /// How many watch the camera's pictures at the source.
    pub fn watchers(&self, name: &str) -> usize {
        self.cameras.lock().unwrap()[&id(name)].1.receiver_count()
    }
}

impl Cameras for FakeCameras {
    fn list(&self) -> Vec<CameraStatus> {
        self.cameras.lock().unwrap().values().map(|(status, _)| status.clone()).collect()
    }

    fn get(&self, id: &CameraId) -> Option<CameraStatus> {
        self.cameras.lock().unwrap().get(id).map(|(status, _)| status.clone())
    }

    fn add(&self, request: NewCamera) -> BoxFuture<'_, Result<CameraStatus, CameraError>> {
        async move {
            if self.get(&request.id).is_some() {
                return Err(CameraError::Exists);
            }
            if self.list().len() >= LIMIT {
                return Err(CameraError::LimitReached(LIMIT));
            }
            if !request.url.contains("://") {
                return Err(CameraError::Invalid(format!("{:?} is no URL", request.url)));
            }
            Ok(self.put(request.id.as_str(), &request.url))
        }
        .boxed()
    }

    fn patch(&self, id: &CameraId, patch: CameraPatch) -> BoxFuture<'_, Result<CameraStatus, CameraError>> {
        let mut cameras = self.cameras.lock().unwrap();
        let patched = cameras.get_mut(id).map(|(status, _)| {
            status.url = patch.url.unwrap_or(status.url.clone());
            if let Some(paused) = patch.paused {
                status.state = if paused { CameraState::Paused } else { CameraState::Live };
            }
            status.clone()
        });
        async move { patched.ok_or(CameraError::NotFound) }.boxed()
    }

    fn remove(&self, id: &CameraId) -> BoxFuture<'_, Result<(), CameraError>> {
        let removed = self.cameras.lock().unwrap().remove(id);
        async move { removed.map(|_| ()).ok_or(CameraError::NotFound) }.boxed()
    }

    fn video(&self, id: &CameraId) -> Option<watch::Receiver<Option<Arc<Picture>>>> {
        self.cameras.lock().unwrap().get(id).map(|(_, video)| video.subscribe())
    }

    fn rules(&self, id: &CameraId) -> Option<Rules> {
        self.analyst(id, |analyst| analyst.rules().clone())
    }

    fn edit_rules(&self, id: &CameraId, edit: RuleEdit) -> BoxFuture<'_, Result<Rules, CameraError>> {
        let edited = self.analyst(id, |analyst| {
            let rules = edit.apply(analyst.rules())?;
            analyst.set_rules(rules.clone());
            Ok(rules)
        });
        async move { edited.unwrap_or(Err(CameraError::NotFound)) }.boxed()
    }

    fn findings(&self, id: &CameraId) -> Option<Findings> {
        let since = "2026-01-02T03:04:05.678Z".parse().unwrap();
        self.analyst(id, |analyst| Findings { since, counts: analyst.counts() })
    }

    fn heat(&self, id: &CameraId) -> Option<(jiff::Timestamp, Heat)> {
        let since = "2026-01-02T03:04:05.678Z".parse().unwrap();
        self.analyst(id, |analyst| (since, analyst.heat().clone()))
    }
}

/// A running server.
pub struct Server {
    pub addr: SocketAddr,
    pub hub: Hub,
    pub events: EventHub,
    pub cameras: Arc<FakeCameras>,
    pub ready: Arc<AtomicBool>,
    stop: oneshot::Sender<()>,
    done: JoinHandle<std::io::Result<()>>,
    /// Webhooks end with it.
    notifier: Notifier,
}

impl Server {
    pub async fn start() -> Self {
        Self::start_with(HubConfig::default(), KeepAlive::default()).await
    }

    pub async fn start_with(hub: HubConfig, keep_alive: KeepAlive) -> Self {
        Self::start_on("127.0.0.1:0".parse().unwrap(), Arc::default(), hub, keep_alive).await
    }

    /// With tokens, or TLS.
    pub async fn start_behind(gate: Gate, tls: Option<Arc<ServerConfig>>) -> Self {
        let addr = "127.0.0.1:0".parse().unwrap();
        let keep_alive = KeepAlive { ping_every: Duration::from_millis(200), ..KeepAlive::default() };
        Self::start_all(addr, Arc::default(), HubConfig::default(), keep_alive, gate, tls).await
    }

    pub async fn start_on(
        addr: SocketAddr,
        cameras: Arc<FakeCameras>,
        hub: HubConfig,
        keep_alive: KeepAlive,
    ) -> Self {
        Self::start_all(addr, cameras, hub, keep_alive, Gate::open(), None).await
    }

    async fn start_all(
        addr: SocketAddr,
        cameras: Arc<FakeCameras>,
        hub: HubConfig,
        keep_alive: KeepAlive,
        gate: Gate,
        tls: Option<Arc<ServerConfig>>,
    ) -> Self {
        let listener = TcpListener::bind(addr).await.unwrap();
        let addr = listener.local_addr().unwrap();
        let hub = Hub::new(hub, ["person".to_owned(), "car".to_owned()].into());
        let events = EventHub::new(hub.classes().clone());
        let registry = Registry::new();
        hub.metrics().register(&registry).unwrap();
        let ready = Arc::new(AtomicBool::new(true));
        let answer = ready.clone();
        let listed: Arc<dyn Cameras> = cameras.clone();
        let notifier =
            Notifier::start(NotifyPlan::default(), &listed, &hub, &events, &registry).await.unwrap();
        let config = ApiConfig {
            cameras: cameras.clone(),
            hub: hub.clone(),
            events: events.clone(),
            history: None,
            webhooks: notifier.webhooks(),
            registry,
            readiness: Arc::new(move || match answer.load(Ordering::SeqCst) {
                true => vec![],
                false => vec!["the detector is not loaded".to_owned()],
            }),
            gate: Arc::new(gate),
            operations: None,
            traces: None,
            tls,
        };
        let (stop, stopped) = oneshot::channel();
        let done = tokio::spawn(gakp::api::serve_with(listener, config, keep_alive, async {
            let _ = stopped.await;
        }));
        Self { addr, hub, events, cameras, ready, stop, done, notifier }
    }

    /// Stops it and says how long that took.
    pub async fn stop(self) -> Duration {
        let since = Instant::now();
        self.stop.send(()).unwrap();
        patiently("the server to end", self.done).await.unwrap().unwrap();
        since.elapsed()
    }

    pub async fn get(&self, path: &str) -> Response {
        self.request("GET", path, &[], b"").await
    }

    pub async fn post(&self, path: &str, json: &str) -> Response {
        self.request("POST", path, &[("Content-Type", "application/json")], json.as_bytes()).await
    }

    pub async fn request(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Response {
        let mut stream = self.open(method, path, headers, body).await;
        let mut bytes = Vec::new();
        patiently("the answer", stream.read_to_end(&mut bytes)).await.unwrap();
        Response::parse(&bytes)
    }

    /// Sends a request (HTTP/1.0: the answer ends with the connection and has no chunks).
    pub async fn open(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> TcpStream {
        let mut head = format!("{method} {path} HTTP/1.0\r\nHost: {}\r\n", self.addr);
        if !body.is_empty() {
            head += &format!("Content-Length: {}\r\n", body.len());
        }
        headers.iter().for_each(|(name, value)| head += &format!("{name}: {value}\r\n"));
        let mut stream = TcpStream::connect(self.addr).await.unwrap();
        stream.write_all(&[head.as_bytes(), b"\r\n", body].concat()).await.unwrap();
        stream
    }

    /// Opens a WebSocket; `Err` with status and body when the server refuses.
    pub async fn socket(&self, path: &str, headers: &[(&'static str, &str)]) -> Result<Socket, Response> {
        self.socket_over(TcpStream::connect(self.addr).await.unwrap(), path, headers).await
    }

    /// A WebSocket whose client's kernel buffers little.
    pub async fn narrow_socket(&self, path: &str, headers: &[(&'static str, &str)]) -> Socket {
        let socket = TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(4096).unwrap();
        let stream = socket.connect(self.addr).await.unwrap();
        self.socket_over(stream, path, headers).await.unwrap()
    }

    async fn socket_over(
        &self,
        stream: TcpStream,
        path: &str,
        headers: &[(&'static str, &str)],
    ) -> Result<Socket, Response> {
        let mut request = format!("ws://{}{path}", self.addr).into_client_request().unwrap();
        for (name, value) in headers {
            request.headers_mut().insert(*name, value.parse().unwrap());
        }
        match patiently("the handshake", client_async(request, stream)).await {
            Ok((stream, answer)) => {
                let protocol = answer.headers().get("sec-websocket-protocol");
                Ok(Socket { stream, protocol: protocol.map(|v| v.to_str().unwrap().to_owned()) })
            }
            Err(WsError::Http(answer)) => Err(Response {
                status: answer.status().as_u16(),
                head: format!("{:?}", answer.headers()),
                body: answer.body().clone().unwrap_or_default(),
            }),
            Err(error) => panic!("{error}"),
        }
    }
}

#[derive(Debug)]
pub struct Response {
    pub status: u16,
    pub head: String,
    pub body: Vec<u8>,
}

impl Response {
    fn parse(bytes: &[u8]) -> Self {
        let end = bytes.windows(4).position(|w| w == b"\r\n\r\n").expect("a response head");
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        Self { status, head: head.to_ascii_lowercase(), body: bytes[end + 4..].to_vec() }
    }

    pub fn text(&self) -> &str {
        std::str::from_utf8(&self.body).unwrap()
    }

    pub fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|e| panic!("{e}: {}", self.text()))
    }
}

#[derive(Debug)]
pub struct Socket {
    pub stream: WebSocketStream<TcpStream>,
    pub protocol: Option<String>,
}

impl Socket {
    /// The next message that is no ping.
    pub async fn message(&mut self) -> Message {
        loop {
            let message = patiently("a message", self.stream.next()).await.expect("open").expect("sound");
            if !matches!(message, Message::Ping(_)) {
                return message;
            }
        }
    }

    pub async fn json(&mut self) -> serde_json::Value {
        let Message::Text(text) = self.message().await else { panic!("not a text message") };
        serde_json::from_str(&text).unwrap()
    }

    pub async fn binary(&mut self) -> Vec<u8> {
        let Message::Binary(bytes) = self.message().await else { panic!("not a binary message") };
        bytes.into()
    }

    /// Reads until the server closes; its close code.
    pub async fn closed(&mut self) -> u16 {
        loop {
            if let Message::Close(frame) = self.message().await {
                return frame.expect("a close code").code.into();
            }
        }
    }
}

/// A report of one confirmed person at `bbox`.
pub fn tracks(camera: &str, epoch: u64, seq: u64, (width, height): (u32, u32), bbox: BBox) -> FrameTracks {
    FrameTracks {
        camera: id(camera),
        epoch: Epoch(epoch),
        seq,
        frame: seq * 2,
        time: MediaTime::from_secs(seq as f64 * 0.04),
        capture: CaptureTime {
            unix_ns: 1_767_323_045_000_000_000 + seq as i64 * 40_000_000,
            clock: Clock::Media,
        },
        width,
        height,
        tracks: vec![TrackReport {
            id: TrackId(7),
            state: TrackState::Confirmed,
            class: ClassId::PERSON,
            bbox,
            confidence: 0.9,
            link: 0.8,
            velocity: [25.0, 0.0],
            matched: true,
        }],
        ended: vec![],
    }
}

/// A grey picture with `tracks`' first box painted white.
pub fn picture(tracks: FrameTracks) -> Picture {
    let (width, height) = (tracks.width as usize, tracks.height as usize);
    let mut bytes = vec![60u8; width * height];
    let b = tracks.tracks[0].bbox.clipped(width as f64, height as f64);
    if let Some(b) = b {
        for y in b.y as usize..b.bottom() as usize {
            bytes[y * width + b.x as usize..y * width + b.right() as usize].fill(235);
        }
    }
    let (cw, ch) = (width.div_ceil(2), height.div_ceil(2));
    bytes.resize(width * height + 2 * cw * ch, 128);
    let plane = |offset, stride| Plane { offset, stride };
    let planes = [plane(0, width), plane(width * height, cw), plane(width * height + cw * ch, cw)];
    let size = (tracks.width, tracks.height);
    let image = Image::i420(size, YuvRange::Limited, YuvMatrix::Bt601, planes, Arc::new(bytes)).unwrap();
    let frame = Frame {
        camera: tracks.camera.clone(),
        epoch: tracks.epoch,
        index: tracks.frame,
        time: tracks.time,
        capture: tracks.capture,
        decoded: Instant::now(),
        image,
    };
    Picture::new(Arc::new(frame), Arc::new(tracks), Masks::none())
}
