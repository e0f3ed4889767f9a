//! Each association of the paper on small scenes: whom it follows, and what it needs for that.

use gakp::track::features::relative;
use gakp::track::{Association, FrameInput, LinkRequest, TrackError, Tracker, TrackerConfig, Update};
use gakp::types::{BBox, Detection, Embedding, MediaTime, TrackId};

const FPS: f64 = 25.0;

fn config(method: Association) -> TrackerConfig {
    let mut config = TrackerConfig::default();
    config.association.method = method;
    // One thing at a time: nobody here is a crowd, and nothing is doubtful.
    config.shift.enabled = false;
    config
}

fn person(cx: f64, cy: f64) -> Detection {
    Detection::person(BBox::from_center(cx, cy, 40.0, 100.0), 1.0)
}

/// A scorer of geometry: overlap with the prediction (feature 14) and Mahalanobis distance (15).
fn geometry(request: &LinkRequest) -> Vec<f32> {
    let pair = |f: &[f32]| 0.5 * f[14] + 0.5 * (-(f[15] * 5.0).powi(2) / 4.0).exp();
    request.candidates.chunks(relative::CANDIDATE).map(pair).collect()
}

/// Tracks `frames` of detections with embeddings; the update of every frame.
fn track(config: TrackerConfig, frames: &[Vec<(Detection, Option<Embedding>)>]) -> Vec<Update> {
    let mut tracker = Tracker::new(config.clone());
    let mut request = LinkRequest::default();
    let asks = config.association.method.asks_scorer();
    let step = |(index, frame): (usize, &Vec<(Detection, Option<Embedding>)>)| {
        let (detections, embeddings): (Vec<_>, Vec<_>) = frame.iter().cloned().unzip();
        let frame = FrameInput {
            time: MediaTime::from_secs(index as f64 / FPS),
            width: 1280.0,
            height: 720.0,
            detections: &detections,
            embeddings: &embeddings,
            shift: None,
        };
        tracker.predict(frame, &mut request);
        assert!(asks || request.is_empty(), "nobody is asked");
        assert!(!asks || request.pairs.len() == tracker.pairs().len());
        let links = geometry(&request);
        tracker.update(&links).expect("tracked")
    };
    frames.iter().enumerate().map(step).collect()
}

fn plain(frames: Vec<Vec<Detection>>) -> Vec<Vec<(Detection, Option<Embedding>)>> {
    frames.into_iter().map(|frame| frame.into_iter().map(|d| (d, None)).collect()).collect()
}

/// Ids of the tracks that were matched in the last frame.
fn last_ids(updates: &[Update]) -> Vec<u64> {
    let last = updates.last().expect("a frame");
    last.tracks.iter().filter(|t| t.matched).map(|t| t.id.0).collect()
}

#[test]
fn names_are_settings() {
    for method in Association::ALL {
        assert_eq!(method.as_str().parse(), Ok(method));
    }
    let message = "IOU".parse::<Association>().expect_err("refused").to_string();
    assert!(message.contains("\"IOU\" is no association: use iou, iou-motion, deep"), "{message}");
    assert_eq!(TrackerConfig::default().association.method, Association::Implicit);
}

#[test]
fn everyone_follows_two_walkers() {
    let frames = || {
        plain(
            (0..40)
                .map(|i| {
                    let t = f64::from(i);
                    vec![person(200.0 + 3.0 * t, 200.0), person(900.0 - 3.0 * t, 400.0)]
                })
                .collect(),
        )
    };
    for method in Association::ALL {
        let updates = track(config(method), &frames());
        assert_eq!(last_ids(&updates), [1, 2], "{method}");
        assert!(updates.iter().all(|u| u.ended.is_empty()), "{method}");
        let links = updates.iter().flat_map(|u| &u.tracks).map(|t| t.link);
        assert!(links.clone().all(|link| (0.0..=1.0).contains(&link)), "{method}");
    }
}

