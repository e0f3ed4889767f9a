use super::*;
use crate::types::{BBox, CameraId, CaptureTime, Clock, Epoch, TrackReport};

const SIZE: (u32, u32) = (1000, 500);

/// A report at `t` seconds of tracks `(id, foot x, foot y, state, matched)`, each 100 px tall.
fn report(t: f64, tracks: &[(u64, f64, f64, TrackState, bool)], ended: &[u64]) -> FrameTracks {
    let tracks = tracks.iter().map(|&(id, x, y, state, matched)| TrackReport {
        id: TrackId(id),
        state,
        class: ClassId::PERSON,
        bbox: BBox::new(x - 20.0, y - 100.0, 40.0, 100.0),
        confidence: 0.9,
        link: 1.0,
        velocity: [0.0, 0.0],
        matched,
    });
    FrameTracks {
        camera: CameraId::new("gate").unwrap(),
        epoch: Epoch(1),
        seq: 0,
        frame: 0,
        time: MediaTime::from_secs(t),
        capture: CaptureTime { unix_ns: 0, clock: Clock::Media },
        width: SIZE.0,
        height: SIZE.1,
        tracks: tracks.collect(),
        ended: ended.iter().map(|id| TrackId(*id)).collect(),
    }
}

fn id(name: &str) -> RuleId {
    RuleId::new(name).unwrap()
}

fn points(points: &[(f64, f64)]) -> Vec<Point> {
    points.iter().map(|&(x, y)| Point { x, y }).collect()
}

/// A line upright in the middle, drawn from the bottom: who comes from the left goes in.
fn door() -> Line {
    Line { id: id("door"), points: points(&[(0.5, 1.0), (0.5, 0.0)]), anchor: Anchor::Foot }
}

/// The right half of the picture.
fn right() -> Zone {
    Zone {
        id: id("right"),
        points: points(&[(0.5, 0.0), (1.0, 0.0), (1.0, 1.0), (0.5, 1.0)]),
        anchor: Anchor::Foot,
        loiter: None,
        capacity: None,
    }
}

/// Walks track 1 along `xs`, a tenth of a second each.
fn walk(analyst: &mut Analyst, xs: &[(f64, TrackState, bool)]) -> Vec<What> {
    // It has been there for a while.
    let before = [xs[0]; 2];
    let steps = before.iter().chain(xs).enumerate().flat_map(|(step, &(x, state, matched))| {
        analyst.update(&report(0.1 * step as f64, &[(1, x, 300.0, state, matched)], &[]))
    });
    steps.map(|h| h.what).collect()
}

use TrackState::{Confirmed, Lost, Tentative};

#[test]
fn a_line_is_crossed_once_by_each_who_crosses_it() {
    let crossed = |direction| What::Crossed { line: id("door"), direction };
    for (what, path, expected) in [
        (
            "straight through",
            vec![(400.0, Confirmed, true), (480.0, Confirmed, true), (560.0, Confirmed, true)],
            vec![crossed(Direction::In)],
        ),
        (
            "and back",
            vec![(400.0, Confirmed, true), (560.0, Confirmed, true), (400.0, Confirmed, true)],
            vec![crossed(Direction::In), crossed(Direction::Out)],
        ),
        (
            "trembling on it",
            vec![
                (400.0, Confirmed, true),
                (499.0, Confirmed, true),
                (502.0, Confirmed, true),
                (498.0, Confirmed, true),
                (503.0, Confirmed, true),
                (440.0, Confirmed, true),
            ],
            vec![],
        ),
        (
            "before it was believed: counted from its birth on, once it is",
            vec![(470.0, Tentative, true), (520.0, Tentative, true), (540.0, Confirmed, true)],
            vec![crossed(Direction::In)],
        ),
        (
            "never believed",
            vec![(400.0, Tentative, true), (500.0, Tentative, true), (600.0, Tentative, true)],
            vec![],
        ),
        (
            "a prediction drifts over it and comes back",
            vec![(400.0, Confirmed, true), (560.0, Confirmed, false), (450.0, Confirmed, true)],
            vec![],
        ),
        (
            "covered while crossing",
            vec![(400.0, Confirmed, true), (500.0, Lost, false), (600.0, Confirmed, true)],
            vec![crossed(Direction::In)],
        ),
    ] {
        let mut analyst = Analyst::new(Rules { lines: vec![door()], ..Rules::default() });
        assert_eq!(walk(&mut analyst, &path), expected, "{what}");
        let LineCount { inwards, outwards } = analyst.counts().lines[&id("door")];
        let all = expected.len() as u64;
        assert_eq!(inwards + outwards, all, "{what}");
    }
}

