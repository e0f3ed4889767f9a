//! Every frame is accounted for and every hole is announced, whatever happens at either end.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use gakp::ingest::testcam::{TestCamera, TestCameraConfig};

use super::ledger::{Ended, Ledger};
use super::support::*;

/// A slow one was told what it missed, or it was cut off: on a machine so busy that half a minute
/// of reports do not fill a ring.
fn check_told(ledger: &Ledger, how: &Ended) {
    eprintln!("slow: {how:?} after {} reports, {} missed", ledger.reports, ledger.missed);
    assert!(ledger.missed > 0 || *how == Ended::ByService, "{ledger:?}");
}

#[test]
fn every_frame_is_accounted_for_and_every_hole_announced() {
    let Some(clip) = clip() else { return };
    let folder = tempfile::tempdir().unwrap();
    // One camera with people, killed twice; two that send far more than one core detects in.
    let mut gate = CameraProcess::start(&clip, &[]);
    let burst = TestCamera::start(TestCameraConfig {
        fps: Some(240.0),
        ..TestCameraConfig::new(tiny_clip(folder.path()))
    })
    .unwrap();
    let names = ["gate", "burst-1", "burst-2"];
    let cameras = [gate.url.clone(), burst.url(), burst.url()];
    let cameras: Vec<_> = names.iter().zip(cameras).map(|(name, url)| format!("{name}={url}")).collect();
    let mut args = vec!["--threads", "1", "--detector-size", "320x256"];
    cameras.iter().for_each(|camera| args.extend(["--camera", camera]));
    let service = Service::start(&folder.path().join("state"), &args);
    for name in names {
        service.wait_for_frames(name, 1);
    }

    let healthy = service.socket("/v1/tracks");
    let all_told = Arc::new(AtomicBool::new(false));
    let told = all_told.clone();
    let healthy = thread::spawn(move || Ledger::default().read(healthy, |_| told.load(Ordering::Relaxed)));

    // Two slow subscribers at once. One takes ten messages a second until both have lost some, then it
    // catches up; the other reads nothing until then.
    let mute = service.narrow_socket("/v1/tracks");
    let slow = service.narrow_socket("/v1/tracks");
    let hurry = Arc::new(AtomicBool::new(false));
    let hurried = hurry.clone();
    let slow = thread::spawn(move || {
        Ledger::default().read(slow, |ledger| {
            if !hurried.load(Ordering::Relaxed) {
                thread::sleep(Duration::from_millis(100));
            }
            ledger.missed > 0
        })
    });
    for _ in 0..2 {
        gate.kill();
        let lost = service.wait_for_state("gate", "retrying");
        assert!(lost["last_error"].is_string(), "{lost}");
        gate.restart();
        service.wait_for_state("gate", "live");
        service.wait_for_frames("gate", 5);
    }
    let hub = || {
        let metrics = service.metrics();
        ["published", "dropped"].map(|what| metrics.get(&format!("gakp_hub_reports_{what}_total")))
    };
    let cut_off = || service.metrics().get("gakp_hub_subscribers_given_up_total") > 0.0;
    let mut before = hub();
    eventually("both slow ones to lose something", || {
        let now = hub();
        let [published, dropped] = [0, 1].map(|of| now[of] - before[of]);
        before = now;
        // One alone can lose no more than is published.
        let both = published > 0.0 && dropped > 1.2 * published;
        (both || slow.is_finished() || (cut_off() && dropped > 0.0)).then_some(())
    });
    hurry.store(true, Ordering::Relaxed);
    let (slow, how) = slow.join().unwrap();
    check_told(&slow, &how);
    let (mute, how) = Ledger::default().read(mute, |ledger| ledger.missed > 0);
    check_told(&mute, &how);

    // No camera any more: what is in flight is finished, and then every account is balanced.
    gate.kill();
    burst.stop();
    for name in names {
        service.wait_for_state(name, "retrying");
    }
    let accounts = |metrics: &Metrics| names.map(|name| metrics.account(name));
    let balanced = |[frames_in, tracked, dropped]: &[u64; 3]| *frames_in == tracked + dropped;
    eventually("the accounts to be balanced", || {
        accounts(&service.metrics()).iter().all(balanced).then_some(())
    });
    // It stays so: nothing was late.
    let settled = accounts(&service.metrics());
    thread::sleep(Duration::from_millis(500));
    let metrics = service.metrics();
    assert_eq!(accounts(&metrics), settled);
    assert!(settled.iter().all(balanced), "{settled:?}");

    let overload: f64 = names.iter().map(|name| metrics.dropped(name, "overload")).sum();
    assert!(overload > 0.0, "the test was too gentle: {settled:?}");
    assert!(metrics.of("gakp_camera_reconnects_total", "gate") >= 2.0);
    for (name, [frames_in, tracked, dropped]) in names.iter().zip(settled) {
        assert_eq!(metrics.of("gakp_camera_up", name), 0.0);
        let status = service.camera(name);
        let sum: u64 = status["dropped"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum();
        assert_eq!(
            (&status["frames_in"], &status["tracked"], sum),
            (&frames_in.into(), &tracked.into(), dropped)
        );
    }

    // The healthy one missed nothing and heard the last report of every camera.
    all_told.store(true, Ordering::Relaxed);
    // It looks after each message: one more camera gives it one.
    service.post("/v1/cameras", &serde_json::json!({"id": "last", "url": "test:?fps=5"}));
    let (healthy, how) = healthy.join().unwrap();
    assert_eq!((how, healthy.missed), (Ended::Enough, 0), "{healthy:?}");
    // The newest frame wins: a camera that sends too much does not make what is tracked older.
    assert!(healthy.oldest < 5.0, "a report was {} s old", healthy.oldest);
    for (name, [_, tracked, _]) in names.iter().zip(settled) {
        assert_eq!(healthy.next[*name], tracked, "every tracked frame of {name} was published");
    }
    service.stop();
}
