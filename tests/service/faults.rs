//! Every fault that a camera can have, all at once, with two healthy cameras beside them. How quickly each is seen and
//! survived is measured by `cargo bench --bench faults`.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use gakp::ingest::Transport;
use gakp::ingest::testcam::{Fault, TestCamera, TestCameraConfig};
use serde_json::json;

use super::expected::expected;
use super::ledger::{Ended, Ledger};
use super::support::*;

const HEALTHY: [&str; 2] = ["healthy-1", "healthy-2"];

#[test]
fn every_fault_of_a_camera_is_its_own_and_every_frame_accounted_for() {
    let Some(clip) = clip() else { return };
    let folder = tempfile::tempdir().unwrap();
    let tiny = tiny_clip(folder.path());
    let steady = HEALTHY.map(|name| (name, CameraProcess::start(&clip, &[])));
    let faulty = Fault::ALL.map(|fault| {
        let config = TestCameraConfig { faulty: true, fps: Some(5.0), ..TestCameraConfig::new(&tiny) };
        (fault, TestCamera::start(config).unwrap())
    });
    let cameras = steady.iter().map(|(name, camera)| format!("{name}={}", camera.url));
    let cameras = cameras.chain(faulty.iter().map(|(fault, camera)| format!("{fault}={}", camera.url())));
    let cameras: Vec<_> = cameras.collect();
    let mut args = vec!["--detector-size", "320x256"];
    cameras.iter().for_each(|camera| args.extend(["--camera", camera]));
    let service = Service::start(&folder.path().join("state"), &args);
    let names: Vec<_> = HEALTHY.into_iter().chain(Fault::ALL.map(Fault::name)).collect();
    for name in &names {
        service.wait_for_frames(name, 1);
    }
    let socket = service.socket("/v1/tracks");
    let all_told = Arc::new(AtomicBool::new(false));
    let told = all_told.clone();
    let subscriber = thread::spawn(move || Ledger::default().read(socket, |_| told.load(Ordering::Relaxed)));

    for (fault, camera) in &faulty {
        camera.inject(Some(*fault)).unwrap();
    }
    for fault in Fault::ALL {
        let (name, kinds) = (fault.name(), expected(fault, Transport::Tcp));
        if kinds.is_empty() {
            service.wait_for_frames(name, 5);
            assert_eq!(service.camera(name)["last_error"], json!(null), "{fault}");
            continue;
        }
        eventually(&format!("the failure of {fault}"), || {
            let status = service.camera(name);
            let kind = status["last_error_kind"].as_str()?;
            kinds.contains(&kind).then_some(())
        });
    }
    for name in HEALTHY {
        service.wait_for_frames(name, 5);
    }
    for (_, camera) in &faulty {
        camera.inject(None).unwrap();
    }
    for fault in Fault::ALL {
        let status = service.wait_for_state(fault.name(), "live");
        service.wait_for_frames(fault.name(), 3);
        let lost = !expected(fault, Transport::Tcp).is_empty();
        assert_eq!(status["reconnects"].as_u64().unwrap() > 0, lost, "{status}");
    }
    for name in HEALTHY {
        let status = service.camera(name);
        assert_eq!((&status["reconnects"], &status["last_error"]), (&json!(0), &json!(null)), "{status}");
    }

    // Paused, a camera has nothing in flight any more: every account is balanced, and stays so.
    for name in &names {
        let answer = service.request("PATCH", &format!("/v1/cameras/{name}"), Some(r#"{"paused": true}"#));
        assert_eq!(answer.status, 200, "{}", answer.body);
    }
    let accounts = || {
        let metrics = service.metrics();
        names.iter().map(|name| metrics.account(name)).collect::<Vec<_>>()
    };
    let settled = accounts();
    thread::sleep(Duration::from_millis(500));
    assert_eq!(accounts(), settled);
    for (name, [frames_in, tracked, dropped]) in names.iter().zip(&settled) {
        assert_eq!(*frames_in, tracked + dropped, "{name}");
    }

    // The subscriber looks after each message: one more camera gives it one.
    all_told.store(true, Ordering::Relaxed);
    service.post("/v1/cameras", &json!({"id": "last", "url": "test:?fps=5"}));
    let (ledger, how) = subscriber.join().unwrap();
    assert_eq!((how, ledger.missed), (Ended::Enough, 0), "{ledger:?}");
    for (name, [_, tracked, _]) in names.iter().zip(settled) {
        assert_eq!(ledger.next[*name], tracked, "every tracked frame of {name} was published");
    }
    let log = service.stop();
    assert!(!log.contains("panicked"), "{log}");
}
