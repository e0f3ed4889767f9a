//! What each fuzz target does with its bytes. The targets themselves (`fuzz_targets/`) hand them over from libFuzzer;
//! `tests/fuzz.rs` of the crate does it for a while with every compiler.

mod api;
pub mod seeds;

use std::collections::BTreeSet;
use std::path::Path;

use arbitrary::{Arbitrary, Unstructured};
use gakp::config::Config;
use gakp::infer::Manifest;
use gakp::ingest::SourceUrl;
use gakp::mot;
use gakp::track::{Association, FrameInput, LinkRequest, Tracker, TrackerConfig, shift::Shift};
use gakp::types::{BBox, ClassId, Detection, Embedding, MediaTime};

/// A target: its name and what it does.
pub type Target = (&'static str, fn(&[u8]));

/// Every target.
pub const TARGETS: [Target; 6] = [
    ("config", config),
    ("mot", mot_files),
    ("manifest", manifest),
    ("url", url),
    ("tracker", tracker),
    ("api", api::requests),
];

/// Runs one.
///
/// # Panics
/// When it finds something, and without such a target.
pub fn target(name: &str, data: &[u8]) {
    let (_, run) = TARGETS.iter().find(|(known, _)| *known == name).expect("a known target");
    run(data);
}

/// A configuration file.
pub fn config(data: &[u8]) {
    let Ok(mut config) = Config::parse(&String::from_utf8_lossy(data)) else { return };
    assert!(config.differs(&config).is_empty(), "a configuration is its own");
    // What they say of a part is what counts, not whether it is right.
    let _ = config.take_notify();
    let _ = config.take_traces();
}

/// MOTChallenge rows, `seqinfo.ini`, NumPy arrays. What was read and written reads the same again.
pub fn mot_files(data: &[u8]) {
    let Some((kind, data)) = data.split_first() else { return };
    let text = String::from_utf8_lossy(data);
    let length = (kind & 8 != 0).then_some(u32::from(*kind));
    type Parse = fn(&str, Option<u32>) -> Result<Vec<mot::Row>, mot::RowError>;
    type Write = fn(&[mot::Row]) -> String;
    let rows: Option<(Parse, Write)> = match kind % 8 {
        0 => Some((mot::parse_truth, mot::write_truth)),
        1 => Some((mot::parse_results, mot::write_results)),
        2 => Some((mot::parse_detections, mot::write_detections)),
        _ => None,
    };
    if let Some((parse, write)) = rows {
        if let Ok(rows) = parse(&text, length) {
            let written = write(&rows);
            let again = parse(&written, length).expect("what was written can be read");
            assert_eq!(write(&again), written);
        }
        return;
    }
    match kind % 8 {
        3 => {
            if let Ok(info) = mot::SequenceInfo::parse(&text) {
                assert_eq!(mot::SequenceInfo::parse(&info.write()).as_ref(), Ok(&info));
            }
        }
        4 => {
            if let Ok(matrix) = mot::parse_npy(data) {
                let written = mot::write_npy(&matrix);
                let again = mot::parse_npy(&written).expect("what was written can be read");
                assert_eq!(mot::write_npy(&again), written);
            }
        }
        _ => {
            let info = mot::SequenceInfo {
                name: "fuzz".into(),
                frame_rate: 25.0,
                length: 10,
                width: 640,
                height: 480,
            };
            let (array, rows) = data.split_at(data.len() / 2);
            let rows = String::from_utf8_lossy(rows);
            // Either may be wrong.
            let _ = mot::SequenceEmbeddings::parse(array, &rows, &info);
            let _ = mot::Sequence::parse(info, &rows);
        }
    }
}

/// `manifest.toml`.
pub fn manifest(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    if let Ok(manifest) = Manifest::parse(Path::new("models/manifest.toml"), &text) {
        for model in manifest.models() {
            // There is no such file; the path may be anything.
            let _ = manifest.verify(model);
            let mut tracker = TrackerConfig::default();
            if let Some(output) = &model.output {
                output.tracking.apply(&mut tracker);
            }
        }
    }
}

/// The address of a source, and that its password is never shown.
pub fn url(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    if let Ok(url) = SourceUrl::parse(&text) {
        let again = SourceUrl::parse(url.with_secrets()).expect("what was read reads the same again");
        assert_eq!(again, url);
    }
    let secret = "Xk7qPz";
    if text.contains(secret) {
        return;
    }
    let with_login = format!("rtsp://user{}:{secret}{text}", text.len());
    if let Ok(url) = SourceUrl::parse(&with_login) {
        let shown = format!("{url} {url:?} {} {}", url.redacted(), url.scrub(&with_login));
        // A host or a path may be called like that; a login may not be shown.
        assert!(!shown.contains(&format!(":{secret}@")), "{with_login:?}: {shown}");
    } else if let Err(error) = SourceUrl::parse(&with_login) {
        assert!(!error.to_string().contains(secret), "{with_login:?}: {error}");
    }
}

#[derive(Arbitrary)]
struct Box64 {
    x: f64,
    y: f64,
    w: f64,
    h: f64,
    score: f64,
    class: u8,
}

#[derive(Arbitrary)]
struct FuzzedFrame {
    /// Nanoseconds; also backwards.
    step: i64,
    width: f64,
    height: f64,
    boxes: Vec<Box64>,
    /// Small ones too, which are more likely to be people.
    people: Vec<(u16, u16, u8, u8, u8)>,
    embedding: Option<[f32; 4]>,
    shift: Option<([f64; 2], [f64; 2])>,
    links: Vec<f32>,
    /// Whether there are 10,000 of these boxes; seldom, for they take long.
    crowd: u8,
}

/// Detections, scores, times and pictures' sizes of any kind. Boxes are finite, ids are never given out twice, and what
/// is kept is bounded.
pub fn tracker(data: &[u8]) {
    let mut unstructured = Unstructured::new(data);
    let methods = [
        Association::Implicit,
        Association::Iou,
        Association::IouMotion,
        Association::Deep,
        Association::ExplicitFixed,
        Association::Huang,
        Association::Mahalanobis,
    ];
    let Ok(method) = unstructured.choose(&methods) else { return };
    let mut config = TrackerConfig::default();
    config.association.method = *method;
    let most = config.life.max_tracks;
    let mut tracker = Tracker::new(config);
    let (mut time, mut request) = (MediaTime::default(), LinkRequest::default());
    let (mut known, mut ended) = (BTreeSet::new(), BTreeSet::new());
    let mut newest = 0;
    while !unstructured.is_empty() {
        let Ok(frame) = FuzzedFrame::arbitrary(&mut unstructured) else { return };
        time = MediaTime(time.0.wrapping_add(frame.step));
        let detections = detections(&frame);
        let embedding = frame.embedding.and_then(|values| Embedding::normalised(values.to_vec()));
        let embeddings = vec![embedding; detections.len()];
        let input = FrameInput {
            time,
            width: frame.width,
            height: frame.height,
            detections: &detections,
            embeddings: &embeddings,
            shift: frame.shift.map(|(by, variance)| Shift { by, variance }),
        };
        tracker.predict(input, &mut request);
        let mut links = frame.links.clone();
        links.resize(request.pairs.len(), 0.7);
        let update = tracker.update(&links).expect("a score for each pair");
        assert!(update.tracks.len() <= most, "{} tracks", update.tracks.len());
        for track in &update.tracks {
            let BBox { x, y, w, h } = track.bbox;
            assert!([x, y, w, h].iter().all(|v| v.is_finite()), "{track:?}");
            assert!(
                track.velocity.iter().all(|v| v.is_finite()) && track.confidence.is_finite(),
                "{track:?}"
            );
            assert!(!ended.contains(&track.id), "{track:?} had ended");
            if known.insert(track.id) {
                assert!(track.id.0 > newest, "{track:?} is not new");
                newest = track.id.0;
            }
        }
        ended.extend(update.ended);
    }
}

fn detections(frame: &FuzzedFrame) -> Vec<Detection> {
    let any = frame.boxes.iter().map(|b| Detection {
        bbox: BBox { x: b.x, y: b.y, w: b.w, h: b.h },
        score: b.score,
        class: ClassId(b.class.into()),
    });
    let people = frame.people.iter().map(|&(x, y, w, h, score)| Detection {
        bbox: BBox { x: x.into(), y: y.into(), w: w.into(), h: h.into() },
        score: f64::from(score) / 255.0,
        class: ClassId(0),
    });
    let once: Vec<_> = any.chain(people).collect();
    let times = if frame.crowd == u8::MAX { 10_000 / once.len().max(1) + 1 } else { 1 };
    once.iter().cycle().take(once.len() * times).copied().collect()
}
