//! Counts held against worlds whose crossings are known.
#![cfg(feature = "cli")]

use std::collections::BTreeSet;

use gakp::analytics::{Analyst, Anchor, Line, Point, RuleId, Rules, Zone};
use gakp::simulate::simulate;
use gakp::track::{Association, FrameInput, LinkRequest, Tracker, TrackerConfig};
use gakp::types::{
    BBox, CameraId, CaptureTime, ClassId, Clock, Detection, Epoch, FrameTracks, MediaTime, TrackId,
    TrackReport, TrackState,
};

fn upright(id: &str, x: f64) -> Line {
    let points = vec![Point { x, y: 1.0 }, Point { x, y: 0.0 }];
    Line { id: RuleId::new(id).unwrap(), points, anchor: Anchor::Foot }
}

/// Frames of tracks to an analyst.
struct Counter {
    analyst: Analyst,
    size: (u32, u32),
    known: BTreeSet<TrackId>,
}

impl Counter {
    fn new(rules: Rules, size: (u32, u32)) -> Self {
        Self { analyst: Analyst::new(rules), size, known: BTreeSet::new() }
    }

    fn take(&mut self, time: MediaTime, tracks: Vec<TrackReport>, ended: Vec<TrackId>) {
        self.analyst.update(&FrameTracks {
            camera: CameraId::new("world").unwrap(),
            epoch: Epoch(1),
            seq: 0,
            frame: 0,
            time,
            capture: CaptureTime { unix_ns: 0, clock: Clock::Media },
            width: self.size.0,
            height: self.size.1,
            tracks,
            ended,
        });
    }

    /// People as a tracker without fault would have them.
    fn take_truth(&mut self, time: MediaTime, people: &[(u64, BBox)]) {
        let tracks = people.iter().map(|&(id, bbox)| TrackReport {
            id: TrackId(id),
            state: TrackState::Confirmed,
            class: ClassId::PERSON,
            bbox,
            confidence: 1.0,
            link: 1.0,
            velocity: [0.0; 2],
            matched: true,
        });
        let now = people.iter().map(|(id, _)| TrackId(*id)).collect();
        let ended = self.known.difference(&now).copied().collect();
        self.known = now;
        self.take(time, tracks.collect(), ended);
    }

    /// In and out, line by line.
    fn crossings(&self) -> Vec<(u64, u64)> {
        self.analyst.counts().lines.values().map(|c| (c.inwards, c.outwards)).collect()
    }
}

/// The tracker with the IOU + motion association: no model needed.
struct Tracked {
    tracker: Tracker,
    counter: Counter,
}

impl Tracked {
    fn new(counter: Counter) -> Self {
        let mut config = TrackerConfig::default();
        config.association.method = Association::IouMotion;
        Self { tracker: Tracker::new(config), counter }
    }

    fn take(&mut self, time: MediaTime, boxes: impl Iterator<Item = (BBox, f64)>) {
        let detections: Vec<Detection> =
            boxes.map(|(bbox, score)| Detection { bbox, score, class: ClassId::PERSON }).collect();
        let (width, height) = self.counter.size;
        let input = FrameInput {
            time,
            width: width.into(),
            height: height.into(),
            detections: &detections,
            embeddings: &[],
            shift: None,
        };
        self.tracker.predict(input, &mut LinkRequest::default());
        let update = self.tracker.update(&[]).unwrap();
        self.counter.take(time, update.tracks, update.ended);
    }
}

/// One who walks through a door 1280 pixels wide, or comes near it and turns back.
struct Visitor {
    enters: f64,
    /// Pixels a second; negative from the right to the left.
    speed: f64,
    foot: f64,
    height: f64,
    /// Where it turns, if it does.
    turns_at: Option<f64>,
}

impl Visitor {
    fn new(rng: &mut fastrand::Rng, enters: f64, lane: usize) -> Self {
        let speed = (90.0 + 90.0 * rng.f64()) * if rng.bool() { 1.0 } else { -1.0 };
        let height = 150.0 + 20.0 * rng.f64();
        // In the middle is the door; one of five thinks better of it, a third of a height before.
        let turns_at = (rng.f64() < 0.2).then_some(640.0 - speed.signum() * (60.0 + 200.0 * rng.f64()));
        Self { enters, speed, foot: 210.0 + 160.0 * lane as f64, height, turns_at }
    }