#[test]
fn a_zone_knows_who_is_in_it_and_for_how_long() {
    let zone = Zone { loiter: Some(2.0), ..right() };
    let mut analyst = Analyst::new(Rules { zones: vec![zone], ..Rules::default() });
    let mut happened = vec![];
    // Comes at 0.5 s, is covered from 2 s to 3 s, goes at 4 s.
    for step in 0..=45 {
        let t = 0.1 * f64::from(step);
        let x = if (5..40).contains(&step) { 700.0 } else { 300.0 };
        let matched = !(20..30).contains(&step);
        let state = if matched { Confirmed } else { Lost };
        happened.extend(
            analyst
                .update(&report(t, &[(1, x, 300.0, state, matched)], &[]))
                .into_iter()
                .map(|h| (step, h.what)),
        );
    }
    let zone = id("right");
    let [
        (5, What::Entered { .. }),
        (32, What::Loitering { dwell: loitered, .. }),
        (40, What::Left { dwell, .. }),
    ] = &happened[..]
    else {
        panic!("{happened:?}")
    };
    assert!((loitered - 2.7).abs() < 1e-6 && (dwell - 3.4).abs() < 1e-6, "{happened:?}");
    let count = analyst.counts().zones[&zone];
    assert_eq!((count.occupancy, count.entries, count.exits), (0, 1, 1));
    assert!((count.dwell - 3.4).abs() < 1e-6);
}

#[test]
fn one_who_ends_in_a_zone_leaves_it() {
    let mut analyst = Analyst::new(Rules { zones: vec![right()], ..Rules::default() });
    for step in 0..=12 {
        analyst.update(&report(0.1 * f64::from(step), &[(7, 700.0, 300.0, Confirmed, true)], &[]));
    }
    assert_eq!(analyst.counts().zones[&id("right")].occupancy, 1);
    let happened = analyst.update(&report(3.0, &[], &[7]));
    let [Happening { what: What::Left { dwell, .. }, .. }] = &happened[..] else { panic!("{happened:?}") };
    // From the third match on, to the last.
    assert!((dwell - 1.0).abs() < 1e-6, "{dwell}");
    assert_eq!(analyst.counts().zones[&id("right")].occupancy, 0);
}

#[test]
fn one_match_after_a_gap_is_not_enough() {
    let mut analyst = Analyst::new(Rules { lines: vec![door()], ..Rules::default() });
    // Lost before the line; a false alarm behind it is taken for the track, then nothing.
    let mut path = vec![(400.0, Confirmed, true); 3];
    path.extend([(470.0, Lost, false); 6]);
    path.push((560.0, Confirmed, true));
    path.extend([(560.0, Lost, false); 6]);
    assert_eq!(walk(&mut analyst, &path), []);
    // A camera of two frames a second misses nobody for that.
    let mut slow = Analyst::new(Rules { lines: vec![door()], ..Rules::default() });
    for (step, x) in [400.0, 430.0, 460.0, 560.0].into_iter().enumerate() {
        slow.update(&report(0.5 * step as f64, &[(1, x, 300.0, Confirmed, true)], &[]));
    }
    assert_eq!(slow.counts().lines[&id("door")].inwards, 1);
}

#[test]
fn a_crowd_is_one_that_lasts() {
    let zone = Zone { capacity: Some(1), ..right() };
    let mut analyst = Analyst::new(Rules { zones: vec![zone], ..Rules::default() });
    let mut happened = vec![];
    for step in 0..60 {
        // Two for half a second, then one, then two from 2 s to 4 s.
        let two = step < 5 || (20..40).contains(&step);
        let mut tracks = vec![(1, 700.0, 300.0, Confirmed, true)];
        tracks.push((2, if two { 800.0 } else { 200.0 }, 300.0, Confirmed, true));
        let at = analyst.update(&report(0.1 * f64::from(step), &tracks, &[]));
        happened.extend(at.into_iter().filter(|h| h.track.is_none()).map(|h| (step, h.what)));
    }
    let zone = id("right");
    assert_eq!(
        happened,
        [
            (30, What::Crowded { zone: zone.clone(), occupancy: 2 }),
            (50, What::Cleared { zone, occupancy: 1 })
        ]
    );
}

