//! What many subscribers cost: a real service with a real RTSP camera, one subscriber and then two hundred, twenty of
//! which never read. The tracker's rate and the readers' latency, from capture to the message at the client's socket.
//!
//!     cargo bench --bench subscribers [-- FILM [ROUNDS]]
//!
//! Two hundred clients have machines of their own; here they share the service's. So they read with the lowest
//! priority, and the kernel says when a message was there for them to read.

#[path = "../tests/service/support.rs"]
mod support;

use std::collections::BTreeMap;
use std::io::{Cursor, ErrorKind, IoSliceMut};
use std::net::SocketAddr;
use std::os::fd::AsRawFd;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use nix::sys::socket::{ControlMessageOwned, MsgFlags, recvmsg, setsockopt, sockopt};
use nix::sys::time::TimeSpec;
use support::{CameraProcess, Service};
use tokio::io::{AsyncReadExt, AsyncWriteExt, Interest};
use tokio::net::{TcpSocket, TcpStream};
use tokio_tungstenite::tungstenite::handshake::client::generate_key;
use tokio_tungstenite::tungstenite::protocol::frame::FrameHeader;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};

/// Subscribers of the second phase, and those of them that do not read.
const MANY: (usize, usize) = (200, 20);
/// How long a phase is measured, after a settling second.
const PHASE: Duration = Duration::from_secs(15);

/// A message: when its frame was captured, and how many seconds later it was at the client's socket.
type Received = (Timestamp, f64);

/// What a phase showed.
struct Seen {
    /// Frames tracked per second, by the service's own count.
    rate: f64,
    /// Latencies of all messages of all readers, s, sorted.
    latencies: Vec<f64>,
    /// Median over frames from the first reader's message to the last's, s.
    spread: f64,
    /// Readers' gaps.
    gaps: usize,
    /// Resident memory of the service at the end, MB.
    resident: f64,
}

impl Seen {
    fn percentile(&self, p: f64) -> f64 {
        percentile(&self.latencies, p)
    }
}

/// Of sorted seconds, in ms.
fn percentile(sorted: &[f64], p: f64) -> f64 {
    let at = ((sorted.len() as f64 * p) as usize).min(sorted.len().saturating_sub(1));
    1000.0 * sorted.get(at).copied().unwrap_or(f64::NAN)
}

/// A subscriber: its connection, and what came after the handshake's end.
async fn subscribe(address: SocketAddr, narrow: bool) -> (TcpStream, Vec<u8>) {
    let socket = TcpSocket::new_v4().expect("a socket");
    if narrow {
        socket.set_recv_buffer_size(4096).expect("a small buffer");
    }
    setsockopt(&socket, sockopt::ReceiveTimestampns, &true).expect("time stamps");
    let mut stream = socket.connect(address).await.expect("a connection");
    let key = generate_key();
    let request = format!(
        "GET /v1/tracks HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n"
    );
    stream.write_all(request.as_bytes()).await.expect("a request");
    let mut answer = vec![];
    loop {
        assert_ne!(stream.read_buf(&mut answer).await.expect("an answer"), 0, "hung up");
        if let Some(at) = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n") {
            assert!(answer.starts_with(b"HTTP/1.1 101 "), "{}", String::from_utf8_lossy(&answer));
            return (stream, answer.split_off(at + 4));
        }
    }
}