    /// Its box at `t`; `None` before it comes and after it has gone.
    fn at(&self, t: f64) -> Option<BBox> {
        let gone = (t - self.enters) * self.speed.abs();
        let start = if self.speed > 0.0 { -40.0 } else { 1320.0 };
        let to_turn = self.turns_at.map_or(f64::INFINITY, |x| (x - start).abs());
        let distance = if gone <= to_turn { gone } else { 2.0 * to_turn - gone };
        let x = start + self.speed.signum() * distance;
        let inside = t >= self.enters && (-40.0..=1320.0).contains(&x);
        inside.then(|| BBox::new(x - 30.0, self.foot - self.height, 60.0, self.height))
    }
}

/// Three lanes that do not hide each other, people at random times and speeds both ways, some of whom turn back;
/// a detector that misses one of ten, errs by 2 % of the height and sees ghosts. Crossings are known, and every
/// one is counted, once.
#[test]
fn crossings_of_a_known_world_are_counted_exactly() {
    let mut all = 0;
    for seed in 0..20 {
        let mut rng = fastrand::Rng::with_seed(seed);
        let mut visitors = vec![];
        for lane in 0..3 {
            let mut t = 0.5;
            for _ in 0..15 {
                visitors.push(Visitor::new(&mut rng, t, lane));
                // Who follows has the lane to itself.
                t += 16.0 + 4.0 * rng.f64();
            }
        }
        let passing = |v: &&Visitor| v.turns_at.is_none();
        let inwards = visitors.iter().filter(passing).filter(|v| v.speed > 0.0).count() as u64;
        let outwards = visitors.iter().filter(passing).filter(|v| v.speed < 0.0).count() as u64;
        let size = (1280, 720);
        let rules = Rules { lines: vec![upright("door", 0.5)], zones: vec![], ..Rules::default() };
        let mut tracked = Tracked::new(Counter::new(rules, size));
        for frame in 0..25 * 330 {
            let t = f64::from(frame) / 25.0;
            let mut boxes = vec![];
            for b in visitors.iter().filter_map(|v| v.at(t)) {
                // Rounded sums of uniforms are near enough to normal.
                let mut error = || 0.02 * b.h * ((0..12).map(|_| rng.f64()).sum::<f64>() - 6.0);
                let b = BBox::new(b.x + error(), b.y + error(), b.w + error(), b.h + error());
                if rng.f64() > 0.1 {
                    boxes.push((b, 0.9));
                }
            }
            if rng.f64() < 0.2 {
                let (x, y) = (1200.0 * rng.f64(), 500.0 * rng.f64());
                boxes.push((BBox::new(x, y, 60.0, 150.0), 0.7));
            }
            tracked.take(MediaTime::from_secs(t), boxes.into_iter());
        }
        assert_eq!(tracked.counter.crossings(), [(inwards, outwards)], "world {seed}");
        all += inwards + outwards;
    }
    println!("{all} crossings counted, none too many");
}

/// The hard worlds of `gakp simulate`: crowds that hide each other, cameras that pan and shake, detectors
/// that miss up to half of the people. Printed beside the truth; the sum must stay near it.
#[test]
fn crossings_of_crowds_are_counted_nearly() {
    let rules = Rules {
        lines: vec![upright("left", 0.3), upright("middle", 0.5), upright("right", 0.7)],
        zones: vec![Zone {
            id: RuleId::new("all").unwrap(),
            points: [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Point { x, y }).to_vec(),
            anchor: Anchor::Foot,
            loiter: None,
            capacity: None,
        }],
        ..Rules::default()
    };
    let (mut known, mut counted, mut wrong) = (0, 0, 0);
    for seed in 0..20 {
        let world = simulate("world", 40.0, seed);
        let size = (world.info.width, world.info.height);
        let mut truth = Counter::new(rules.clone(), size);
        let mut tracked = Tracked::new(Counter::new(rules.clone(), size));
        for frame in 1..=world.info.length {
            let time = MediaTime::from_secs(f64::from(frame) / world.info.frame_rate);
            let people = world.truth.iter().filter(|row| row.frame == frame);
            truth.take_truth(time, &people.map(|row| (row.id as u64, row.bbox)).collect::<Vec<_>>());
            let seen = world.detections.iter().filter(|row| row.frame == frame);
            tracked.take(time, seen.map(|row| (row.bbox, row.conf)));
        }
        let (truth, ours) = (truth.crossings(), tracked.counter.crossings());
        println!("world {seed}: in/out of three lines {truth:?}, counted {ours:?}");
        for ((a, b), (c, d)) in truth.into_iter().zip(ours) {
            known += a + b;
            counted += c + d;
            wrong += a.abs_diff(c) + b.abs_diff(d);
        }
    }
    println!("{known} crossings, {counted} counted; differences line by line and way by way: {wrong}");
    assert!(known > 1000 && wrong * 100 < known * 15, "{wrong} of {known}");
}
