//! MOTChallenge folders as training data: detections that know whose they are.

use std::fs;
use std::path::{Path, PathBuf};

pub use crate::mot::footage as group;
use crate::mot::{
    FeatureError, Row, RowError, SeqInfoError, Sequence, SequenceEmbeddings, SequenceInfo, parse_truth,
};
use crate::track::assign::assign;
use crate::types::{BBox, Detection, Embedding, MediaTime};

/// Least IoU of a detection with the truth that it belongs to.
const MATCH_IOU: f64 = 0.5;

/// From this IoU on a detection that belongs to nobody may still show a person badly: neither a
/// positive nor a negative for that person.
const NEAR_IOU: f64 = 0.3;

/// Classes of MOT16's and MOT17's truth that are people or are taken for people: pedestrian, person
/// on a vehicle, static person, distractor, reflection. A detector finds them all, and each has an
/// identity that a tracker must keep.
const CLASSES: [i32; 5] = [1, 2, 7, 8, 12];

/// Where a sequence's folder has its appearance vectors.
pub const EMBEDDINGS: &str = "det/det_features.npy";

/// Whose a detection is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The detection of this identity.
    Of(i64),
    /// Overlaps this identity but is not its detection: a bad box, or a second one.
    Near(i64),
    /// A false alarm.
    Nobody,
}

/// One frame of a [`LabelledSequence`].
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledFrame {
    /// When.
    pub time: MediaTime,
    /// What was detected.
    pub detections: Vec<Detection>,
    /// Whose each detection is.
    pub owners: Vec<Owner>,
    /// What each detection looks like; empty where nothing is known of that.
    pub embeddings: Vec<Option<Embedding>>,
}

/// A sequence whose detections are joined to the truth.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledSequence {
    /// Name of its folder.
    pub name: String,
    /// Name of the footage: copies of a sequence that differ by detector share it.
    pub group: String,
    /// Width of the picture, pixels.
    pub width: f64,
    /// Height of the picture, pixels.
    pub height: f64,
    /// Frames per second.
    pub frame_rate: f64,
    /// The frames.
    pub frames: Vec<LabelledFrame>,
}

impl LabelledSequence {
    /// Whether it is known what its detections look like.
    pub fn has_embeddings(&self) -> bool {
        self.frames.iter().any(|frame| !frame.embeddings.is_empty())
    }
}

/// Why training data cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A file or folder that cannot be read.
    #[error("cannot read {}: {reason}", path.display())]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        reason: std::io::Error,
    },
    /// A file with a wrong row.
    #[error("{}: {reason}", path.display())]
    Rows {
        /// Which.
        path: PathBuf,
        /// What is wrong.
        reason: RowError,
    },
    /// A wrong `seqinfo.ini`.
    #[error("{}: {reason}", path.display())]
    Info {
        /// Which.
        path: PathBuf,
        /// What is wrong.
        reason: SeqInfoError,
    },
    /// Appearance vectors that do not fit.
    #[error("{}: {reason}", path.display())]
    Features {
        /// Which.
        path: PathBuf,
        /// What is wrong.
        reason: FeatureError,
    },
    /// A folder without sequences.
    #[error(
        "no sequence in {}: expected folders SEQ/ with gt/gt.txt, det/det.txt and seqinfo.ini",
        .0.display()
    )]
    Empty(PathBuf),
}

/// The folders of the sequences under `root` (or `root` itself, when it is one), in the order of
/// their names.
///
/// # Errors
/// A root that cannot be read or holds no sequence.
pub fn folders(root: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let is_sequence = |path: &Path| path.join("gt/gt.txt").is_file() && path.join("det/det.txt").is_file();
    if is_sequence(root) {
        return Ok(vec![root.to_path_buf()]);
    }
    let wrong = |reason| DatasetError::Read { path: root.to_path_buf(), reason };
    let mut found = vec![];
    for entry in fs::read_dir(root).map_err(wrong)? {
        let path = entry.map_err(wrong)?.path();
        if is_sequence(&path) {
            found.push(path);
        }
    }
    if found.is_empty() {
        return Err(DatasetError::Empty(root.to_path_buf()));
    }
    found.sort();
    Ok(found)
}

