//! The same input and settings give the same tracks: run after run, for any number of threads of the link
//! scorer, and however requests of several cameras are joined into batches.
#![cfg(feature = "service")]

mod infer_support;

use std::sync::Arc;
use std::thread;

use gakp::infer::{InferError, Linker, ModelSettings};
use gakp::mot::{Row, Sequence, SequenceInfo, replay};
use gakp::track::{LinkRequest, Pair, TrackerConfig};
use gakp::types::{BBox, Detection};

const FRAMES: u32 = 150;

/// Thirty people who walk straight across one another; now and then one is missed, now and then there is a
/// false alarm.
fn crowd(seed: u64) -> Sequence {
    let mut rng = fastrand::Rng::with_seed(seed);
    let mut walkers: Vec<[f64; 5]> = (0..30)
        .map(|_| {
            let height = 60.0 + 80.0 * rng.f64();
            let angle = rng.f64() * std::f64::consts::TAU;
            let step = height * 0.8 / 25.0;
            [rng.f64() * 1280.0, rng.f64() * 720.0, height, angle.cos() * step, angle.sin() * step]
        })
        .collect();
    let frame = |_| {
        let mut seen = vec![];
        for [x, y, height, vx, vy] in &mut walkers {
            (*x, *y) = (*x + *vx, *y + *vy);
            for (at, v, end) in [(&mut *x, vx, 1280.0), (&mut *y, vy, 720.0)] {
                if !(0.0..=end).contains(at) {
                    *v = -*v;
                }
            }
            if rng.f64() > 0.1 {
                let mut noise = || (rng.f64() - 0.5) * 0.1 * *height;
                let (cx, cy, h) = (*x + noise(), *y + noise(), *height + noise());
                seen.push(Detection::person(BBox::from_center(cx, cy, 0.4 * h, h), 0.6 + 0.4 * rng.f64()));
            }
        }
        if rng.f64() < 0.3 {
            seen.push(Detection::person(BBox::new(rng.f64() * 1200.0, rng.f64() * 600.0, 40.0, 100.0), 0.7));
        }
        seen
    };
    let info =
        SequenceInfo { name: "crowd".into(), frame_rate: 25.0, length: FRAMES, width: 1280, height: 720 };
    Sequence { detections: (0..FRAMES).map(frame).collect(), info }
}

fn linker(models: &std::path::Path, threads: usize) -> Linker {
    let link = ModelSettings::default().link;
    let settings = ModelSettings { link, threads: Some(threads), ..infer_support::settings(models) };
    Linker::load(&settings, Arc::new(())).expect("the link scorer")
}

fn track(linker: &Linker, sequence: &Sequence) -> Vec<Row> {
    let config = linker.calibrate(TrackerConfig::default());
    replay(sequence, &config, |_| vec![], |r| linker.score_blocking(r.clone())).expect("tracks")
}

/// Tracks with every request in a batch behind `copies` of the request before it.
fn track_in_batches(linker: &Linker, sequence: &Sequence, copies: usize) -> Vec<Row> {
    let config = linker.calibrate(TrackerConfig::default());
    let mut before = LinkRequest::default();
    let score = |request: &LinkRequest| {
        let mut batch = LinkRequest::default();
        for part in std::iter::repeat_n(&before, copies).chain([request]) {
            let first = batch.tracks() as u32;
            batch.histories.extend(&part.histories);
            batch.lengths.extend(&part.lengths);
            batch.candidates.extend(&part.candidates);
            batch.pairs.extend(part.pairs.iter().map(|p| Pair { track: first + p.track, ..*p }));
        }
        before = request.clone();
        let all = linker.score_blocking(batch)?;
        Ok::<_, InferError>(all[all.len() - request.pairs.len()..].to_vec())
    };
    replay(sequence, &config, |_| vec![], score).expect("tracks")
}

/// The same ids in the same places, to a hundredth of a pixel.
fn same(a: &[Row], b: &[Row], what: &str) {
    let key = |rows: &[Row]| rows.iter().map(|r| (r.frame, r.id)).collect::<Vec<_>>();
    assert_eq!(key(a), key(b), "{what}: other ids");
    for (a, b) in a.iter().zip(b) {
        let [p, q] = [a.bbox, b.bbox].map(|b| [b.x, b.y, b.w, b.h]);
        let far = p.iter().zip(q).any(|(p, q)| (p - q).abs() > 0.01);
        assert!(!far, "{what}: frame {}, id {}: {:?} and {:?}", a.frame, a.id, a.bbox, b.bbox);
    }
}

#[test]
fn tracks_depend_on_neither_threads_nor_batches() {
    let Some(models) = infer_support::models() else { return };
    let crowds: Vec<Sequence> = (1..=6).map(crowd).collect();
    let one = linker(&models, 1);
    let alone: Vec<Vec<Row>> = crowds.iter().map(|c| track(&one, c)).collect();
    assert!(alone.iter().all(|rows| rows.len() > 1000), "people are tracked");
    for (rows, crowd) in alone.iter().zip(&crowds) {
        assert_eq!(rows, &track(&one, crowd), "run after run the very same");
        for copies in [1, 3, 10] {
            same(rows, &track_in_batches(&one, crowd, copies), &format!("batches of {}", copies + 1));
        }
    }
    // Eight threads are two workers of the link scorer; the cameras' requests race for them.
    for threads in [2, 8] {
        let shared = linker(&models, threads);
        let together: Vec<Vec<Row>> = thread::scope(|scope| {
            let runs: Vec<_> = crowds.iter().map(|c| scope.spawn(|| track(&shared, c))).collect();
            runs.into_iter().map(|run| run.join().expect("a camera")).collect()
        });
        for (camera, (alone, together)) in alone.iter().zip(&together).enumerate() {
            same(alone, together, &format!("{threads} threads, camera {camera}"));
        }
    }
}
