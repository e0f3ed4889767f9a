//! What of truth and results is scored.

use std::collections::BTreeMap;

use super::Row;
use super::matching::best_pairs;
use super::matrix::{Matrix, overlaps};
use crate::types::BBox;

/// Whose rules decide what counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Benchmark {
    /// No classes: every truth box that is marked to count does.
    Mot15,
    /// Pedestrians that are marked to count; a result on a person on a vehicle, a static person, a
    /// distractor or a reflection is neither right nor wrong. MOT16 as well.
    Mot17,
    /// As MOT17, and results on vehicles are left out too.
    Mot20,
}

impl Benchmark {
    /// The benchmark that truth is of: MOT15 has no classes, MOT20 is told by its sequences' names.
    pub fn of(sequence: &str, truth: &[Row]) -> Self {
        match truth.first() {
            Some(row) if row.class.is_none() => Benchmark::Mot15,
            _ if sequence.starts_with("MOT20") => Benchmark::Mot20,
            _ => Benchmark::Mot17,
        }
    }

    fn is_distractor(self, class: i32) -> bool {
        matches!(class, 2 | 7 | 8 | 12) || (self == Benchmark::Mot20 && class == 6)
    }
}

/// Why rows cannot be scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EvalError {
    /// A frame that the sequence does not have.
    #[error("{which} has frame {frame}, expected 1 to {length}")]
    Frame {
        /// Truth or results.
        which: &'static str,
        /// The frame.
        frame: u32,
        /// Frames of the sequence.
        length: u32,
    },
    /// An identity in two boxes of one frame.
    #[error("{which} has identity {id} twice in frame {frame}, expected once at most")]
    Duplicate {
        /// Truth or results.
        which: &'static str,
        /// The identity.
        id: i64,
        /// The frame.
        frame: u32,
    },
    /// A box of numbers that are none.
    #[error("{which} has a box of identity {id} in frame {frame} that is not finite or of negative size")]
    Box {
        /// Truth or results.
        which: &'static str,
        /// The identity.
        id: i64,
        /// The frame.
        frame: u32,
    },
    /// A benchmark with classes, and truth without.
    #[error("truth has no classes in frame {frame}, {benchmark:?} needs them (MOT15's rules do not)")]
    NoClass {
        /// The frame.
        frame: u32,
        /// The benchmark asked for.
        benchmark: Benchmark,
    },
}

/// A sequence reduced to what is scored.
#[derive(Clone, Debug, Default)]
pub(super) struct Scene {
    pub frames: Vec<Scored>,
    /// Boxes of every truth identity; identities are `0..len`.
    pub truth_counts: Vec<u64>,
    /// Boxes of every track; tracks are `0..len`.
    pub track_counts: Vec<u64>,
}

/// One frame of a [`Scene`].
#[derive(Clone, Debug, Default)]
pub(super) struct Scored {
    /// Identity of every truth box.
    pub truth: Vec<usize>,
    /// Track of every result box.
    pub tracks: Vec<usize>,
    /// IoU, truth by tracks.
    pub similarity: Matrix,
}

impl Scene {
    pub fn truth_boxes(&self) -> u64 {
        self.truth_counts.iter().sum()
    }

    pub fn track_boxes(&self) -> u64 {
        self.track_counts.iter().sum()
    }
}

/// An IoU of at least this is a match, here and in CLEAR (TrackEval allows for rounding at both).
pub(super) const MATCH_IOU: f64 = 0.5 - f64::EPSILON;

/// Reduces a sequence to what is scored: drops results on distractors, then truth that does not count.
pub(super) fn scene(
    truth: &[Row],
    results: &[Row],
    length: u32,
    benchmark: Benchmark,
) -> Result<Scene, EvalError> {
    let truth = by_frame("truth", truth, length)?;
    let results = by_frame("results", results, length)?;
    let (mut truth_ids, mut track_ids) = (Relabel::default(), Relabel::default());
    let mut frames = Vec::with_capacity(truth.len());
    for (truth, results) in truth.iter().zip(&results) {
        let boxes = |rows: &[&Row]| rows.iter().map(|row| row.bbox).collect::<Vec<BBox>>();
        let similarity = overlaps(&boxes(truth), &boxes(results));
        let mut keep_result = vec![true; results.len()];
        if benchmark != Benchmark::Mot15 {
            for col in on_distractors(truth, &similarity, benchmark)? {
                keep_result[col] = false;
            }
        }
        let counts =
            |row: &Row| row.conf.trunc() != 0.0 && (benchmark == Benchmark::Mot15 || row.class == Some(1));
        let rows: Vec<usize> = (0..truth.len()).filter(|&i| counts(truth[i])).collect();
        let cols: Vec<usize> = (0..results.len()).filter(|&i| keep_result[i]).collect();
        frames.push(Scored {
            truth: rows.iter().map(|&i| truth_ids.count(truth[i].id)).collect(),
            tracks: cols.iter().map(|&i| track_ids.count(results[i].id)).collect(),
            similarity: similarity.select(&rows, &cols),
        });
    }
    Ok(Scene { frames, truth_counts: truth_ids.counts, track_counts: track_ids.counts })
}

/// Columns whose best truth is a distractor.
fn on_distractors(
    truth: &[&Row],
    similarity: &Matrix,
    benchmark: Benchmark,
) -> Result<Vec<usize>, EvalError> {
    if let Some(row) = truth.iter().find(|row| row.class.is_none()) {
        return Err(EvalError::NoClass { frame: row.frame, benchmark });
    }
    let scores = similarity.map(|_, iou| if iou < MATCH_IOU { 0.0 } else { iou });
    let on_distractor = |row: usize, col| {
        scores[(row, col)] > 0.0 && truth[row].class.is_some_and(|c| benchmark.is_distractor(c))
    };
    Ok(best_pairs(&scores)
        .into_iter()
        .filter(|&(row, col)| on_distractor(row, col))
        .map(|(_, col)| col)
        .collect())
}

/// Identities renamed to 0, 1, 2 ... as they come, and their boxes counted.
#[derive(Default)]
struct Relabel {
    names: BTreeMap<i64, usize>,
    counts: Vec<u64>,
}

impl Relabel {
    fn count(&mut self, id: i64) -> usize {
        let next = self.counts.len();
        let name = *self.names.entry(id).or_insert(next);
        if name == next {
            self.counts.push(0);
        }
        self.counts[name] += 1;
        name
    }
}

fn by_frame<'a>(which: &'static str, rows: &'a [Row], length: u32) -> Result<Vec<Vec<&'a Row>>, EvalError> {
    let mut frames = vec![Vec::new(); length as usize];
    for row in rows {
        let Row { frame, id, bbox: BBox { x, y, w, h }, .. } = *row;
        if frame == 0 || frame > length {
            return Err(EvalError::Frame { which, frame, length });
        }
        if ![x, y, w, h].iter().all(|v| v.is_finite()) || w < 0.0 || h < 0.0 {
            return Err(EvalError::Box { which, id, frame });
        }
        frames[frame as usize - 1].push(row);
    }
    for frame in &frames {
        let mut ids: Vec<i64> = frame.iter().map(|row| row.id).collect();
        ids.sort_unstable();
        if let Some(pair) = ids.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(EvalError::Duplicate { which, id: pair[0], frame: frame[0].frame });
        }
    }
    Ok(frames)
}
