//! A camera that goes wrong in every way that the test camera knows: what a source makes of it.
#![cfg(feature = "testcam")]

#[path = "faults/expected.rs"]
mod expected;
#[path = "ingest_help/mod.rs"]
mod ingest_help;

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use expected::expected;
use gakp::ingest::testcam::{Fault, TestCamera, TestCameraConfig, TestCameraError};
use gakp::ingest::{RawFrame, SourceEvent, SourceSpec, Transport};
use gakp::types::Clock;
use ingest_help::{Clip, Live, PATIENCE};

/// A camera's life, from before the fault to after it.
struct Watched {
    fault: Fault,
    live: Live,
    last: Option<RawFrame>,
    /// The labels of the failures, and when the next attempt came.
    lost: Vec<(&'static str, Duration)>,
    frames: usize,
}

impl Watched {
    /// One event. Times only grow, and a frame was captured just now, whatever the camera says.
    fn take(&mut self) {
        match self.live.next().expect("a camera has no end") {
            SourceEvent::Frame(frame) => {
                let wall = SystemTime::now() - frame.decoded.elapsed();
                let wall = wall.duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64;
                let age = (wall - frame.capture.unix_ns) as f64 * 1e-9;
                assert!((-0.5..8.0).contains(&age), "{}: captured {age} s ago", self.fault);
                if let Some(last) = &self.last {
                    assert!(frame.time > last.time, "{}: {:?} after {:?}", self.fault, frame.time, last.time);
                    assert!(frame.capture.unix_ns >= last.capture.unix_ns, "{}", self.fault);
                    let (wall, media) =
                        ((frame.decoded - last.decoded).as_secs_f64(), frame.time.since(last.time));
                    assert!((media - wall).abs() < 4.0, "{}: {media} s of media in {wall} s", self.fault);
                }
                self.frames += 1;
                self.last = Some(frame);
            }
            SourceEvent::Lost { reason, retry_in } => {
                self.lost.push((reason.label(), retry_in.expect("it is tried again")));
            }
            _ => {}
        }
    }

    fn until(&mut self, what: &str, so: impl Fn(&Self) -> bool) {
        let begun = Instant::now();
        while !so(self) {
            assert!(begun.elapsed() < PATIENCE, "{}: no {what}: {:?}", self.fault, self.lost);
            self.take();
        }
    }

    fn for_a_while(&mut self, seconds: u64) {
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(seconds) {
            self.take();
        }
    }

    fn last(&self) -> &RawFrame {
        self.last.as_ref().expect("a frame")
    }
}

fn check(fault: Fault, clip: &Clip, transport: Transport) {
    let config = TestCameraConfig { faulty: true, fps: Some(10.0), ..TestCameraConfig::new(clip.path()) };
    let camera = TestCamera::start(config).unwrap();
    let mut spec = SourceSpec::parse(&camera.url()).unwrap();
    spec.transport = transport;
    let mut seen = Watched { fault, live: Live::start(spec), last: None, lost: vec![], frames: 0 };
    seen.until("clock of the camera", |seen| seen.frames > 20 && seen.last().capture.clock == Clock::Rtcp);
    assert_eq!(seen.lost, [], "{fault}");
    let size = seen.last().image.width;

    camera.inject(Some(fault)).unwrap();
    let labels = expected(fault, transport);
    match fault {
        _ if !labels.is_empty() => {
            let known = |seen: &Watched| seen.lost.iter().any(|(label, _)| labels.contains(label));
            seen.until("failure", known);
        }
        // A key frame comes every five seconds.
        Fault::Resolution => seen.until("other size", |seen| seen.last().image.width == size / 2),
        _ => seen.for_a_while(5),
    }
    if !fault.happens() {
        camera.inject(None).unwrap();
    }
    let (frames, well) = (seen.frames, Instant::now());
    seen.until("frame after the fault", |seen| seen.frames > frames + 5);
    match fault {
        Fault::Resolution => seen.until("its size", |seen| seen.last().image.width == size),
        Fault::NoSenderReports => assert_eq!(seen.last().capture.clock, Clock::Arrival),
        _ => {}
    }
    eprintln!("{fault}: {:?}, {:?} until five frames came", seen.lost, well.elapsed());
    if let Some((_, retry_in)) = seen.lost.first() {
        assert!(*retry_in < Duration::from_secs(1), "{fault}: {:?}", seen.lost);
    }
    assert_eq!(seen.lost.is_empty(), labels.is_empty(), "{fault}: {:?}", seen.lost);
    seen.live.stop();
}

/// All at once: what one camera does is no other's affair.
fn check_all(transport: Transport) {
    // No B frames: they are rare in cameras, and their time stamps wander by themselves.
    let clip = Clip::numbered(100, 10.0).through(
        ".mp4",
        "qtdemux ! avdec_h264 ! x264enc key-int-max=50 bframes=0 pass=qual quantizer=18 ! h264parse ! mp4mux",
    );
    std::thread::scope(|scope| {
        for fault in Fault::ALL {
            let clip = &clip;
            let checks = std::thread::Builder::new().name(fault.name().into());
            checks.spawn_scoped(scope, move || check(fault, clip, transport)).unwrap();
        }
    });
}

#[test]
fn every_fault_is_told_and_survived_over_tcp() {
    check_all(Transport::Tcp);
}

#[test]
fn every_fault_is_told_and_survived_over_udp() {
    check_all(Transport::Udp);
}

#[test]
fn a_camera_that_does_not_let_go_is_left_quickly() {
    let clip = Clip::numbered(50, 25.0);
    for fault in [Fault::HalfOpen, Fault::MuteTeardown, Fault::EndlessHeader, Fault::Garbage] {
        let config = TestCameraConfig { faulty: true, ..TestCameraConfig::new(clip.path()) };
        let camera = TestCamera::start(config).unwrap();
        if fault == Fault::EndlessHeader {
            camera.inject(Some(fault)).unwrap();
        }
        let mut live = Live::start(SourceSpec::parse(&camera.url()).unwrap());
        if fault == Fault::EndlessHeader {
            // The header is coming in; GStreamer stops for nobody.
            std::thread::sleep(Duration::from_secs(1));
        } else {
            live.wait_frame();
            camera.inject(Some(fault)).unwrap();
        }
        let begun = Instant::now();
        live.stop();
        // A source that hangs is left behind after 5 s.
        assert!(begun.elapsed() < Duration::from_secs(4), "{fault}: {:?}", begun.elapsed());
    }
}

#[test]
fn only_a_faulty_camera_goes_wrong() {
    let clip = Clip::numbered(10, 25.0);
    let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
    assert!(matches!(camera.inject(Some(Fault::Freeze)), Err(TestCameraError::Setting(_))));
    assert!("thirst".parse::<Fault>().unwrap_err().contains("half-open"));
    assert!(Fault::ALL.iter().all(|fault| fault.name().parse() == Ok(*fault)));
}
