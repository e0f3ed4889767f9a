//! Laws of the tracking core, with a scorer made of geometry alone: no model, no file, no clock.

use gakp::track::features::relative;
use gakp::track::shift::Shift;
use gakp::track::{FrameInput, LinkRequest, TrackError, Tracker, TrackerConfig, Update};
use gakp::types::{BBox, Detection, MediaTime, TrackId, TrackState};
use proptest::prelude::*;
use std::collections::BTreeSet;

const SIZE: (f64, f64) = (640.0, 480.0);

/// A probability from the overlap with the prediction (feature 14) and the Mahalanobis distance (15).
fn geometry(request: &LinkRequest) -> Vec<f32> {
    let pair = |f: &[f32]| 0.5 * f[14] + 0.5 * (-(f[15] * 5.0).powi(2) / 4.0).exp();
    request.candidates.chunks(relative::CANDIDATE).map(pair).collect()
}

fn step(tracker: &mut Tracker, seconds: f64, detections: &[Detection]) -> Update {
    let mut request = LinkRequest::default();
    let frame = FrameInput {
        time: MediaTime::from_secs(seconds),
        width: SIZE.0,
        height: SIZE.1,
        detections,
        embeddings: &[],
        shift: None,
    };
    tracker.predict(frame, &mut request);
    tracker.update(&geometry(&request)).expect("a score for each pair")
}

fn person(cx: f64, cy: f64) -> Detection {
    Detection::person(BBox::from_center(cx, cy, 40.0, 100.0), 0.9)
}

#[test]
fn a_walker_is_confirmed_coasts_is_lost_and_found_again() {
    let mut tracker = Tracker::new(TrackerConfig::default());
    let x = |frame: usize| 100.0 + 4.0 * frame as f64;
    let mut states = Vec::new();
    for frame in 0..40 {
        let seen = !(15..30).contains(&frame);
        let detections = if seen { vec![person(x(frame), 200.0)] } else { vec![] };
        let update = step(&mut tracker, frame as f64 / 25.0, &detections);
        assert_eq!(update.tracks.len(), 1, "frame {frame}");
        let track = update.tracks[0];
        assert_eq!(track.id, TrackId(1));
        assert_eq!(track.matched, seen);
        if frame > 8 {
            assert!((track.bbox.cx() - x(frame)).abs() < 6.0, "frame {frame}: {track:?}");
            assert!((track.velocity[0] - 100.0).abs() < 25.0, "frame {frame}: {track:?}");
        }
        states.push(track.state);
    }
    use TrackState::*;
    assert_eq!(states[..2], [Tentative; 2]);
    assert_eq!(states[2..18], [Confirmed; 16], "coasts for 0.15 s");
    assert_eq!(states[18..30], [Lost; 12]);
    assert_eq!(states[30..], [Confirmed; 10]);
}

#[test]
fn a_newborn_that_is_missed_dies_and_a_lost_track_dies_after_its_time() {
    let mut tracker = Tracker::new(TrackerConfig::default());
    step(&mut tracker, 0.0, &[person(100.0, 100.0)]);
    assert_eq!(step(&mut tracker, 0.04, &[]).ended, [TrackId(1)]);
    for frame in 2..10 {
        step(&mut tracker, f64::from(frame) * 0.04, &[person(300.0, 200.0)]);
    }
    assert!(step(&mut tracker, 2.3, &[]).ended.is_empty(), "lost for 1.94 s");
    let update = step(&mut tracker, 2.4, &[]);
    assert_eq!((update.tracks.len(), update.ended), (0, vec![TrackId(2)]));
    let update = step(&mut tracker, 2.44, &[person(300.0, 200.0)]);
    assert_eq!(update.tracks[0].id, TrackId(3), "an id is never used again");
}

#[test]
fn two_people_who_cross_keep_their_ids() {
    let mut tracker = Tracker::new(TrackerConfig::default());
    let mut last = Vec::new();
    for frame in 0..80 {
        let t = frame as f64;
        // They pass each other at slightly different distances from the camera.
        let update =
            step(&mut tracker, t / 25.0, &[person(100.0 + 5.0 * t, 200.0), person(500.0 - 5.0 * t, 230.0)]);
        last = update.tracks;
    }
    assert_eq!(last.len(), 2);
    assert_eq!((last[0].id, last[1].id), (TrackId(1), TrackId(2)));
    // Births are ordered by score, then from the left: 1 began on the left and is now on the right.
    assert!(last[0].bbox.cx() > last[1].bbox.cx(), "{last:?}");
}

