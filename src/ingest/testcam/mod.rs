//! A test camera: a file, served over real RTSP as often as one likes.
//!
//! The file's encoded frames lie in memory; every client gets a media of its own, so that it sees the
//! video from its first frame on. With UDP or TCP, with or without a password, with RTCP sender
//! reports. [`TestCamera::kill_clients`], [`TestCamera::freeze`] and [`TestCamera::inject`] misbehave on purpose.

mod fault;
mod feed;
mod footage;
mod gate;
mod packets;
mod wire;

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::path::PathBuf;
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;

use gstreamer as gst;
use gstreamer::glib;
use gstreamer_app as gst_app;
use gstreamer_rtsp_server as rtsp;
use gstreamer_rtsp_server::gio;
use gstreamer_rtsp_server::prelude::*;
use socket2::SockRef;

pub use fault::Fault;
use feed::Feeds;
use footage::{Footage, Form};
use gate::Gate;
use packets::Packets;

use super::Transport;

/// What a test camera sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Codec {
    /// H.264 / AVC.
    H264,
    /// H.265 / HEVC.
    H265,
    /// MPEG-4 part 2, as older cameras send it; only ever passed on, never encoded here.
    Mpeg4,
}

impl Codec {
    fn media_type(self) -> &'static str {
        match self {
            Codec::H264 => "video/x-h264",
            Codec::H265 => "video/x-h265",
            Codec::Mpeg4 => "video/mpeg",
        }
    }
}

/// What to serve, and where.
#[derive(Clone)]
pub struct TestCameraConfig {
    /// The video.
    pub file: PathBuf,
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
    /// The path of the URL; begins with a slash.
    pub path: String,
    /// A user and a password that clients must give.
    pub login: Option<(String, String)>,
    /// What to send. `None`: the file's own codec if it is one of them, else H.264.
    pub codec: Option<Codec>,
    /// Frames per second instead of the file's own.
    pub fps: Option<f64>,
    /// Begin again at the end, for ever; otherwise the stream ends.
    pub looped: bool,
    /// What RTP may travel by; `Auto` is what the client asks for.
    pub transport: Transport,
    /// Whether it may be told to go wrong ([`TestCamera::inject`]). What it sends takes one step more then.
    pub faulty: bool,
}

impl TestCameraConfig {
    /// A file on a free port of the loopback interface, looped, at `/live`.
    pub fn new(file: impl Into<PathBuf>) -> Self {
        Self {
            file: file.into(),
            listen: (Ipv4Addr::LOCALHOST, 0).into(),
            path: "/live".into(),
            login: None,
            codec: None,
            fps: None,
            looped: true,
            transport: Transport::Auto,
            faulty: false,
        }
    }
}

/// Why a test camera does not start.
#[derive(Debug, thiserror::Error)]
pub enum TestCameraError {
    /// The file cannot be opened.
    #[error("cannot open video {path:?}: {cause}")]
    File {
        /// Which.
        path: String,
        /// Why.
        cause: std::io::Error,
    },
    /// The file cannot be used.
    #[error("cannot serve {path:?}: {what}")]
    Video {
        /// Which.
        path: String,
        /// Why.
        what: String,
    },
    /// A part of GStreamer is not installed.
    #[error("cannot serve video: {0}")]
    Missing(String),
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {cause}")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why.
        cause: std::io::Error,
    },
    /// A setting out of range.
    #[error("bad test camera setting: {0}")]
    Setting(String),
}

/// A running test camera. Dropping it stops it.
pub struct TestCamera {
    config: TestCameraConfig,
    address: SocketAddr,
    frames: usize,
    codec: Codec,
    gate: Option<Gate>,
    server: rtsp::RTSPServer,
    factory: rtsp::RTSPMediaFactory,
    feeds: Arc<Feeds>,
    packets: Arc<Packets>,
    context: glib::MainContext,
    main_loop: glib::MainLoop,
    thread: Option<JoinHandle<()>>,
}

