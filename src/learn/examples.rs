//! Labelled pairs, in columns: link requests joined to the truth.

use std::ops::Range;

use sha2::{Digest, Sha256};

use crate::track::{Features, HISTORY, LinkRequest};

/// A growing set of labelled pairs with raw features.
///
/// Histories are stored once a track and frame, as in [`LinkRequest`]; examples refer to them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Examples {
    features: Features,
    histories: Vec<f32>,
    lengths: Vec<u8>,
    candidates: Vec<f32>,
    track: Vec<u32>,
    labels: Vec<f32>,
    weights: Vec<f32>,
}

/// Examples to learn from, and others to tell by when to stop.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Split {
    /// To learn from.
    pub training: Examples,
    /// Never learned from; may be empty.
    pub validation: Examples,
}

impl From<Examples> for Split {
    /// All to learn from.
    fn from(training: Examples) -> Self {
        Self { training, validation: Examples::default() }
    }
}

impl Split {
    /// A SHA-256 of all that is in it.
    pub fn fingerprint(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        for Examples { features: _, histories, lengths, candidates, track, labels, weights } in
            [&self.training, &self.validation]
        {
            for values in [histories, candidates, labels, weights] {
                hash.update((values.len() as u64).to_le_bytes());
                values.iter().for_each(|v| hash.update(v.to_le_bytes()));
            }
            hash.update(lengths);
            track.iter().for_each(|t| hash.update(t.to_le_bytes()));
        }
        hash.finalize().into()
    }
}

impl Examples {
    /// None yet, of `features`.
    pub fn of(features: Features) -> Self {
        Self { features, ..Self::default() }
    }

    /// What the rows are.
    pub fn features(&self) -> Features {
        self.features
    }

    /// Number of examples.
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// Share of positives.
    pub fn positive_share(&self) -> f64 {
        self.labels.iter().map(|l| f64::from(*l)).sum::<f64>() / self.len().max(1) as f64
    }

    /// Adds the pairs of `request` that `judge` wants: for each pair index `Some((label, weight))`
    /// to take it, `None` to leave it. Only the histories that are needed are copied.
    ///
    /// # Panics
    /// When the request has other features.
    pub fn push(&mut self, request: &LinkRequest, mut judge: impl FnMut(usize) -> Option<(bool, f32)>) {
        assert_eq!(request.features, self.features, "one kind of rows");
        let mut stored: Vec<Option<u32>> = vec![None; request.tracks()];
        for (i, pair) in request.pairs.iter().enumerate() {
            let Some((label, weight)) = judge(i) else { continue };
            let row = pair.track as usize;
            let track = *stored[row].get_or_insert_with(|| {
                let width = HISTORY * self.features.step();
                self.histories.extend_from_slice(&request.histories[row * width..(row + 1) * width]);
                self.lengths.push(request.lengths[row].clamp(1, HISTORY as i32) as u8);
                (self.lengths.len() - 1) as u32
            });
            self.track.push(track);
            let width = self.features.candidate();
            self.candidates.extend_from_slice(&request.candidates[i * width..(i + 1) * width]);
            self.labels.push(if label { 1.0 } else { 0.0 });
            self.weights.push(weight);
        }
    }

    /// Appends all of `other`.
    ///
    /// # Panics
    /// When it has other features.
    pub fn append(&mut self, other: &Examples) {
        assert_eq!(other.features, self.features, "one kind of rows");
        let first = self.lengths.len() as u32;
        self.histories.extend_from_slice(&other.histories);
        self.lengths.extend_from_slice(&other.lengths);
        self.candidates.extend_from_slice(&other.candidates);
        self.track.extend(other.track.iter().map(|t| t + first));
        self.labels.extend_from_slice(&other.labels);
        self.weights.extend_from_slice(&other.weights);
    }

    /// A random choice of `count` of the examples in `range`, in their order; all of them when there are fewer.
    ///
    /// # Panics
    /// When `range` is beyond the examples.
    pub fn choose(&self, range: Range<usize>, count: usize, rng: &mut fastrand::Rng) -> Examples {
        let mut chosen = Examples::of(self.features);
        let mut moved: Vec<Option<u32>> = vec![None; self.lengths.len()];
        let mut wanted = count.min(range.len());
        for i in range.clone() {
            // Knuth's selection sampling: the share still wanted of those still to come.
            if rng.usize(..range.end - i) >= wanted {
                continue;
            }
            wanted -= 1;
            let track = self.track[i] as usize;
            let to = *moved[track].get_or_insert_with(|| {
                let width = HISTORY * self.features.step();
                let rows = &self.histories[track * width..(track + 1) * width];
                chosen.histories.extend_from_slice(rows);
                chosen.lengths.push(self.lengths[track]);
                (chosen.lengths.len() - 1) as u32
            });
            chosen.track.push(to);
            chosen.candidates.extend_from_slice(self.sequence(i as u32).1);
            chosen.labels.push(self.labels[i]);
            chosen.weights.push(self.weights[i]);
        }
        chosen
    }

    /// History rows, as many as it has observations, and candidate row of example `i`.
    pub fn sequence(&self, i: u32) -> (&[f32], &[f32]) {
        let (i, track) = (i as usize, self.track[i as usize] as usize);
        let [step, candidate] = [self.features.step(), self.features.candidate()];
        let start = track * HISTORY * step;
        let history = &self.histories[start..start + usize::from(self.lengths[track]) * step];
        (history, &self.candidates[i * candidate..(i + 1) * candidate])
    }

    /// (label, weight) of example `i`.
    pub fn target(&self, i: u32) -> (f32, f32) {
        (self.labels[i as usize], self.weights[i as usize])
    }

    /// Labels of all examples.
    pub fn labels(&self) -> &[f32] {
        &self.labels
    }

    /// Weights of all examples.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// Valid history steps of all stored tracks.
    pub fn history_steps(&self) -> impl Iterator<Item = &[f32]> {
        let width = self.features.step();
        let tracks = self.histories.chunks_exact(HISTORY * width).zip(&self.lengths);
        tracks.flat_map(move |(rows, length)| rows[..usize::from(*length) * width].chunks_exact(width))
    }

    /// Candidates of all examples.
    pub fn candidates(&self) -> impl Iterator<Item = &[f32]> {
        self.candidates.chunks_exact(self.features.candidate())
    }

    /// Applies `history` to every valid history step and `candidate` to every candidate, in place.
    pub(super) fn map_inputs(
        &mut self,
        mut history: impl FnMut(&mut [f32]),
        mut candidate: impl FnMut(&mut [f32]),
    ) {
        let width = self.features.step();
        for (rows, length) in self.histories.chunks_exact_mut(HISTORY * width).zip(&self.lengths) {
            rows[..usize::from(*length) * width].chunks_exact_mut(width).for_each(&mut history);
        }
        self.candidates.chunks_exact_mut(self.features.candidate()).for_each(&mut candidate);
    }
}
