//! Whether a service holds on to anything: cameras that hang up a thousand times, and cameras that are added and removed a
//! thousand times. Resident memory, threads and descriptors on the way, and the slope of the memory.
//!
//!     cargo bench --bench leaks [-- COUNT]
//!
//! Of either, COUNT (1000) are counted after as many that are not: memory is flat once the allocator has what it needs.

#[path = "../tests/service/support.rs"]
mod support;
#[path = "../tests/service/vitals.rs"]
mod vitals;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use gakp::ingest::testcam::{Fault, TestCamera, TestCameraConfig};
use serde_json::{Value, json};
use support::{Service, eventually, tiny_clip};
use vitals::Vitals;

/// Cameras that hang up, by turns.
const CAMERAS: usize = 16;
/// Cameras that are added and removed at a time.
const WORKERS: usize = 4;
/// Times between which one looks.
const STEPS: usize = 10;
/// Idle threads of a pool end after 10 s.
const REST: Duration = Duration::from_secs(12);

/// A look: how many it has been, and what the service holds.
type Look = (usize, Vitals);

struct Bench {
    service: Service,
    cameras: Vec<TestCamera>,
}

impl Bench {
    /// Once everything is at rest: all cameras live, and idle threads of a pool gone.
    fn look(&self, count: usize) -> Look {
        for index in 0..self.cameras.len() {
            self.service.wait_for_state(&Self::name(index), "live");
        }
        std::thread::sleep(REST);
        let vitals = Vitals::of(self.service.process.id());
        println!("{count:6}  {:11.1}  {:7}  {:11}", vitals.resident, vitals.threads, vitals.descriptors);
        (count, vitals)
    }

    fn name(index: usize) -> String {
        format!("camera-{index}")
    }

    fn reconnects(&self) -> usize {
        let metrics = self.service.metrics();
        let of = |index| metrics.of("gakp_camera_reconnects_total", &Self::name(index));
        (0..self.cameras.len()).map(of).sum::<f64>() as usize
    }

    /// Until so many more reconnections than now.
    fn hang_up(&self, count: usize) {
        let (before, since) = (self.reconnects(), Instant::now());
        while self.reconnects() < before + count {
            assert!(since.elapsed() < Duration::from_secs(600), "the cameras do not come back");
            for (index, camera) in self.cameras.iter().enumerate() {
                if self.service.camera(&Self::name(index))["state"] == "live" {
                    camera.inject(Some(Fault::HangUp)).expect("a faulty camera");
                }
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn add_and_remove(&self, count: usize) {
        let next = AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for worker in 0..WORKERS {
                let (next, url) = (&next, self.cameras[worker].url());
                let adds = std::thread::Builder::new().name(format!("worker-{worker}"));
                let adds = adds.spawn_scoped(scope, move || {
                    while next.fetch_add(1, Ordering::Relaxed) < count {
                        self.come_and_go(&url);
                    }
                });
                adds.expect("a thread");
            }
        });
    }

    /// A camera that was never there before, until it has tracked a frame.
    fn come_and_go(&self, url: &str) {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let id = format!("guest-{}", NEXT.fetch_add(1, Ordering::Relaxed));
        let answer = self.service.post("/v1/cameras", &json!({"id": id, "url": url}));
        assert_eq!(answer.status, 201, "{}", answer.body);
        let tracked = |status: Value| status["tracked"].as_u64().is_some_and(|n| n > 0).then_some(());
        eventually("a tracked frame", || tracked(self.service.camera(&id)));
        let answer = self.service.delete(&format!("/v1/cameras/{id}"));
        assert_eq!(answer.status, 204, "{}", answer.body);
    }

    fn measure(&self, what: &str, count: usize, repeat: impl Fn(&Self, usize)) {
        println!("\n{what}\n count  resident MB  threads  descriptors");
        self.look(0);
        repeat(self, count);
        let mut looks = vec![];
        for step in 0..=STEPS {
            looks.push(self.look(count + step * count / STEPS));
            if step < STEPS {
                repeat(self, count / STEPS);
            }
        }
        let (first, last) = (looks[0].1, looks[STEPS].1);
        let points: Vec<_> = looks.iter().map(|(count, vitals)| (*count as f64, vitals.resident)).collect();
        let (slope, error) = vitals::slope(&points);
        let [slope, error] = [slope, error].map(|v| 1000.0 * v);
        println!("slope of the memory: {slope:.2} MB a thousand, standard error {error:.2} (limit 1)");
        println!(
            "threads {} -> {}, descriptors {} -> {} (limit: the same)",
            first.threads, last.threads, first.descriptors, last.descriptors
        );
    }
}

fn main() {
    // Cargo passes `--bench`.
    let count = std::env::args().skip(1).find(|arg| arg != "--bench");
    let count: usize = count.map_or(1000, |n| n.parse().expect("a number"));
    let folder = tempfile::tempdir().expect("a folder");
    let clip = tiny_clip(folder.path());
    let start = |_| {
        let config = TestCameraConfig { faulty: true, fps: Some(5.0), ..TestCameraConfig::new(&clip) };
        TestCamera::start(config).expect("a camera")
    };
    let cameras: Vec<_> = (0..CAMERAS).map(start).collect();
    let given = cameras.iter().enumerate().map(|(i, camera)| format!("{}={}", Bench::name(i), camera.url()));
    let given: Vec<_> = given.collect();
    let mut args = vec!["--log", "error,gakp::cli=info", "--detector-size", "320x256"];
    given.iter().for_each(|camera| args.extend(["--camera", camera]));
    let service = Service::start(&folder.path().join("state"), &args);
    for index in 0..CAMERAS {
        service.wait_for_frames(&Bench::name(index), 5);
    }
    let bench = Bench { service, cameras };
    bench.measure("cameras that hang up", count, Bench::hang_up);
    bench.measure("cameras added and removed", count, Bench::add_and_remove);
    bench.service.stop();
}
