//! What many subscribers cost: a real service with a real RTSP camera, one subscriber and then two hundred, twenty of
//! which never read. The tracker's rate and the readers' latency, from capture to the message in the client's hands.
//!
//!     cargo bench --bench subscribers [-- FILM [ROUNDS]]
//!
//! Clients and service share the machine: what the clients cost is in the figures.

#[path = "../tests/service/support.rs"]
mod support;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use futures::StreamExt;
use jiff::Timestamp;
use support::{CameraProcess, Service};
use tokio::net::{TcpSocket, TcpStream};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::{WebSocketStream, client_async_with_config};

/// Subscribers of the second phase, and those of them that do not read.
const MANY: (usize, usize) = (200, 20);
/// How long a phase is measured, after a settling second.
const PHASE: Duration = Duration::from_secs(15);

/// What a phase showed.
struct Seen {
    /// Frames tracked per second, by the service's own count.
    rate: f64,
    /// Latencies of all messages of all readers, s, sorted.
    latencies: Vec<f64>,
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

async fn subscribe(address: SocketAddr, narrow: bool) -> WebSocketStream<TcpStream> {
    let stream = if narrow {
        let socket = TcpSocket::new_v4().expect("a socket");
        socket.set_recv_buffer_size(4096).expect("a small buffer");
        socket.connect(address).await
    } else {
        TcpStream::connect(address).await
    };
    let request = format!("ws://{address}/v1/tracks").into_client_request().expect("a request");
    // By default 128 KiB are cleared before each read.
    let config = WebSocketConfig::default().read_buffer_size(8192);
    let stream = stream.expect("a connection");
    client_async_with_config(request, stream, Some(config)).await.expect("the handshake").0
}

/// Latencies, and how many gaps were told, until `end`. Messages are looked into afterwards: 180 clients that parse
/// on the service's cores would measure each other.
async fn read(mut socket: WebSocketStream<TcpStream>, from: Instant, end: Instant) -> (Vec<f64>, usize) {
    let mut messages = vec![];
    while let Ok(Some(Ok(message))) = tokio::time::timeout_at(end.into(), socket.next()).await {
        messages.push((Instant::now(), Timestamp::now(), message));
    }
    let (mut latencies, mut gaps) = (vec![], 0);
    for (at, now, message) in messages {
        let Ok(text) = message.to_text() else { continue };
        let Some((_, rest)) = text.split_once("\"capture_ts\":\"") else {
            gaps += usize::from(text.contains("\"gap\""));
            continue;
        };
        let captured: Timestamp = rest.split('"').next().expect("a time").parse().expect("a time");
        if at >= from {
            latencies.push(now.duration_since(captured).as_secs_f64());
        }
    }
    (latencies, gaps)
}

fn phase(service: &Service, runtime: &tokio::runtime::Runtime, readers: usize, deaf: usize) -> Seen {
    let tracked = || service.metrics().of("gakp_frames_tracked_total", "demo");
    runtime.block_on(async {
        let mut silent = vec![];
        for _ in 0..deaf {
            silent.push(subscribe(service.address, true).await);
        }
        let from = Instant::now() + Duration::from_secs(1);
        let end = from + PHASE;
        let mut tasks = vec![];
        for _ in 0..readers {
            tasks.push(tokio::spawn(read(subscribe(service.address, false).await, from, end)));
        }
        tokio::time::sleep_until(from.into()).await;
        let (before, since) = (tracked(), Instant::now());
        tokio::time::sleep_until(end.into()).await;
        let rate = (tracked() - before) / since.elapsed().as_secs_f64();
        let resident = service.metrics().get("process_resident_memory_bytes") / 1e6;
        let (mut latencies, mut gaps) = (vec![], 0);
        for task in tasks {
            let (more, missed) = task.await.expect("a reader");
            latencies.extend(more);
            gaps += missed;
        }
        latencies.sort_by(f64::total_cmp);
        drop(silent);
        Seen { rate, latencies, gaps, resident }
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
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .expect("a runtime");
    println!("round  subscribers  frames/s  p50 ms  p95 ms  p99 ms  gaps  resident MB");
    let mut rates = vec![];
    let (mut alone, mut among) = (vec![], vec![]);
    for round in 1..=rounds {
        let show = |name: &str, seen: &Seen| {
            let [p50, p95, p99] = [0.5, 0.95, 0.99].map(|p| seen.percentile(p));
            let Seen { rate, gaps, resident, .. } = seen;
            println!(
                "{round:5}  {name:>11}  {rate:8.2}  {p50:6.1}  {p95:6.1}  {p99:6.1}  {gaps:4}  {resident:11.0}"
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