/// Loads the sequence in `folder` and joins its detections to its truth.
///
/// # Errors
/// A file that cannot be read or is wrong; the message names it.
pub fn load(folder: &Path) -> Result<LabelledSequence, DatasetError> {
    let read = |file: &str| {
        let path = folder.join(file);
        fs::read_to_string(&path).map_err(|reason| DatasetError::Read { path, reason })
    };
    let rows = |file: &str, reason| DatasetError::Rows { path: folder.join(file), reason };
    let info = SequenceInfo::parse(&read("seqinfo.ini")?)
        .map_err(|reason| DatasetError::Info { path: folder.join("seqinfo.ini"), reason })?;
    let truth = parse_truth(&read("gt/gt.txt")?, Some(info.length)).map_err(|e| rows("gt/gt.txt", e))?;
    let sequence = Sequence::parse(info, &read("det/det.txt")?).map_err(|e| rows("det/det.txt", e))?;
    let name = folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    Ok(join(name, sequence, &truth))
}

/// Gives `sequence`, which [`load`] read from `folder`, its appearance vectors: [`EMBEDDINGS`].
///
/// # Errors
/// A file that cannot be read or does not fit the detections.
pub fn load_embeddings(folder: &Path, sequence: &mut LabelledSequence) -> Result<(), DatasetError> {
    let path = folder.join(EMBEDDINGS);
    let bytes = fs::read(&path).map_err(|reason| DatasetError::Read { path: path.clone(), reason })?;
    let det = folder.join("det/det.txt");
    let rows = fs::read_to_string(&det).map_err(|reason| DatasetError::Read { path: det, reason })?;
    let info = SequenceInfo {
        name: sequence.name.clone(),
        frame_rate: sequence.frame_rate,
        length: sequence.frames.len() as u32,
        width: sequence.width as u32,
        height: sequence.height as u32,
    };
    let found = SequenceEmbeddings::parse(&bytes, &rows, &info)
        .map_err(|reason| DatasetError::Features { path, reason })?;
    for (index, frame) in sequence.frames.iter_mut().enumerate() {
        frame.embeddings = found.frame(index).to_vec();
    }
    Ok(())
}

/// Joins the detections of `sequence` to `truth`, frame by frame.
pub fn join(name: String, sequence: Sequence, truth: &[Row]) -> LabelledSequence {
    let Sequence { info, detections } = sequence;
    let mut people: Vec<Vec<(i64, BBox)>> = vec![vec![]; detections.len()];
    for row in truth {
        let person = match row.class {
            Some(class) => CLASSES.contains(&class),
            None => row.conf != 0.0,
        };
        if let Some(frame) = people.get_mut(row.frame as usize - 1).filter(|_| person) {
            frame.push((row.id, row.bbox));
        }
    }
    let frames = detections
        .into_iter()
        .zip(people)
        .enumerate()
        .map(|(index, (detections, people))| LabelledFrame {
            time: MediaTime::from_secs(index as f64 / info.frame_rate),
            owners: owners(&detections, &people),
            detections,
            embeddings: vec![],
        })
        .collect();
    LabelledSequence {
        group: group(&name).to_owned(),
        name,
        width: f64::from(info.width),
        height: f64::from(info.height),
        frame_rate: info.frame_rate,
        frames,
    }
}

fn owners(detections: &[Detection], people: &[(i64, BBox)]) -> Vec<Owner> {
    let iou: Vec<f64> =
        detections.iter().flat_map(|d| people.iter().map(|(_, truth)| d.bbox.iou(truth))).collect();
    let cost: Vec<f64> = iou.iter().map(|iou| if *iou >= MATCH_IOU { -iou } else { 0.0 }).collect();
    let chosen = assign(&cost, detections.len(), people.len());
    let near = |d: usize| {
        let row = &iou[d * people.len()..(d + 1) * people.len()];
        let best = (0..row.len()).max_by(|a, b| row[*a].total_cmp(&row[*b]))?;
        (row[best] >= NEAR_IOU).then(|| Owner::Near(people[best].0))
    };
    (0..detections.len())
        .map(|d| match chosen[d] {
            Some(person) if cost[d * people.len() + person] < 0.0 => Owner::Of(people[person].0),
            _ => near(d).unwrap_or(Owner::Nobody),
        })
        .collect()
}