impl TestCamera {
    /// Reads the file (transcoding it if need be) and listens.
    pub fn start(config: TestCameraConfig) -> Result<Self, TestCameraError> {
        crate::ingest::init().map_err(|e| TestCameraError::Missing(e.to_string()))?;
        if !config.path.starts_with('/') || config.path.contains(['?', '#', ' ']) {
            return Err(TestCameraError::Setting(format!(
                "path {:?}: it begins with / and is plain",
                config.path
            )));
        }
        if config.fps.is_some_and(|fps| !(0.1..=240.0).contains(&fps)) {
            return Err(TestCameraError::Setting("fps must be 0.1 to 240".into()));
        }
        // GStreamer does not say why it cannot listen; asked before the work of reading the file.
        let taken = |cause| TestCameraError::Listen { address: config.listen, cause };
        TcpListener::bind(config.listen).map_err(taken)?;
        let form = Form { codec: config.codec, fps: config.fps, halved: false };
        let footage = Arc::new(footage::load(&config.file, form)?);
        // Behind its gate the server is its own affair.
        let local: IpAddr =
            if config.listen.is_ipv4() { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() };
        let inner = if config.faulty { (local, 0).into() } else { config.listen };
        let (frames, codec) = (footage.units.len(), footage.codec);

        let server = rtsp::RTSPServer::new();
        // Clients live in the server's thread: closing one from another thread while its pool thread
        // reads leaves that thread reading nothing for ever, with a GLib warning each time.
        let pool = rtsp::RTSPThreadPool::new();
        pool.set_max_threads(0);
        server.set_thread_pool(Some(&pool));
        server.set_address(&inner.ip().to_string());
        server.set_service(&inner.port().to_string());
        let (feeds, packets) = (Arc::new(Feeds::default()), Arc::new(Packets::default()));
        let factory = factory(footage, config.looped, feeds.clone(), packets.clone());
        match config.transport {
            Transport::Auto => {}
            Transport::Tcp => factory.set_protocols(rtsp::gst_rtsp::RTSPLowerTrans::TCP),
            Transport::Udp => factory.set_protocols(rtsp::gst_rtsp::RTSPLowerTrans::UDP),
        }
        if let Some((user, password)) = &config.login {
            require_login(&server, &factory, user, password);
        }
        let mounts =
            server.mount_points().ok_or_else(|| TestCameraError::Missing("no mount points".into()))?;
        mounts.add_factory(&config.path, factory.clone());

        let context = glib::MainContext::new();
        let main_loop = glib::MainLoop::new(Some(&context), false);
        let (ready, listening) = mpsc::sync_channel(1);
        let (running, looping, serving) = (context.clone(), main_loop.clone(), server.clone());
        let thread = std::thread::Builder::new().name("test-camera".into()).spawn(move || {
            let served = running.with_thread_default(|| match listen(&serving) {
                Ok((source, port)) => {
                    source.attach(Some(&running));
                    // The other end waits for it.
                    let _ = ready.send(Ok(port));
                    looping.run();
                    source.destroy();
                }
                Err(cause) => {
                    let _ = ready.send(Err(cause));
                }
            });
            if served.is_err() {
                tracing::error!("the test camera's main context belongs to another thread");
            }
        });
        let thread = thread.map_err(taken)?;
        let gone = |_| Err(std::io::Error::other("the RTSP server does not start"));
        let port = listening.recv().unwrap_or_else(gone).map_err(taken)?;
        let mut camera = Self {
            address: (inner.ip(), port).into(),
            config,
            frames,
            codec,
            gate: None,
            server,
            factory,
            feeds,
            packets,
            context,
            main_loop,
            thread: Some(thread),
        };
        if camera.config.faulty {
            let listen = camera.config.listen;
            let gate = Gate::open(listen, camera.address);
            let gate = gate.map_err(|cause| TestCameraError::Listen { address: listen, cause })?;
            camera.address = gate.address();
            camera.gate = Some(gate);
        }
        Ok(camera)
    }

    /// The URL for clients, without the password (`user:***@` where one is needed).
    pub fn url(&self) -> String {
        let login = self.config.login.as_ref().map(|(user, _)| format!("{user}:***@"));
        self.url_with(&login.unwrap_or_default())
    }

    /// The URL with something (`user:password@`) before the host.
    pub fn url_with(&self, login: &str) -> String {
        let ip = match self.address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
            IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
            ip => ip,
        };
        format!("rtsp://{login}{}{}", SocketAddr::from((ip, self.address.port())), self.config.path)
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Frames of one round.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// What is sent.
    pub fn codec(&self) -> Codec {
        self.codec
    }

    /// Sends nothing more to anybody, connections staying open; `false` goes on where it stopped.
    pub fn freeze(&self, frozen: bool) {
        self.feeds.freeze(frozen);
    }

    /// Cuts every client off; they may come again.
    pub fn kill_clients(&self) {
        let server = self.server.clone();
        self.in_server_thread(move || {
            server.client_filter(Some(&mut |_, _| rtsp::RTSPFilterResult::Remove));
        });
    }

    /// Goes wrong from now on in this way, and in no other; `None` lifts the fault. [`Fault::Resolution`] takes the
    /// time of transcoding the video before it begins. Only a camera that was started `faulty` does it.
    pub fn inject(&self, fault: Option<Fault>) -> Result<(), TestCameraError> {
        let gate = self.gate.as_ref();
        let gate =
            gate.ok_or_else(|| TestCameraError::Setting("the camera was not started faulty".into()))?;
        let halved = || {
            let form = Form { codec: Some(self.codec), fps: self.config.fps, halved: true };
            footage::load(&self.config.file, form).map(Arc::new)
        };
        let instead = (fault == Some(Fault::Resolution)).then(halved).transpose()?;
        self.feeds.replace(instead);
        self.feeds.slow(if fault == Some(Fault::FrameRate) { 2 } else { 1 });
        self.feeds.freeze(matches!(fault, Some(Fault::Freeze | Fault::HalfOpen)));
        self.packets.set(fault);
        self.factory.set_enable_rtcp(fault != Some(Fault::NoSenderReports));
        gate.set(fault);
        if fault.is_some_and(Fault::cuts_off) {
            // Over UDP the server goes on without the connection.
            self.kill_clients();
        }
        Ok(())
    }