#[test]
fn a_camera_that_jumps_takes_its_tracks_along() {
    let crowd = |tilt: f64| -> Vec<Detection> {
        (0..5).map(|i| person(80.0 + 110.0 * f64::from(i), 150.0 + 40.0 * f64::from(i % 2) + tilt)).collect()
    };
    let matched_after = |config: TrackerConfig| -> Vec<TrackId> {
        let mut tracker = Tracker::new(config);
        let mut update = Update::default();
        for frame in 0..12 {
            let tilt = if frame < 10 { 0.0 } else { 40.0 };
            update = step(&mut tracker, f64::from(frame) / 25.0, &crowd(tilt));
        }
        update.tracks.iter().filter(|t| t.matched).map(|t| t.id).collect()
    };
    let five: Vec<TrackId> = (1..=5).map(TrackId).collect();
    assert_eq!(matched_after(TrackerConfig::default()), five);
    let mut fixed = TrackerConfig::default();
    fixed.shift.enabled = false;
    assert_ne!(matched_after(fixed), five, "without it the jump is outside the gate");
}

#[test]
fn a_shift_that_the_picture_tells_moves_the_tracks_and_silences_the_boxes() {
    let predicted = |shift: Option<Shift>, enabled: bool| {
        let mut config = TrackerConfig::default();
        config.shift.enabled = enabled;
        let mut tracker = Tracker::new(config);
        let crowd: Vec<Detection> = (0..4).map(|i| person(100.0 + 90.0 * f64::from(i), 200.0)).collect();
        for frame in 0..10 {
            step(&mut tracker, f64::from(frame) / 25.0, &crowd);
        }
        // Boxes say 12 pixels to the right.
        let moved: Vec<Detection> =
            crowd.iter().map(|d| Detection::person(d.bbox.shifted(12.0, 0.0), 0.9)).collect();
        let time = MediaTime::from_secs(0.4);
        let (width, height) = SIZE;
        let frame = FrameInput { time, width, height, detections: &moved, embeddings: &[], shift };
        tracker.predict(frame, &mut LinkRequest::default());
        (tracker.predicted()[0].cx() - 100.0, tracker.predicted()[0].cy() - 200.0)
    };
    let near = |(x, y): (f64, f64), [dx, dy]: [f64; 2]| (x - dx).abs() < 1.0 && (y - dy).abs() < 1.0;
    let told = Some(Shift { by: [30.0, -10.0], variance: [0.1; 2] });
    assert!(near(predicted(told, true), [30.0, -10.0]), "{:?}", predicted(told, true));
    assert!(
        near(predicted(Some(Shift::default()), true), [0.0, 0.0]),
        "a camera that is seen to stand still"
    );
    assert!((predicted(None, true).0 - 12.0).abs() < 2.0, "the boxes are all there is");
    assert!(near(predicted(told, false), [0.0, 0.0]), "switched off");
}

#[test]
fn half_the_frames_give_the_same_tracks() {
    let run = |keep: usize| {
        let mut tracker = Tracker::new(TrackerConfig::default());
        let mut last = Update::default();
        for frame in (0..=100).step_by(keep) {
            let t = frame as f64;
            last = step(
                &mut tracker,
                t / 25.0,
                &[person(50.0 + 3.0 * t, 150.0), person(600.0 - 4.0 * t, 320.0)],
            );
        }
        last.tracks
    };
    let (all, half) = (run(1), run(2));
    for (a, b) in all.iter().zip(&half) {
        assert_eq!(a.id, b.id);
        assert!((a.bbox.cx() - b.bbox.cx()).abs() < 2.0 && (a.velocity[0] - b.velocity[0]).abs() < 5.0);
    }
    assert_eq!(all.len(), half.len());
}

