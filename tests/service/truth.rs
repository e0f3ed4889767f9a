//! What the service counts in footage with ground truth, beside what there was.
//!
//! Needs MOTChallenge data (`GAKP_SHARED`, or `../shared`), which is not part of the project.

use std::collections::BTreeMap;

use gakp::analytics::{Analyst, Anchor, Line, Point, RuleId, Rules};
use gakp::mot::parse_truth;
use gakp::types::{
    CameraId, CaptureTime, ClassId, Clock, Epoch, FrameTracks, MediaTime, TrackId, TrackReport, TrackState,
};
use serde_json::json;

use super::support::*;

/// Upright lines at these fractions of the picture's width.
const PLACES: [f64; 4] = [0.2, 0.4, 0.6, 0.8];
const FPS: f64 = 25.0;
const SIZE: (u32, u32) = (640, 480);

fn points(x: f64) -> [[f64; 2]; 2] {
    [[x, 1.0], [x, 0.0]]
}

/// In and out of each line, as a tracker without fault would have them.
fn truth(folder: &std::path::Path) -> BTreeMap<String, [u64; 2]> {
    let text = std::fs::read_to_string(folder.join("gt/gt.txt")).unwrap();
    let rows = parse_truth(&text, None).unwrap();
    let line = |&x: &f64| Line {
        id: RuleId::new(&format!("at{x}")).unwrap(),
        points: points(x).map(|[x, y]| Point { x, y }).to_vec(),
        anchor: Anchor::Foot,
    };
    let mut analyst = Analyst::new(Rules { lines: PLACES.iter().map(line).collect(), ..Rules::default() });
    let last = rows.iter().map(|row| row.frame).max().unwrap();
    for frame in 1..=last {
        let tracks = rows.iter().filter(|row| row.frame == frame).map(|row| TrackReport {
            id: TrackId(row.id as u64),
            state: TrackState::Confirmed,
            class: ClassId::PERSON,
            bbox: row.bbox,
            confidence: 1.0,
            link: 1.0,
            velocity: [0.0; 2],
            matched: true,
        });
        analyst.update(&FrameTracks {
            camera: CameraId::new("truth").unwrap(),
            epoch: Epoch(1),
            seq: frame.into(),
            frame: frame.into(),
            time: MediaTime::from_secs(f64::from(frame) / FPS),
            capture: CaptureTime { unix_ns: 0, clock: Clock::Media },
            width: SIZE.0,
            height: SIZE.1,
            tracks: tracks.collect(),
            ended: vec![],
        });
    }
    let counts = analyst.counts().lines;
    counts.into_iter().map(|(id, count)| (id.to_string(), [count.inwards, count.outwards])).collect()
}

/// Each clip is played once in real time. What was counted is printed beside what there was.
#[test]
fn counts_of_real_footage_are_near_the_truth() {
    let sequences = ["TUD-Stadtmitte", "TUD-Campus"];
    let found: Option<Vec<_>> = sequences.into_iter().map(footage).collect();
    let (Some(found), Some(_)) = (found, models()) else { return };
    let state = tempfile::tempdir().unwrap();
    let service = Service::start(state.path(), &[]);
    let (mut there, mut wrong) = (0, 0);
    for (index, (video, folder)) in found.iter().enumerate() {
        let name = format!("c{index}");
        let lines: Vec<_> =
            PLACES.iter().map(|x| json!({"id": format!("at{x}"), "points": points(*x)})).collect();
        let camera = json!({"id": name, "url": video.to_str().unwrap(), "lines": lines});
        assert_eq!(service.post("/v1/cameras", &camera).status, 201);
        let status = service.wait_for_state(&name, "ended");
        let [tracked, frames] = ["tracked", "frames_in"].map(|key| status[key].as_u64().unwrap());
        if tracked * 10 < frames * 9 {
            eprintln!("SKIPPED: the machine was too busy, {tracked} of {frames} frames were tracked");
            return;
        }
        let counts = service.get(&format!("/v1/cameras/{name}/counts")).json();
        for (line, known) in truth(folder) {
            let counted = ["in", "out"].map(|way| counts["lines"][&line][way].as_u64().unwrap());
            println!("{} {line}: in, out {known:?}, counted {counted:?}", sequences[index]);
            there += known.iter().sum::<u64>();
            wrong += known.iter().zip(counted).map(|(a, b)| a.abs_diff(b)).sum::<u64>();
        }
    }
    println!("{there} crossings; differences line by line and way by way: {wrong}");
    assert!(there >= 10 && wrong * 4 <= there, "{wrong} of {there}");
    service.stop();
}