/// Messages, and how many gaps were told, until `end`. It only notes when so many bytes had come, and looks at them
/// afterwards.
async fn read(
    (stream, begun): (TcpStream, Vec<u8>),
    from: Timestamp,
    end: Instant,
) -> (Vec<Received>, usize) {
    let mut bytes = vec![0; 4 << 20];
    let mut filled = begun.len();
    bytes[..filled].copy_from_slice(&begun);
    let mut arrivals = vec![(filled, Timestamp::now())];
    let reading = async {
        while stream.readable().await.is_ok() {
            match stream.try_io(Interest::READABLE, || receive(&stream, &mut bytes[filled..])) {
                Ok((0, _)) => return,
                Ok((n, arrived)) => {
                    filled += n;
                    arrivals.push((filled, arrived.expect("a time stamp of the kernel")));
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(error) => panic!("{error}"),
            }
        }
    };
    let _ = tokio::time::timeout_at(end.into(), reading).await;
    assert!(filled < bytes.len(), "a phase has more to read than there is room");
    messages(&bytes[..filled], &arrivals, from)
}

/// How many bytes there were to read, and when the last of them arrived: by the kernel's clock, which is the one of
/// [`Timestamp::now`]. The end of the stream has no time.
fn receive(stream: &TcpStream, bytes: &mut [u8]) -> std::io::Result<(usize, Option<Timestamp>)> {
    let mut room = nix::cmsg_space!(TimeSpec);
    let mut slices = [IoSliceMut::new(bytes)];
    let message = recvmsg::<()>(stream.as_raw_fd(), &mut slices, Some(&mut room), MsgFlags::empty())?;
    let arrived = message.cmsgs()?.find_map(|message| match message {
        ControlMessageOwned::ScmTimestampns(at) => Timestamp::new(at.tv_sec(), at.tv_nsec() as i32).ok(),
        _ => None,
    });
    Ok((message.bytes, arrived))
}

/// Lets service and camera go first on the cores that this program shares with them. Threads started from here on
/// have it from this one.
fn yield_cores() {
    let own = std::process::id().to_string();
    let done = Command::new("renice").args(["-n", "19", "-p", &own]).output().expect("renice, of bsdutils");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

/// Takes the stream of WebSocket frames apart.
fn messages(bytes: &[u8], arrivals: &[(usize, Timestamp)], from: Timestamp) -> (Vec<Received>, usize) {
    let (mut received, mut gaps) = (vec![], 0);
    let mut frames = Cursor::new(bytes);
    while let Some((header, length)) = FrameHeader::parse(&mut frames).expect("a frame") {
        let begin = frames.position() as usize;
        let finish = begin + length as usize;
        let Some(payload) = bytes.get(begin..finish) else { break };
        frames.set_position(finish as u64);
        if header.opcode != OpCode::Data(Data::Text) {
            continue;
        }
        let text = std::str::from_utf8(payload).expect("text");
        let Some((_, rest)) = text.split_once("\"capture_ts\":\"") else {
            gaps += usize::from(text.contains("\"gap\""));
            continue;
        };
        let captured: Timestamp = rest.split('"').next().expect("a time").parse().expect("a time");
        let whole = arrivals.partition_point(|(filled, _)| *filled < finish);
        let now = arrivals[whole].1;
        if now >= from {
            received.push((captured, now.duration_since(captured).as_secs_f64()));
        }
    }
    (received, gaps)
}

/// Median over frames from the first reader's message to the last's, s.
fn spread(received: &[Received]) -> f64 {
    let mut frames: BTreeMap<Timestamp, (f64, f64)> = BTreeMap::new();
    for &(captured, latency) in received {
        let (first, last) = frames.entry(captured).or_insert((latency, latency));
        *first = first.min(latency);
        *last = last.max(latency);
    }
    median(frames.values().map(|(first, last)| last - first).collect())
}

fn phase(service: &Service, runtime: &tokio::runtime::Runtime, readers: usize, deaf: usize) -> Seen {
    let tracked = || service.metrics().of("gakp_frames_tracked_total", "demo");
    runtime.block_on(async {
        let mut silent = vec![];
        for _ in 0..deaf {
            silent.push(subscribe(service.address, true).await);
        }
        let settled = Instant::now() + Duration::from_secs(1);
        let from = Timestamp::now() + Duration::from_secs(1);
        let end = settled + PHASE;
        let mut tasks = vec![];
        for _ in 0..readers {
            tasks.push(tokio::spawn(read(subscribe(service.address, false).await, from, end)));
        }
        tokio::time::sleep_until(settled.into()).await;
        let (before, since) = (tracked(), Instant::now());
        tokio::time::sleep_until(end.into()).await;
        let rate = (tracked() - before) / since.elapsed().as_secs_f64();
        let resident = service.metrics().get("process_resident_memory_bytes") / 1e6;
        let (mut received, mut gaps) = (vec![], 0);
        for task in tasks {
            let (more, missed) = task.await.expect("a reader");
            received.extend(more);
            gaps += missed;
        }
        let spread = spread(&received);
        let mut latencies: Vec<f64> = received.into_iter().map(|(_, latency)| latency).collect();
        latencies.sort_by(f64::total_cmp);
        drop(silent);
        Seen { rate, latencies, spread, gaps, resident }
    })
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    // Cargo passes `--bench`.
    let mut args = std::env::args().skip(1).filter(|arg| arg != "--bench");
    let film =
        args.next().map(PathBuf::from).or_else(support::film).expect("a film: bash deploy/setup.sh footage");
    let rounds: usize = args.next().map_or(3, |n| n.parse().expect("a number of rounds"));
    let folder = tempfile::tempdir().expect("a folder");
    let camera = CameraProcess::start(&film, &[]);
    let given = format!("demo={}", camera.url);
    let service =
        Service::start(&folder.path().join("state"), &["--camera", &given, "--log", "warn,gakp::cli=info"]);
    service.wait_for_frames("demo", 20);
    yield_cores();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .expect("a runtime");
    println!("round  subscribers  frames/s  p50 ms  p95 ms  p99 ms  spread ms  gaps  resident MB");
    let mut rates = vec![];
    let (mut alone, mut among) = (vec![], vec![]);
    for round in 1..=rounds {
        let show = |name: &str, seen: &Seen| {
            let [p50, p95, p99] = [0.5, 0.95, 0.99].map(|p| seen.percentile(p));
            let Seen { rate, gaps, resident, spread, .. } = seen;
            let spread = 1000.0 * spread;
            println!(
                "{round:5}  {name:>11}  {rate:8.2}  {p50:6.1}  {p95:6.1}  {p99:6.1}  {spread:9.2}  {gaps:4}  {resident:11.0}"
            );
        };
        let one = phase(&service, &runtime, 1, 0);
        show("1", &one);
        let many = phase(&service, &runtime, MANY.0 - MANY.1, MANY.1);
        show("200 (20)", &many);
        rates.push(many.rate / one.rate);
        alone.extend(one.latencies);
        among.extend(many.latencies);
    }
    println!("frames/s with {} over 1: median {:.3}", MANY.0, median(rates));
    // One subscriber has 150 messages a round: too few for a 99th percentile of their own.
    alone.sort_by(f64::total_cmp);
    among.sort_by(f64::total_cmp);
    for p in [0.5, 0.95, 0.99] {
        let (one, many) = (percentile(&alone, p), percentile(&among, p));
        let (name, ratio) = (100.0 * p, many / one);
        println!(
            "p{name:.0} of all rounds: {one:.1} ms with 1, {many:.1} ms with {}, ratio {ratio:.3}",
            MANY.0
        );
    }
    service.stop();
}