#[test]
fn rules_change_while_they_are_watched() {
    let mut analyst = Analyst::new(Rules { lines: vec![door()], zones: vec![right()], ..Rules::default() });
    walk(&mut analyst, &[(400.0, Confirmed, true), (600.0, Confirmed, true)]);
    let other = Line { id: id("other"), points: points(&[(0.2, 1.0), (0.2, 0.0)]), anchor: Anchor::Centre };
    analyst.set_rules(Rules { lines: vec![other.clone(), door()], ..Rules::default() });
    assert_eq!(analyst.counts().lines[&id("door")].inwards, 1, "what stays keeps its counts");
    assert!(analyst.counts().zones.is_empty());
    let moved = Line { points: points(&[(0.7, 1.0), (0.7, 0.0)]), ..door() };
    analyst.set_rules(Rules { lines: vec![other, moved], ..Rules::default() });
    assert_eq!(analyst.counts().lines[&id("door")], LineCount::default(), "another line of that name");
    // It was drawn behind a track's back: being on its left is no crossing.
    assert_eq!(walk(&mut analyst, &[(600.0, Confirmed, true), (650.0, Confirmed, true)]), []);
}

#[test]
fn another_epoch_keeps_counts_and_forgets_tracks() {
    let mut analyst = Analyst::new(Rules { lines: vec![door()], zones: vec![right()], ..Rules::default() });
    walk(&mut analyst, &[(400.0, Confirmed, true), (600.0, Confirmed, true)]);
    analyst.begin_epoch();
    let counts = analyst.counts();
    assert_eq!((counts.lines[&id("door")].inwards, counts.zones[&id("right")].occupancy), (1, 0));
    // Another person has the same id on the other side of the line.
    assert_eq!(walk(&mut analyst, &[(400.0, Confirmed, true), (420.0, Confirmed, true)]), []);
}

#[test]
fn heat_is_seconds() {
    let mut analyst = Analyst::default();
    for step in 0..=10 {
        analyst.update(&report(
            0.1 * f64::from(step),
            &[(1, 500.0, 250.0, Confirmed, true), (2, 10.0, 10.0, Tentative, true)],
            &[],
        ));
    }
    // A hole of five seconds is one second of presence at most.
    analyst.update(&report(6.0, &[(1, 5000.0, 250.0, Confirmed, true)], &[]));
    let cells = analyst.heat().cells();
    assert!((cells[18 * HEAT_COLUMNS + 32] - 0.9).abs() < 1e-6, "from the third match on");
    assert!((cells[18 * HEAT_COLUMNS + 63] - 1.0).abs() < 1e-6, "beyond the edge");
    assert!((cells.iter().sum::<f64>() - 1.9).abs() < 1e-6);
}

fn window() -> Mask {
    let points = points(&[(0.0, 0.0), (0.2, 0.0), (0.2, 0.2)]);
    Mask { id: RuleId::new("window").unwrap(), points, style: MaskStyle::Fill }
}

#[test]
fn rules_that_cannot_be_watched_are_refused() {
    let line =
        |at: &[(f64, f64)]| Rules { lines: vec![Line { points: points(at), ..door() }], ..Rules::default() };
    let zone =
        |at: &[(f64, f64)]| Rules { zones: vec![Zone { points: points(at), ..right() }], ..Rules::default() };
    for (rules, expected) in [
        (line(&[(0.0, 0.0)]), "1 points"),
        (line(&[(0.0, 0.0), (1.1, 0.0)]), "point 1 of door is (1.1, 0)"),
        (line(&[(0.0, 0.0), (f64::NAN, 0.0)]), "point 1"),
        (line(&[(0.5, 0.5), (0.505, 0.5)]), "too small"),
        (zone(&[(0.0, 0.0), (1.0, 1.0)]), "2 points"),
        (zone(&[(0.0, 0.0), (1.0, 1.0), (0.5, 0.5)]), "too small"),
        (Rules { lines: vec![door(), door()], ..Rules::default() }, "two lines are named door"),
        (Rules { masks: vec![window(), window()], ..Rules::default() }, "two masks are named window"),
        (
            Rules { masks: vec![Mask { points: points(&[(0.0, 0.0)]), ..window() }], ..Rules::default() },
            "1 points",
        ),
        (Rules { zones: vec![Zone { loiter: Some(0.0), ..right() }], ..Rules::default() }, "loiter_s"),
    ] {
        let error = rules.check().unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    assert!(Rules { lines: vec![door()], zones: vec![right()], masks: vec![window()] }.check().is_ok());
}
