use proptest::prelude::*;

use super::*;
use crate::types::{CameraId, CaptureTime, ClassId, Clock, TrackReport};

fn canvas(width: usize, height: usize) -> Rgb {
    Rgb { width, height, data: vec![0; width * height * 3] }
}

fn track(id: u64, state: TrackState, bbox: BBox) -> TrackReport {
    TrackReport {
        id: TrackId(id),
        state,
        class: ClassId::PERSON,
        bbox,
        confidence: 0.9,
        link: 0.9,
        velocity: [0.0; 2],
        matched: true,
    }
}

fn frame(seconds: f64, tracks: Vec<TrackReport>) -> FrameTracks {
    FrameTracks {
        camera: CameraId::new("a").unwrap(),
        epoch: Epoch(1),
        seq: 0,
        frame: 0,
        time: MediaTime::from_secs(seconds),
        capture: CaptureTime { unix_ns: 0, clock: Clock::Media },
        width: 200,
        height: 100,
        tracks,
        ended: Vec::new(),
    }
}

/// Boxes are scaled to the canvas and their edges are where they belong, inside untouched.
#[test]
fn a_confirmed_box_is_a_solid_outline() {
    for size in [200, 400] {
        let k = size / 200;
        let mut canvas = canvas(size, size / 2);
        let bbox = BBox::new(40.0, 20.0, 30.0, 60.0);
        annotate(&mut canvas, &frame(0.0, vec![track(7, TrackState::Confirmed, bbox)]), &Trails::default());
        let colour = colour(TrackId(7));
        for x in 40 * k..70 * k {
            assert_eq!(canvas.pixel(x, 20 * k), colour, "upper edge at {x}");
            assert_eq!(canvas.pixel(x, 80 * k - 1), colour, "lower edge at {x}");
        }
        for y in 20 * k..80 * k {
            assert_eq!(canvas.pixel(40 * k, y), colour, "left edge at {y}");
            assert_eq!(canvas.pixel(70 * k - 1, y), colour, "right edge at {y}");
        }
        assert_eq!(canvas.pixel(55 * k, 50 * k), [0; 3]);
        assert_eq!(canvas.pixel(75 * k, 50 * k), [0; 3]);
    }
}

#[test]
fn a_lost_box_is_dashed_and_a_plate_shows_the_id() {
    let mut canvas = canvas(200, 100);
    let bbox = BBox::new(40.0, 20.0, 64.0, 64.0);
    annotate(&mut canvas, &frame(0.0, vec![track(1, TrackState::Lost, bbox)]), &Trails::default());
    let drawn = (40..104).filter(|x| canvas.pixel(*x, 83) != [0; 3]).count();
    assert_eq!(drawn, 32, "half of the lower edge");
    // The digit 1 on its plate: its upright is black, what is beside it has the track's colour.
    let (x, y) = (40 + 1, 20 - 9 + 1);
    assert_eq!(canvas.pixel(x + 2, y + 3), [0; 3]);
    assert_eq!(canvas.pixel(x + 3, y + 3), colour(TrackId(1)));
}

#[test]
fn trails_follow_for_two_seconds_and_go_with_their_track() {
    let mut trails = Trails::default();
    for step in 0..100 {
        let seconds = f64::from(step) * 0.1;
        let bbox = BBox::new(f64::from(step), 10.0, 10.0, 50.0);
        trails.push(&frame(seconds, vec![track(1, TrackState::Confirmed, bbox)]));
        assert!(trails.points[&TrackId(1)].len() <= 21, "2 s at 10 frames/s");
    }
    let mut canvas = canvas(200, 100);
    let bbox = BBox::new(99.0, 10.0, 10.0, 50.0);
    annotate(&mut canvas, &frame(9.9, vec![track(1, TrackState::Confirmed, bbox)]), &trails);
    assert_eq!(canvas.pixel(90, 60), colour(TrackId(1)), "1.4 s ago it stood here");
    assert_eq!(canvas.pixel(70, 60), [0; 3], "3 s ago is forgotten");
    trails.push(&frame(10.0, vec![]));
    assert!(trails.points.is_empty());
}

#[test]
fn colours_are_css_colours() {
    // hsl(137.508 90% 60%) and hsl(0 90% 60%) as browsers compute them.
    assert_eq!(hsl(0.0, 0.9, 0.6), [245, 61, 61]);
    assert_eq!(hsl(120.0, 0.9, 0.6), [61, 245, 61]);
    assert_eq!(colour(TrackId(1)), hsl(137.508, 0.9, 0.6));
}

proptest! {
    /// Any box on any canvas: no panic, no write outside (which would panic), bounded time.
    #[test]
    fn any_box_can_be_drawn(
        width in 1..50usize, height in 1..50usize, id: u64, state in 0..3usize,
        x in prop::num::f64::ANY, y in prop::num::f64::ANY, w in prop::num::f64::ANY, h in prop::num::f64::ANY,
    ) {
        let mut canvas = canvas(width, height);
        let mut trails = Trails::default();
        for bbox in [BBox::new(x, y, w, h), BBox::new(x % 100.0, y % 100.0, w % 300.0, h % 300.0)] {
            let frame = frame(0.0, vec![track(id, TrackState::ALL[state], bbox)]);
            trails.push(&frame);
            annotate(&mut canvas, &frame, &trails);
        }
    }
}
