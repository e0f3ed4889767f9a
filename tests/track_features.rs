//! What a link scorer is shown of embeddings and of the place in the picture, by numbers worked out by hand.

use gakp::track::features::{appearance, literal, relative};
use gakp::track::{Features, FrameInput, HISTORY, LinkRequest, Tracker, TrackerConfig};
use gakp::types::{BBox, Detection, Embedding, MediaTime};

const PICTURE: (f64, f64) = (800.0, 400.0);

fn look(values: &[f32]) -> Option<Embedding> {
    Embedding::normalised(values.to_vec())
}

/// The request of the last of `frames`, each a box's centre and its look, half a second apart.
fn request(features: Features, frames: &[((f64, f64), Option<Embedding>)]) -> LinkRequest {
    let mut config = TrackerConfig::default();
    config.association.features = features;
    config.shift.enabled = false;
    let (mut tracker, mut request) = (Tracker::new(config), LinkRequest::default());
    for (index, ((cx, cy), embedding)) in frames.iter().enumerate() {
        let detections = [Detection::person(BBox::from_center(*cx, *cy, 40.0, 100.0), 0.9)];
        let frame = FrameInput {
            time: MediaTime::from_secs(0.5 * index as f64),
            width: PICTURE.0,
            height: PICTURE.1,
            detections: &detections,
            embeddings: std::slice::from_ref(embedding),
            shift: None,
        };
        tracker.predict(frame, &mut request);
        tracker.update(&vec![1.0; request.pairs.len()]).expect("a probability for each pair");
    }
    assert_eq!(request.features, features);
    assert_eq!(request.pairs.len(), 1, "one person, one box");
    assert_eq!(request.histories.len(), HISTORY * features.step());
    assert_eq!(request.candidates.len(), features.candidate());
    request
}

fn close(found: &[f32], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert!((f64::from(*found) - expected).abs() < 1e-5, "{found} is not {expected}: {expected:?}");
    }
}

#[test]
fn literal_rows_are_the_embedding_the_box_and_its_displacement() {
    let features = Features::Literal { embedding: 3 };
    let frames = [
        ((400.0, 200.0), look(&[3.0, 0.0, 4.0])),
        ((408.0, 196.0), None),
        // Of another width: not one of these.
        ((410.0, 196.0), look(&[1.0, 0.0])),
        ((420.0, 200.0), look(&[0.0, 2.0, 0.0])),
    ];
    let found = request(features, &frames);
    let width = features.step();
    assert_eq!(width, 3 + literal::SPATIAL);
    assert_eq!(found.lengths, [3]);
    let (w, h) = (40.0 / 800.0, 100.0 / 400.0);
    close(&found.histories[..width], &[0.6, 0.0, 0.8, 0.5, 0.5, w, h, 0.0, 0.0]);
    // 8 and -4 pixels in half a second.
    close(&found.histories[width..2 * width], &[0.0, 0.0, 0.0, 0.51, 0.49, w, h, 0.02, -0.02]);
    close(&found.histories[2 * width..3 * width], &[0.0, 0.0, 0.0, 0.5125, 0.49, w, h, 0.005, 0.0]);
    assert!(found.histories[3 * width..].iter().all(|v| *v == 0.0), "masked");
    close(&found.candidates, &[0.0, 1.0, 0.0, 0.525, 0.5, w, h, 0.025, 0.02]);
    let spatial = request(Features::Literal { embedding: 0 }, &frames);
    close(&spatial.candidates, &[0.525, 0.5, w, h, 0.025, 0.02]);
}

#[test]
fn likeness_is_that_to_the_mean_the_last_and_the_likest_look() {
    let at = (400.0, 200.0);
    let (a, b) = (look(&[1.0, 0.0]), look(&[0.0, 1.0]));
    let seen = |frames: &[Option<Embedding>]| {
        let frames: Vec<_> = frames.iter().map(|look| (at, look.clone())).collect();
        let found = request(Features::Appearance { embedding: 2 }, &frames);
        let boxes = request(Features::Relative, &frames);
        assert_eq!(found.candidates[..relative::CANDIDATE], boxes.candidates, "the boxes say the same");
        assert_eq!(found.histories, boxes.histories);
        found.candidates[appearance::MEAN_COSINE..].to_vec()
    };
    // The mean has moved by a tenth from a to b: (0.9, 0.1), of length 0.9055.
    close(&seen(&[a.clone(), b.clone(), a.clone()]), &[0.9 / 0.9055385, 0.0, 1.0, 1.0]);
    close(&seen(&[a.clone(), b.clone(), None, b.clone()]), &[0.1 / 0.9055385, 1.0, 1.0, 1.0]);
    close(&seen(&[a.clone(), a.clone(), None]), &[0.0, 0.0, 0.0, 0.0]);
    close(&seen(&[None, None, a]), &[0.0, 0.0, 0.0, 0.0]);
}

#[test]
fn a_scorer_that_has_seen_the_looks_has_the_last_word_on_them() {
    let link = |features: Features| {
        let mut config = TrackerConfig::default();
        config.association.features = features;
        config.appearance.weight = 50.0;
        let (mut tracker, mut request) = (Tracker::new(config), LinkRequest::default());
        let detections = [Detection::person(BBox::from_center(400.0, 200.0, 40.0, 100.0), 0.9)];
        for (frame, embedding) in [look(&[1.0, 0.0]), look(&[0.0, 1.0])].iter().enumerate() {
            let (time, embeddings) =
                (MediaTime::from_secs(frame as f64 / 25.0), std::slice::from_ref(embedding));
            let (width, height) = PICTURE;
            let frame = FrameInput { time, width, height, detections: &detections, embeddings, shift: None };
            tracker.predict(frame, &mut request);
            tracker.update(&vec![0.9; request.pairs.len()]).expect("a probability for each pair");
        }
        let ids: Vec<u64> = tracker.tracks().iter().map(|track| track.id.0).collect();
        ids
    };
    assert_eq!(link(Features::Relative), [2], "nobody looks like that: somebody else");
    assert_eq!(link(Features::Appearance { embedding: 2 }), [1], "the scorer says it is the same");
}
