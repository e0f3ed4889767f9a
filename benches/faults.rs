//! What a camera's faults cost: a live service with two healthy cameras, and one that goes wrong in every way in turn.
//! How soon a fault is seen, when the first retry comes, how soon pictures come again once it is over, and what the
//! healthy cameras' subscribers notice of it.
//!
//!     cargo bench --bench faults [-- FILM [ROUNDS]]
//!
//! Cameras, service and subscriber share the machine. Every frame is accounted for and every message numbered, or it
//! panics.

#[path = "../tests/faults/expected.rs"]
mod expected;
#[path = "../tests/service/ledger.rs"]
mod ledger;
#[path = "../tests/service/support.rs"]
mod support;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

use expected::expected;
use gakp::ingest::Transport;
use gakp::ingest::testcam::{Fault, TestCamera, TestCameraConfig};
use jiff::Timestamp;
use ledger::Ledger;
use serde_json::Value;
use support::{CameraProcess, Service, eventually};
use tokio_tungstenite::tungstenite::Message;

/// The camera that goes wrong.
const FAULTY: &str = "faulty";
const HEALTHY: [&str; 2] = ["healthy-1", "healthy-2"];
/// How long everything is well before a fault, and how long the fault lasts.
const WELL: Duration = Duration::from_secs(8);
const WRONG: Duration = Duration::from_secs(12);
/// After a recovery, how long the healthy ones are still watched.
const AFTER: Duration = Duration::from_secs(2);
/// How often the API is asked for a camera's state.
const ASK: Duration = Duration::from_millis(50);

/// A message of the socket: which camera's, when it came, and how long after its frame was captured, s.
struct Report {
    camera: String,
    came: Instant,
    latency: f64,
}

/// What was seen of a fault, the worst of all rounds, s.
#[derive(Default)]
struct Seen {
    /// From its begin to the state that tells it.
    told: Option<f64>,
    /// From there to the first retry, as planned.
    retry: Option<f64>,
    /// From its end to the first tracked frame.
    back: f64,
    /// The longest time without a frame.
    gap: f64,
    /// Of the healthy cameras' messages meanwhile, s.
    latencies: Vec<f64>,
}

struct Bench {
    service: Service,
    camera: TestCamera,
    reports: Arc<Mutex<Vec<Report>>>,
}

impl Bench {
    /// The latencies of the healthy cameras' messages between two moments, s.
    fn latencies(&self, from: Instant, to: Instant) -> Vec<f64> {
        let reports = self.reports.lock().unwrap();
        let during = reports.iter().filter(|r| r.camera != FAULTY && (from..to).contains(&r.came));
        during.map(|report| report.latency).collect()
    }

    /// When the faulty camera's messages came, from a moment on.
    fn frames(&self, from: Instant) -> Vec<Instant> {
        let reports = self.reports.lock().unwrap();
        reports.iter().filter(|r| r.camera == FAULTY && r.came >= from).map(|report| report.came).collect()
    }

    /// One fault, from well to well again; also the latencies while all was well.
    fn suffer(&self, fault: Fault, seen: &mut Seen) -> Vec<f64> {
        self.service.wait_for_state(FAULTY, "live");
        self.service.wait_for_frames(FAULTY, 20);
        let calm = Instant::now();
        while calm.elapsed() < WELL {
            sleep(ASK);
            self.service.camera(FAULTY);
        }
        let well = self.latencies(calm, Instant::now());

        // For another size the test camera transcodes first: its own work, not the service's.
        self.camera.inject(Some(fault)).unwrap();
        let told = expected(fault, Transport::Tcp);
        let wrong = Instant::now();
        let mut noticed = None;
        while wrong.elapsed() < WRONG {
            let status = self.service.camera(FAULTY);
            if status["state"] == "retrying" && noticed.is_none() {
                let retry = status["next_retry_s"].as_f64().unwrap_or(0.0);
                noticed = Some((wrong.elapsed().as_secs_f64(), retry));
            }
            sleep(ASK);
        }
        assert_eq!(noticed.is_some(), !told.is_empty(), "{fault}");
        if let Some((told, retry)) = noticed {
            seen.told = Some(seen.told.unwrap_or(0.0).max(told));
            seen.retry = Some(seen.retry.unwrap_or(0.0).max(retry));
        }
        let over = Instant::now();
        if !fault.happens() {
            self.camera.inject(None).unwrap();
        }
        let first = eventually("a frame after the fault", || {
            sleep(ASK);
            self.service.camera(FAULTY);
            self.frames(over).first().copied()
        });
        seen.back = seen.back.max((first - over).as_secs_f64());
        sleep(AFTER);
        let mut frames = self.frames(wrong);
        frames.insert(0, wrong);
        let gaps = frames.windows(2).map(|pair| (pair[1] - pair[0]).as_secs_f64());
        seen.gap = gaps.fold(seen.gap, f64::max);
        seen.latencies.extend(self.latencies(wrong, Instant::now()));
        self.check_account();
        well
    }

