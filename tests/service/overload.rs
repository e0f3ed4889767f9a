//! More frames than the detector can take: cameras get the same share, and what is tracked is new.

use gakp::ingest::testcam::{TestCamera, TestCameraConfig};
use serde_json::json;

use super::ledger::Ledger;
use super::support::*;

/// Frames a second that the cameras send; all together many times what one thread detects in.
const RATES: [f64; 8] = [240.0, 240.0, 120.0, 120.0, 60.0, 60.0, 60.0, 60.0];

fn name(index: usize) -> String {
    format!("camera-{index}")
}

#[test]
fn cameras_share_a_detector_that_cannot_take_all() {
    let folder = tempfile::tempdir().unwrap();
    let clip = tiny_clip(folder.path());
    let start = |fps: &f64| {
        let config = TestCameraConfig { fps: Some(*fps), ..TestCameraConfig::new(&clip) };
        TestCamera::start(config).unwrap()
    };
    let cameras: Vec<_> = RATES.iter().map(start).collect();
    let given: Vec<_> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| format!("{}={}", name(index), camera.url()))
        .collect();
    let mut args = vec!["--threads", "1", "--detector-size", "640x512", "--max-cameras", "8"];
    given.iter().for_each(|camera| args.extend(["--camera", camera]));
    let service = Service::start(&folder.path().join("state"), &args);
    for index in 0..RATES.len() {
        service.wait_for_frames(&name(index), 5);
    }

    // One more is refused, and told why.
    let answer = service.post("/v1/cameras", &json!({"id": "too-many", "url": "test:"}));
    assert_eq!(answer.status, 409, "{}", answer.body);
    assert!(answer.body.contains("8") && answer.body.contains("max_cameras"), "{}", answer.body);

    let accounts = || {
        let metrics = service.metrics();
        (0..RATES.len()).map(|index| metrics.account(&name(index))).collect::<Vec<_>>()
    };
    let before = accounts();
    let (ledger, _) = Ledger::default().read(service.socket("/v1/tracks"), |ledger| ledger.reports > 400);
    let after = accounts();
    let came = |index: usize, what: usize| after[index][what] - before[index][what];
    let tracked: Vec<_> = (0..RATES.len()).map(|index| came(index, 1)).collect();
    let dropped: Vec<_> = (0..RATES.len()).map(|index| came(index, 2)).collect();
    assert!(
        dropped.iter().all(|dropped| *dropped > 0),
        "too gentle: {tracked:?} tracked, {dropped:?} dropped"
    );
    let [least, most] = [tracked.iter().min(), tracked.iter().max()].map(|n| *n.unwrap());
    assert!(most * 2 <= least * 3, "of eight cameras that send too much, one gets more: {tracked:?}");
    // All it may cost is a turn of each: no queue grows.
    assert!(ledger.oldest < 5.0, "a report was {} s old", ledger.oldest);
    assert_eq!(ledger.missed, 0);
    eprintln!("{tracked:?} tracked, {dropped:?} dropped, the oldest report {:.3} s", ledger.oldest);
    service.stop();
}
