//! HOTA (Luiten et al. 2021, "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking").

use std::collections::HashMap;

use super::matching::best_pairs;
use super::matrix::Matrix;
use super::preprocess::{Scene, Scored};

/// Number of localisation thresholds alpha: 0.05, 0.10 ... 0.95.
pub const ALPHAS: usize = 19;

/// HOTA's counts and scores at every alpha. All scores are in `[0, 1]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Hota {
    /// Matches, by alpha.
    pub tp: [u64; ALPHAS],
    /// Truth boxes without a match, by alpha.
    pub fn_: [u64; ALPHAS],
    /// Result boxes without a match, by alpha.
    pub fp: [u64; ALPHAS],
    /// Association accuracy, by alpha.
    pub ass_a: [f64; ALPHAS],
    /// Association recall, by alpha.
    pub ass_re: [f64; ALPHAS],
    /// Association precision, by alpha.
    pub ass_pr: [f64; ALPHAS],
    /// Mean IoU of the matches, by alpha; 1 where there is none.
    pub loc_a: [f64; ALPHAS],
}

impl Hota {
    /// HOTA averaged over alpha.
    pub fn hota(&self) -> f64 {
        mean(|a| (self.det_a_at(a) * self.ass_a[a]).sqrt())
    }

    /// Detection accuracy averaged over alpha.
    pub fn det_a(&self) -> f64 {
        mean(|a| self.det_a_at(a))
    }

    /// Detection recall averaged over alpha.
    pub fn det_re(&self) -> f64 {
        mean(|a| ratio(self.tp[a], self.tp[a] + self.fn_[a]))
    }

    /// Detection precision averaged over alpha.
    pub fn det_pr(&self) -> f64 {
        mean(|a| ratio(self.tp[a], self.tp[a] + self.fp[a]))
    }

    /// Association accuracy averaged over alpha.
    pub fn ass_a(&self) -> f64 {
        mean(|a| self.ass_a[a])
    }

    /// Association recall averaged over alpha.
    pub fn ass_re(&self) -> f64 {
        mean(|a| self.ass_re[a])
    }

    /// Association precision averaged over alpha.
    pub fn ass_pr(&self) -> f64 {
        mean(|a| self.ass_pr[a])
    }

    /// Localisation accuracy averaged over alpha.
    pub fn loc_a(&self) -> f64 {
        mean(|a| self.loc_a[a])
    }

    fn det_a_at(&self, a: usize) -> f64 {
        ratio(self.tp[a], self.tp[a] + self.fn_[a] + self.fp[a])
    }

    pub(super) fn of(scene: &Scene) -> Self {
        let mut out = Self::default();
        let mut similarity_sum = [0.0; ALPHAS];
        if scene.truth_counts.is_empty() || scene.track_counts.is_empty() {
            out.fn_ = [scene.truth_boxes(); ALPHAS];
            out.fp = [scene.track_boxes(); ALPHAS];
            out.loc_a = [1.0; ALPHAS];
            return out;
        }
        let alignment = alignment(scene);
        let mut matched: HashMap<(usize, usize), [u64; ALPHAS]> = HashMap::new();
        for frame in &scene.frames {
            let score = |(r, c), iou| {
                if iou > 0.0 { iou * alignment[&(frame.truth[r], frame.tracks[c])] } else { 0.0 }
            };
            let mut hits = [0; ALPHAS];
            for (row, col) in best_pairs(&frame.similarity.map(score)) {
                let iou = frame.similarity[(row, col)];
                // Alphas grow: the pair is a match up to the first that it misses.
                let passed = (0..ALPHAS).take_while(|&a| iou >= alpha(a) - f64::EPSILON).count();
                if passed == 0 {
                    continue;
                }
                let pair = matched.entry((frame.truth[row], frame.tracks[col])).or_default();
                for a in 0..passed {
                    hits[a] += 1;
                    pair[a] += 1;
                    similarity_sum[a] += iou;
                }
            }
            for (a, hits) in hits.into_iter().enumerate() {
                out.tp[a] += hits;
                out.fn_[a] += frame.truth.len() as u64 - hits;
                out.fp[a] += frame.tracks.len() as u64 - hits;
            }
        }
        let mut pairs: Vec<_> = matched.into_iter().collect();
        pairs.sort_unstable_by_key(|(pair, _)| *pair);
        for ((truth, track), counts) in pairs {
            let (truth, track) = (scene.truth_counts[truth], scene.track_counts[track]);
            for (a, n) in counts.into_iter().enumerate() {
                out.ass_a[a] += n as f64 * ratio(n, truth + track - n);
                out.ass_re[a] += n as f64 * ratio(n, truth);
                out.ass_pr[a] += n as f64 * ratio(n, track);
            }
        }
        for a in 0..ALPHAS {
            let n = out.tp[a].max(1) as f64;
            out.ass_a[a] /= n;
            out.ass_re[a] /= n;
            out.ass_pr[a] /= n;
            out.loc_a[a] = mean_iou(similarity_sum[a], out.tp[a]);
        }
        out
    }