    /// Paused, a camera has nothing in flight, and its account is balanced.
    fn check_account(&self) {
        let pause = |paused: bool| {
            let body = format!("{{\"paused\": {paused}}}");
            let answer = self.service.request("PATCH", &format!("/v1/cameras/{FAULTY}"), Some(&body));
            assert_eq!(answer.status, 200, "{}", answer.body);
        };
        pause(true);
        let [frames_in, tracked, dropped] = self.service.metrics().account(FAULTY);
        assert_eq!(frames_in, tracked + dropped);
        pause(false);
    }
}

fn percentile(mut values: Vec<f64>, p: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = ((values.len() as f64 * p) as usize).min(values.len().saturating_sub(1));
    1000.0 * values.get(at).copied().unwrap_or(f64::NAN)
}

fn main() {
    // Cargo passes `--bench`.
    let mut args = std::env::args().skip(1).filter(|arg| arg != "--bench");
    let film =
        args.next().map(PathBuf::from).or_else(support::film).expect("a film: bash deploy/setup.sh footage");
    let rounds: usize = args.next().map_or(3, |n| n.parse().expect("a number of rounds"));
    let folder = tempfile::tempdir().expect("a folder");
    let healthy = HEALTHY.map(|name| (name, CameraProcess::start(&film, &[])));
    let camera =
        TestCamera::start(TestCameraConfig { faulty: true, ..TestCameraConfig::new(&film) }).unwrap();
    let mut cameras: Vec<_> = healthy.iter().map(|(name, camera)| format!("{name}={}", camera.url)).collect();
    cameras.push(format!("{FAULTY}={}", camera.url()));
    let mut args = vec!["--log", "error,gakp::cli=info"];
    cameras.iter().for_each(|camera| args.extend(["--camera", camera]));
    let service = Service::start(&folder.path().join("state"), &args);
    for name in HEALTHY {
        service.wait_for_frames(name, 20);
    }

    let (reports, ended) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
    let mut socket = service.socket("/v1/tracks");
    let (kept, end) = (reports.clone(), ended.clone());
    let subscriber = std::thread::Builder::new().name("subscriber".into()).spawn(move || {
        let mut ledger = Ledger::by_epoch();
        while !end.load(Ordering::Relaxed) {
            let message = socket.message().expect("a message");
            let came = Instant::now();
            ledger.take(&message);
            let Message::Text(text) = message else { unreachable!("the ledger takes text alone") };
            let message: Value = serde_json::from_str(&text).expect("JSON");
            let Some(captured) = message["capture_ts"].as_str() else { continue };
            let captured: Timestamp = captured.parse().expect("a time");
            let latency = Timestamp::now().duration_since(captured).as_secs_f64();
            let camera = message["camera"].as_str().expect("a camera").to_owned();
            kept.lock().unwrap().push(Report { camera, came, latency });
        }
        ledger.missed
    });
    let bench = Bench { service, camera, reports };
    let mut all: Vec<_> = Fault::ALL.into_iter().map(|fault| (fault, Seen::default())).collect();
    let mut well = vec![];
    for round in 1..=rounds {
        for (fault, seen) in &mut all {
            eprintln!("round {round} of {rounds}: {fault}");
            well.extend(bench.suffer(*fault, seen));
        }
    }
    for (name, _) in &healthy {
        let status = bench.service.camera(name);
        assert_eq!(status["reconnects"], 0, "{status}");
    }
    ended.store(true, Ordering::Relaxed);
    let missed = subscriber.expect("a thread").join().expect("a subscriber");
    let usual = percentile(well, 0.99);
    println!("{rounds} rounds, the worst of each; s but for the p99 of the healthy cameras' messages, ms");
    println!("limits: told 5, retry 1, back 5, p99 1.10 times {usual:.1} ms, as while all are well");
    println!("fault               told  retry   back    gap    p99  ratio");
    for (fault, Seen { told, retry, back, gap, latencies }) in all {
        let or_none = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.2}"));
        let p99 = percentile(latencies, 0.99);
        println!(
            "{:17}  {:>5}  {:>5}  {back:5.2}  {gap:5.2}  {p99:5.1}  {:5.2}",
            fault.name(),
            or_none(told),
            or_none(retry),
            p99 / usual
        );
    }
    println!("every frame accounted for; {missed} messages missed; no healthy camera was lost");
    bench.service.stop();
}