/// A changed copy of a sequence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variant {
    /// Swap left and right.
    pub mirror: bool,
    /// Keep every this many-th frame.
    pub stride: usize,
    /// Standard deviation of noise on each box: its centre in heights, its size as a factor.
    pub jitter: f64,
    /// Share of detections that are taken away.
    pub dropout: f64,
}

impl Variant {
    /// No change.
    pub const NONE: Variant = Variant { mirror: false, stride: 1, jitter: 0.0, dropout: 0.0 };
}

/// Applies `variant` to a copy of `sequence`.
pub fn vary(sequence: &LabelledSequence, variant: &Variant, rng: &mut fastrand::Rng) -> LabelledSequence {
    let mut copy = LabelledSequence { frames: vec![], ..sequence.clone() };
    for frame in sequence.frames.iter().step_by(variant.stride.max(1)) {
        let mut kept =
            LabelledFrame { time: frame.time, detections: vec![], owners: vec![], embeddings: vec![] };
        for (index, (detection, owner)) in frame.detections.iter().zip(&frame.owners).enumerate() {
            if rng.f64() < variant.dropout {
                continue;
            }
            let mut detection = *detection;
            let b = detection.bbox;
            let mut noise = || normal(rng) * variant.jitter;
            let (w, h) = (b.w * noise().exp(), b.h * noise().exp());
            let mut cx = b.cx() + noise() * b.h;
            if variant.mirror {
                cx = sequence.width - cx;
            }
            detection.bbox = BBox::from_center(cx, b.cy() + noise() * b.h, w, h);
            kept.detections.push(detection);
            kept.owners.push(*owner);
            kept.embeddings.extend(frame.embeddings.get(index).cloned());
        }
        copy.frames.push(kept);
    }
    copy.frame_rate = sequence.frame_rate / variant.stride.max(1) as f64;
    copy
}

/// A standard normal number (Box and Muller).
pub(super) fn normal(rng: &mut fastrand::Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.f64()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.f64()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_by_detector_are_one_footage() {
        for (name, expected) in [
            ("MOT17-02-FRCNN", "MOT17-02"),
            ("MOT17-02", "MOT17-02"),
            ("MOT20-01", "MOT20-01"),
            ("TUD-Campus", "TUD-Campus"),
            ("ETH-Bahnhof-x", "ETH-Bahnhof-x"),
        ] {
            assert_eq!(group(name), expected);
        }
    }

    #[test]
    fn each_person_owns_one_detection() {
        let person = |x: f64| BBox::new(x, 0.0, 40.0, 100.0);
        let people = [(7, person(0.0)), (9, person(200.0))];
        let detections = [4.0, 2.0, 220.0, 500.0].map(|x| Detection::person(person(x), 0.9));
        let expected = [Owner::Near(7), Owner::Of(7), Owner::Near(9), Owner::Nobody];
        assert_eq!(owners(&detections, &people), expected);
        assert_eq!(owners(&detections, &[]), [Owner::Nobody; 4]);
        assert_eq!(owners(&[], &people), []);
    }

    #[test]
    fn a_mirrored_copy_of_a_mirrored_copy_is_the_sequence() {
        let frames = (0..9)
            .map(|i| LabelledFrame {
                time: MediaTime::from_secs(f64::from(i) / 8.0),
                detections: vec![Detection::person(BBox::new(f64::from(i), 8.0, 16.0, 32.0), 0.5)],
                owners: vec![Owner::Of(1)],
                embeddings: vec![],
            })
            .collect();
        let sequence = LabelledSequence {
            name: "a".into(),
            group: "a".into(),
            width: 640.0,
            height: 480.0,
            frame_rate: 8.0,
            frames,
        };
        let mut rng = fastrand::Rng::with_seed(1);
        let mirror = Variant { mirror: true, ..Variant::NONE };
        let once = vary(&sequence, &mirror, &mut rng);
        assert_eq!(once.frames[3].detections[0].bbox, BBox::new(621.0, 8.0, 16.0, 32.0));
        assert_eq!(vary(&once, &mirror, &mut rng), sequence);
        let third = vary(&sequence, &Variant { stride: 3, ..Variant::NONE }, &mut rng);
        assert_eq!(third.frames.iter().map(|f| f.time.0).collect::<Vec<_>>(), [0, 375_000_000, 750_000_000]);
    }
}