    /// Cuts every client off and stops listening.
    pub fn stop(mut self) {
        self.shut_down();
    }

    fn shut_down(&mut self) {
        if let Some(thread) = self.thread.take() {
            self.gate = None;
            self.kill_clients();
            let main_loop = self.main_loop.clone();
            self.in_server_thread(move || main_loop.quit());
            // A panic there was already reported.
            let _ = thread.join();
        }
    }

    /// Runs a piece of work where the server lives, and waits for it.
    fn in_server_thread(&self, work: impl FnOnce() + Send + 'static) {
        let (done, wait) = mpsc::sync_channel(1);
        self.context.invoke(move || {
            work();
            // The other end waits for it.
            let _ = done.send(());
        });
        // An error means that the server is gone, and with it the work.
        let _ = wait.recv_timeout(std::time::Duration::from_secs(5));
    }
}

impl Drop for TestCamera {
    fn drop(&mut self) {
        self.shut_down();
    }
}

/// Listens; what comes is the server's. Frames leave at once, as with a camera: where the kernel may wait for the
/// acknowledgement of the last bytes (Nagle), one frame of a hundred is 40 ms late.
fn listen(server: &rtsp::RTSPServer) -> std::io::Result<(glib::Source, u16)> {
    let socket = server.create_socket(gio::Cancellable::NONE).map_err(std::io::Error::other)?;
    // Connections have it from the socket that accepts them.
    let tcp = SockRef::from(&socket);
    tcp.set_tcp_nodelay(true)?;
    let address = tcp.local_addr()?.as_socket();
    let port = address.ok_or_else(|| std::io::Error::other("not a TCP socket"))?.port();
    let server = server.clone();
    let accept =
        move |socket: &gio::Socket, condition| match rtsp::RTSPServer::io_func(socket, condition, &server) {
            Ok(()) => glib::ControlFlow::Continue,
            Err(_) => glib::ControlFlow::Break,
        };
    let ready =
        glib::IOCondition::IN | glib::IOCondition::ERR | glib::IOCondition::HUP | glib::IOCondition::NVAL;
    let source = SocketExtManual::create_source(
        &socket,
        ready,
        gio::Cancellable::NONE,
        None,
        glib::Priority::DEFAULT,
        accept,
    );
    Ok((source, port))
}

/// Makes a media for every client: an appsrc, fed from memory, and a payloader.
fn factory(
    footage: Arc<Footage>,
    looped: bool,
    feeds: Arc<Feeds>,
    packets: Arc<Packets>,
) -> rtsp::RTSPMediaFactory {
    let factory = rtsp::RTSPMediaFactory::new();
    let payloader = match footage.codec {
        Codec::H264 => "rtph264pay aggregate-mode=zero-latency",
        Codec::H265 => "rtph265pay aggregate-mode=zero-latency",
        Codec::Mpeg4 => "rtpmp4vpay",
    };
    factory.set_launch(&format!("( appsrc name=feed ! {payloader} name=pay0 pt=96 config-interval=-1 )"));
    factory.set_shared(false);
    factory.connect_media_configure(move |_, media| {
        let bin = media.element().downcast::<gst::Bin>().ok();
        let part = |name| bin.as_ref().and_then(|bin| bin.by_name(name));
        let source = part("feed").and_then(|feed| feed.downcast::<gst_app::AppSrc>().ok());
        let packets_of = part("pay0").and_then(|payloader| payloader.static_pad("src"));
        let (Some(source), Some(pad)) = (source, packets_of) else {
            tracing::error!("the test camera's media lacks its source or its payloader");
            return;
        };
        packets.watch(&pad);
        feeds.add(&source, footage.clone(), looped);
    });
    factory
}

/// Digest authentication, as cameras do.
fn require_login(server: &rtsp::RTSPServer, factory: &rtsp::RTSPMediaFactory, user: &str, password: &str) {
    let auth = rtsp::RTSPAuth::new();
    auth.set_supported_methods(rtsp::gst_rtsp::RTSPAuthMethod::Digest);
    let token = rtsp::RTSPToken::builder().field("media.factory.role", "viewer").build();
    auth.add_digest(user, password, &token);
    server.set_auth(Some(&auth));
    let role = gst::Structure::builder("viewer")
        .field("media.factory.access", true)
        .field("media.factory.construct", true)
        .build();
    factory.add_role_from_structure(&role);
}