/// Whoever starts to run, at 1.5 heights a second each second as a person does, leaves the last box behind
/// from frame to frame; the filter follows.
#[test]
fn motion_follows_whom_the_last_box_loses() {
    let mut x = 100.0;
    let frames: Vec<Vec<Detection>> = (0..60)
        .map(|i| {
            x += (0.24 * f64::from(i)).min(14.0);
            vec![person(x, 300.0)]
        })
        .collect();
    for method in Association::ALL {
        let ids = last_ids(&track(config(method), &plain(frames.clone())));
        // 14 pixels a frame of a box 40 wide: IoU 0.48 with the last box.
        assert_eq!(ids == [1], method.uses_motion(), "{method}: {ids:?}");
    }
}

/// Two people meet, stop, and part the way they came: position says that they passed each other.
#[test]
fn appearance_tells_apart_whom_boxes_confuse() {
    let looks = |a: f32| Embedding::normalised(vec![a.cos(), a.sin()]);
    let frames: Vec<Vec<(Detection, Option<Embedding>)>> = (0..60)
        .map(|i| {
            // They slow down, touch in frame 30, and turn around.
            let away = (f64::from(i) - 30.0).powi(2) / 8.0;
            vec![(person(600.0 - away, 300.0), looks(0.0)), (person(603.0 + away, 304.0), looks(1.4))]
        })
        .collect();
    let bounced = |method| {
        let updates = track(config(method), &frames);
        let at = |update: &Update, id| {
            update.tracks.iter().find(|t| t.id == TrackId(id)).map(|t| t.bbox.cx() < 600.0)
        };
        let (first, last) = (&updates[10], &updates[59]);
        [1, 2].map(|id| at(first, id) == at(last, id))
    };
    for method in [Association::Deep, Association::Huang] {
        assert!(method.needs_appearance());
        assert_eq!(bounced(method), [true, true], "{method}");
    }
    // The link probability is moved by appearance where a weight says so.
    let mut implicit = config(Association::Implicit);
    implicit.appearance.weight = 12.0;
    implicit.appearance.pivot = 0.6;
    for method in [Association::Implicit, Association::ExplicitFixed] {
        implicit.association.method = method;
        let updates = track(implicit.clone(), &frames);
        assert_eq!(last_ids(&updates), [1, 2], "{method}");
    }
}

#[test]
fn overlap_of_less_than_half_ends_a_track_by_iou() {
    // A jump of 15 pixels leaves IoU 0.45, one of 10 leaves 0.6.
    for (jump, followed) in [(10.0, true), (15.0, false)] {
        let mut frames: Vec<Vec<Detection>> = (0..10).map(|_| vec![person(300.0, 300.0)]).collect();
        frames.push(vec![person(300.0 + jump, 300.0)]);
        let ids = last_ids(&track(config(Association::Iou), &plain(frames)));
        assert_eq!(ids == [1], followed, "a jump of {jump}");
    }
}

#[test]
fn scores_that_nobody_asked_for_are_refused() {
    let mut tracker = Tracker::new(config(Association::IouMotion));
    let mut request = LinkRequest::default();
    let detections = [person(300.0, 300.0)];
    for frame in 0..2 {
        let frame = FrameInput {
            time: MediaTime::from_secs(f64::from(frame) / FPS),
            width: 640.0,
            height: 480.0,
            detections: &detections,
            embeddings: &[],
            shift: None,
        };
        tracker.predict(frame, &mut request);
        if tracker.pairs().is_empty() {
            tracker.update(&[]).expect("tracked");
        }
    }
    assert_eq!((tracker.pairs().len(), request.pairs.len()), (1, 0));
    assert_eq!(tracker.update(&[0.5]), Err(TrackError::ScoreCount { expected: 0, got: 1 }));
    assert_eq!(tracker.update(&[]).expect("tracked").tracks[0].id, TrackId(1));
}
