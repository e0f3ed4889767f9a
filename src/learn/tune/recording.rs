//! What a filter is tuned on: boxes that were measured, and the boxes that were there.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use crate::learn::dataset::{self, DatasetError, Owner};
use crate::mot::{Sequence, SequenceInfo, first_half_length, parse_truth};
use crate::track::kalman::BoxFilter;
use crate::track::motion::{measurement_noise, motion, newborn};
use crate::track::nearby::Nearby;
use crate::track::shift::global_shift;
use crate::track::{FilterConfig, FrameInput, LifeConfig, LinkRequest, ShiftConfig, Tracker, TrackerConfig};
use crate::types::{BBox, MediaTime};

/// A sequence, person by person.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// Name of its folder.
    pub name: String,
    /// Name of the footage; see [`dataset::group`].
    pub group: String,
    /// Time of each frame, seconds.
    pub times: Vec<f64>,
    /// How far the camera moved every box since the frame before, pixels `(dx, dy)`; an entry a frame.
    pub shifts: Vec<[f64; 2]>,
    /// The people.
    pub people: Vec<Person>,
}

/// One person, from the first frame that anything is known of to the last.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Person {
    /// Index of the first frame.
    pub first: usize,
    /// One entry a frame.
    pub points: Vec<Point>,
}

/// What is known of a person in a frame; boxes are `(cx, cy, w, h)`, pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// What the detector said.
    pub measured: Option<[f64; 4]>,
    /// Where the person was.
    pub truth: Option<[f64; 4]>,
    /// How the true box changed, pixels a second; only a simulated world knows.
    pub velocity: Option<[f64; 4]>,
}

/// Fewer detections than this tell nothing about a filter that is to have settled.
const MIN_MEASURED: usize = 10;

/// Reads the sequence in `folder` and joins its detections to its truth; of the frames only those of the
/// second half when `second_half` says so.
///
/// # Errors
/// A file that cannot be read or is wrong; the message names it.
pub fn with_truth(folder: &Path, second_half: bool) -> Result<Recording, DatasetError> {
    let labelled = dataset::load(folder)?;
    let path = folder.join("gt/gt.txt");
    let text =
        fs::read_to_string(&path).map_err(|reason| DatasetError::Read { path: path.clone(), reason })?;
    let length = labelled.frames.len();
    let truth =
        parse_truth(&text, Some(length as u32)).map_err(|reason| DatasetError::Rows { path, reason })?;
    let skip = if second_half { first_half_length(length as u32) as usize } else { 0 };
    let least = TrackerConfig::default().association.high_score;

    let mut known: BTreeMap<i64, BTreeMap<usize, Point>> = BTreeMap::new();
    for (frame, seen) in labelled.frames.iter().enumerate().skip(skip) {
        for (detection, owner) in seen.detections.iter().zip(&seen.owners) {
            if let Owner::Of(id) = owner
                && detection.score >= least
                && detection.bbox.is_valid()
            {
                known.entry(*id).or_default().entry(frame).or_default().measured =
                    Some(centre(&detection.bbox));
            }
        }
    }
    for row in truth {
        let frame = row.frame as usize - 1;
        if let Some(points) = known.get_mut(&row.id).filter(|_| frame >= skip) {
            points.entry(frame).or_default().truth = Some(centre(&row.bbox));
        }
    }
    let times = labelled.frames.iter().map(|f| f.time.since(MediaTime::default())).collect();
    Ok(Recording::new(labelled.name, times, known.into_values()))
}

/// Reads the sequence in `folder`, which need have no truth, and lets the default tracker say whose each
/// detection is, by overlap alone. Its gate has cut off what is far from the prediction, so that these
/// errors are a little too small.
///
/// # Errors
/// A file that cannot be read or is wrong; the message names it.
pub fn without_truth(folder: &Path, second_half: bool) -> Result<Recording, DatasetError> {
    let read = |file: &str| {
        let path = folder.join(file);
        fs::read_to_string(&path).map_err(|reason| DatasetError::Read { path, reason })
    };
    let info = SequenceInfo::parse(&read("seqinfo.ini")?)
        .map_err(|reason| DatasetError::Info { path: folder.join("seqinfo.ini"), reason })?;
    let mut sequence = Sequence::parse(info, &read("det/det.txt")?)
        .map_err(|reason| DatasetError::Rows { path: folder.join("det/det.txt"), reason })?;
    if second_half {
        sequence = sequence.second_half();
    }
    let Sequence { info, detections } = sequence;
    let config = TrackerConfig { filter: FilterConfig::hand_set(), ..TrackerConfig::default() };
    let mut tracker = Tracker::new(config);
    let mut request = LinkRequest::default();
    let mut known: BTreeMap<u64, BTreeMap<usize, Point>> = BTreeMap::new();
    for (frame, detections) in detections.iter().enumerate() {
        let time = MediaTime::from_secs(frame as f64 / info.frame_rate);
        let (width, height) = (f64::from(info.width), f64::from(info.height));
        tracker.predict(
            FrameInput { time, width, height, detections, embeddings: &[], shift: None },
            &mut request,
        );
        let links: Vec<f32> = tracker.pairs().iter().map(|pair| pair.geometry.iou as f32).collect();
        // The frame was predicted above and every pair has its link: neither step can fail.
        let Ok(decision) = tracker.decide(&links) else { continue };
        let seen: Vec<(u64, [f64; 4])> = decision
            .matches
            .iter()
            .map(|m| (tracker.tracks()[m.track].id.0, centre(&tracker.detections()[m.detection].bbox)))
            .collect();
        if tracker.apply(&decision).is_err() {
            continue;
        }
        let born = tracker.tracks().iter().filter(|t| t.hits == 1 && t.matched);
        let born = born.map(|t| (t.id.0, centre(&t.last().bbox))).collect::<Vec<_>>();
        for (id, measured) in seen.into_iter().chain(born) {
            known.entry(id).or_default().entry(frame).or_default().measured = Some(measured);
        }
    }
    let name = folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let times = (0..detections.len()).map(|i| i as f64 / info.frame_rate).collect();
    Ok(Recording::new(name, times, known.into_values()))
}

