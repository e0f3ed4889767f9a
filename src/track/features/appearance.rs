//! The relative features, and how alike track and detection look.
//!
//! A candidate's row is that of [`super::relative`] and then: 20 cosine of the detection's embedding with the
//! running mean of the track's, 21 with that of its last observation, 22 the greatest with any of its
//! history's, 23 whether there is anything to compare (0 or 1; the cosines are 0 where there is not).

use super::relative;
use crate::track::pair::PairView;

/// Values of a candidate.
pub const CANDIDATE: usize = relative::CANDIDATE + LIKENESS;
/// Index of the cosine with the track's mean.
pub const MEAN_COSINE: usize = relative::CANDIDATE;
/// Index of whether there is anything to compare.
pub const KNOWN: usize = CANDIDATE - 1;

/// Values that this adds to a candidate.
const LIKENESS: usize = 4;

pub(super) fn likeness(pair: &PairView<'_>) -> [f32; LIKENESS] {
    let (Some(seen), Some(mean)) = (pair.embedding, pair.cosine()) else { return [0.0; LIKENESS] };
    let history = pair.track.history.iter().rev();
    let mut looks = history.filter_map(|o| o.embedding.as_ref()).map(|e| e.cosine(seen));
    let last = looks.next().unwrap_or(mean);
    let best = looks.fold(last, f64::max);
    [mean, last, best, 1.0].map(|v| v as f32)
}