#[test]
fn misuse_is_told() {
    let mut tracker = Tracker::new(TrackerConfig::default());
    assert_eq!(tracker.update(&[]), Err(TrackError::NoFrame));
    step(&mut tracker, 0.0, &[person(100.0, 100.0)]);
    let mut request = LinkRequest::default();
    let detections = [person(101.0, 100.0)];
    let frame = FrameInput {
        time: MediaTime::from_secs(0.04),
        width: SIZE.0,
        height: SIZE.1,
        detections: &detections,
        embeddings: &[],
        shift: None,
    };
    tracker.predict(frame, &mut request);
    assert_eq!(request.pairs.len(), 1);
    assert_eq!(tracker.update(&[]), Err(TrackError::ScoreCount { expected: 1, got: 0 }));
    assert!(tracker.update(&[f32::NAN]).is_ok(), "an answer that is no number is no link");
    assert_eq!(tracker.update(&[0.5]), Err(TrackError::NoFrame));
}

#[test]
fn ten_thousand_boxes_leave_bounded_state() {
    let mut config = TrackerConfig::default();
    config.life.max_tracks = 50;
    config.life.max_detections = 80;
    let mut tracker = Tracker::new(config);
    let boxes: Vec<Detection> = (0..10_000u32)
        .map(|i| {
            let (x, y) = (f64::from(i % 100) * 60.0, f64::from(i / 100) * 120.0);
            Detection::person(BBox::new(x, y, 40.0, 100.0), 0.6 + f64::from(i % 7) * 0.05)
        })
        .collect();
    for frame in 0..5 {
        let update = step(&mut tracker, f64::from(frame) / 25.0, &boxes);
        assert!(update.tracks.len() <= 50 && tracker.detections().len() <= 80);
    }
}

fn any_box() -> impl Strategy<Value = Detection> {
    let odd = prop_oneof![
        8 => -200.0f64..800.0,
        1 => prop_oneof![Just(f64::NAN), Just(f64::INFINITY), Just(f64::NEG_INFINITY), Just(0.0), Just(1e300)],
    ];
    (prop::array::uniform4(odd), 0.0f64..1.0)
        .prop_map(|([x, y, w, h], score)| Detection::person(BBox::new(x, y, w / 8.0, h / 4.0), score))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Ids are new, unique and end once; boxes are finite; nothing panics, whatever comes in.
    #[test]
    fn any_input_keeps_the_account_of_ids(
        frames in prop::collection::vec((prop::collection::vec(any_box(), 0..12), -0.1f64..1.0), 1..40)
    ) {
        let mut tracker = Tracker::new(TrackerConfig::default());
        let (mut alive, mut dead) = (BTreeSet::new(), BTreeSet::new());
        let mut time = 0.0;
        for (detections, dt) in frames {
            time += dt;
            let update = step(&mut tracker, time, &detections);
            for id in &update.ended {
                prop_assert!(alive.remove(id), "{id} ended without having lived");
                prop_assert!(dead.insert(*id));
            }
            let now: BTreeSet<TrackId> = update.tracks.iter().map(|t| t.id).collect();
            prop_assert_eq!(now.len(), update.tracks.len());
            prop_assert!(now.is_superset(&alive), "a track went without being told");
            prop_assert!(now.is_disjoint(&dead), "an id came back");
            prop_assert!(update.tracks.is_sorted_by_key(|t| t.id));
            for t in &update.tracks {
                prop_assert!(t.bbox.is_valid() && t.velocity.iter().all(|v| v.is_finite()), "{t:?}");
                prop_assert!((0.0..=1.0).contains(&t.link), "{t:?}");
            }
            alive = now;
        }
    }

    /// The order in which a detector lists its boxes does not matter.
    #[test]
    fn the_order_of_detections_does_not_matter(
        starts in prop::collection::vec((50.0f64..600.0, 80.0f64..400.0, -80.0f64..80.0), 1..8),
        rotate in 0usize..8,
    ) {
        let (mut a, mut b) = (Tracker::new(TrackerConfig::default()), Tracker::new(TrackerConfig::default()));
        for frame in 0..20 {
            let t = f64::from(frame) / 10.0;
            let crowd: Vec<Detection> = starts.iter().map(|(x, y, v)| person(x + v * t, *y)).collect();
            let mut turned = crowd.clone();
            turned.rotate_left(rotate % crowd.len());
            turned.reverse();
            let (a, b) = (step(&mut a, t, &crowd), step(&mut b, t, &turned));
            prop_assert_eq!(a, b);
        }
    }
}