/// The folders of the sequences under `root` (or `root` itself, when it is one) that have detections,
/// with truth or without, in the order of their names.
///
/// # Errors
/// A root that cannot be read or holds no sequence.
pub fn folders_without_truth(root: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let is_sequence =
        |path: &PathBuf| path.join("det/det.txt").is_file() && path.join("seqinfo.ini").is_file();
    let root = root.to_path_buf();
    if is_sequence(&root) {
        return Ok(vec![root]);
    }
    let wrong = |reason| DatasetError::Read { path: root.clone(), reason };
    let entries = fs::read_dir(&root).map_err(wrong)?.collect::<Result<Vec<_>, _>>().map_err(wrong)?;
    let mut found: Vec<PathBuf> = entries.iter().map(fs::DirEntry::path).filter(is_sequence).collect();
    found.sort();
    if found.is_empty() {
        return Err(DatasetError::Empty(root));
    }
    Ok(found)
}

fn centre(bbox: &BBox) -> [f64; 4] {
    [bbox.cx(), bbox.cy(), bbox.w, bbox.h]
}

impl Recording {
    fn new(name: String, times: Vec<f64>, known: impl Iterator<Item = BTreeMap<usize, Point>>) -> Self {
        let people = known
            .filter(|points| points.values().filter(|p| p.measured.is_some()).count() >= MIN_MEASURED)
            .map(|points| {
                let first = points.keys().next().copied().unwrap_or_default();
                let last = points.keys().next_back().copied().unwrap_or_default();
                let at = |frame: usize| points.get(&frame).copied().unwrap_or_default();
                Person { first, points: (first..=last).map(at).collect() }
            })
            .collect();
        let group = dataset::group(&name).to_owned();
        let shifts = vec![[0.0; 2]; times.len()];
        let mut recording = Self { name, group, times, shifts, people };
        recording.find_shifts();
        recording
    }

    /// Estimates the camera's motion the way the tracker does, with the hand-set filter: the default one has
    /// seen footage. It is done once: all filters that are tried see the same motion.
    fn find_shifts(&mut self) {
        let config = TrackerConfig { filter: FilterConfig::hand_set(), ..TrackerConfig::default() };
        let shift = ShiftConfig::default();
        let lost = LifeConfig::default().lost;
        struct Live {
            filter: BoxFilter,
            seen: f64,
            matched: bool,
            hits: u32,
        }
        let mut live: Vec<Option<Live>> = self.people.iter().map(|_| None).collect();
        let mut detected = Nearby::default();
        for frame in 0..self.times.len() {
            let time = self.times[frame];
            let dt = if frame == 0 { 0.0 } else { time - self.times[frame - 1] };
            let seen: Vec<Option<[f64; 4]>> = self
                .people
                .iter()
                .map(|p| frame.checked_sub(p.first).and_then(|i| p.points.get(i)).and_then(|p| p.measured))
                .collect();
            let mut predicted = vec![];
            for slot in &mut live {
                *slot = slot.take().filter(|l| time - l.seen <= lost);
                if let Some(l) = slot {
                    let height = l.filter.position()[3].max(1.0);
                    l.filter.predict(&motion(&config.filter, dt, height, 1.0));
                    if l.matched && l.hits >= shift.min_hits {
                        predicted.push(bbox(l.filter.position()));
                    }
                }
            }
            detected.fill(seen.iter().flatten().map(|z| bbox(*z)).enumerate());
            let [dx, dy] = global_shift(&shift, &predicted, &detected).unwrap_or_default().by;
            self.shifts[frame] = [dx, dy];
            for (slot, seen) in live.iter_mut().zip(seen) {
                if let Some(l) = slot {
                    l.filter.axes[0].x[0] += dx;
                    l.filter.axes[1].x[0] += dy;
                    l.matched = seen.is_some();
                }
                match (slot, seen) {
                    (Some(l), Some(z)) => {
                        let height = l.filter.position()[3].max(1.0);
                        l.filter.update(z, measurement_noise(&config.filter, height, 1.0));
                        (l.seen, l.hits) = (time, l.hits + 1);
                    }
                    (slot @ None, Some(z)) => {
                        let filter = newborn(&config.filter, z);
                        *slot = Some(Live { filter, seen: time, matched: true, hits: 1 });
                    }
                    _ => {}
                }
            }
        }
    }
}

fn bbox([cx, cy, w, h]: [f64; 4]) -> BBox {
    BBox::from_center(cx, cy, w.max(1.0), h.max(1.0))
}