    pub(super) fn combine<'a>(parts: impl Iterator<Item = &'a Hota> + Clone) -> Self {
        let mut out = Self::default();
        for a in 0..ALPHAS {
            let sum = |f: fn(&Hota) -> &[u64; ALPHAS]| parts.clone().map(|part| f(part)[a]).sum::<u64>();
            out.tp[a] = sum(|part| &part.tp);
            out.fn_[a] = sum(|part| &part.fn_);
            out.fp[a] = sum(|part| &part.fp);
            let weighted = |f: fn(&Hota) -> &[f64; ALPHAS]| {
                parts.clone().map(|part| f(part)[a] * part.tp[a] as f64).sum::<f64>()
            };
            let n = out.tp[a].max(1) as f64;
            out.ass_a[a] = weighted(|part| &part.ass_a) / n;
            out.ass_re[a] = weighted(|part| &part.ass_re) / n;
            out.ass_pr[a] = weighted(|part| &part.ass_pr) / n;
            out.loc_a[a] = mean_iou(weighted(|part| &part.loc_a), out.tp[a]);
        }
        out
    }
}

/// Alpha number `index`, rounded as numpy's `arange` has it.
fn alpha(index: usize) -> f64 {
    0.05 + index as f64 * 0.05
}

/// How well a truth identity and a track go together over the whole sequence (before any matching):
/// what the matching of every frame prefers. Pairs that never overlap are left out: theirs is 0.
fn alignment(scene: &Scene) -> HashMap<(usize, usize), f64> {
    let mut shared: HashMap<(usize, usize), f64> = HashMap::new();
    for Scored { truth, tracks, similarity } in &scene.frames {
        let Matrix { rows, cols, .. } = *similarity;
        let row_sum: Vec<f64> =
            (0..rows).map(|r| numpy_sum(&similarity.values[r * cols..][..cols])).collect();
        let col_sum: Vec<f64> = (0..cols).map(|c| (0..rows).map(|r| similarity[(r, c)]).sum()).collect();
        for row in 0..rows {
            for col in 0..cols {
                let iou = similarity[(row, col)];
                if iou > 0.0 {
                    let total = col_sum[col] + row_sum[row] - iou;
                    let share = if total > f64::EPSILON { iou / total } else { 0.0 };
                    *shared.entry((truth[row], tracks[col])).or_default() += share;
                }
            }
        }
    }
    for ((truth, track), shared) in &mut shared {
        *shared /= (scene.truth_counts[*truth] + scene.track_counts[*track]) as f64 - *shared;
    }
    shared
}

/// Sum in numpy's order (8 interleaved sums, halves of what is longer than 128): where two matchings
/// are equally good, which happens when truth holds a box twice, the last bits decide between them.
fn numpy_sum(values: &[f64]) -> f64 {
    if values.len() < 8 {
        return values.iter().sum();
    }
    if values.len() > 128 {
        let half = values.len() / 2;
        let (left, right) = values.split_at(half - half % 8);
        return numpy_sum(left) + numpy_sum(right);
    }
    let chunks = values.chunks_exact(8);
    let rest = chunks.remainder();
    let mut r = [0.0; 8];
    for chunk in chunks {
        r.iter_mut().zip(chunk).for_each(|(sum, value)| *sum += value);
    }
    let sum = ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]));
    rest.iter().fold(sum, |sum, value| sum + value)
}

fn mean(f: impl Fn(usize) -> f64) -> f64 {
    (0..ALPHAS).map(f).sum::<f64>() / ALPHAS as f64
}

fn mean_iou(sum: f64, count: u64) -> f64 {
    if count == 0 { 1.0 } else { sum / count as f64 }
}

/// `part / whole`, 0 for nothing of nothing.
pub(super) fn ratio(part: u64, whole: u64) -> f64 {
    part as f64 / whole.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Expected: `(1 / numpy.arange(1., n + 1)).sum()` of numpy 2.4.6.
    #[test]
    fn sums_as_numpy_rounds() {
        for (n, expected) in [
            (0, 0.0),
            (3, 1.8333333333333333),
            (7, 2.5928571428571425),
            (8, 2.7178571428571425),
            (9, 2.8289682539682537),
            (20, 3.597739657143682),
            (127, 5.425334592589172),
            (128, 5.433147092589173),
            (129, 5.440899030573669),
            (300, 6.282663880299504),
            (1001, 7.486469861549347),
        ] {
            let values: Vec<f64> = (1..=n).map(|i| 1.0 / f64::from(i)).collect();
            assert_eq!(numpy_sum(&values), expected, "{n} values");
        }
    }
}
