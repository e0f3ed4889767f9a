//! What a network is trained on: sequences, their changed copies, how many pairs of each.

use super::dataset::{LabelledSequence, Variant, vary};
use super::examples::{Examples, Split};
use super::teacher::Teacher;

/// How often copies are made at most.
pub const ROUNDS: usize = 8;

/// How examples are made of sequences.
#[derive(Clone, Debug, PartialEq)]
pub struct Recipe {
    /// How pairs are made.
    pub teacher: Teacher,
    /// Copies made of every sequence.
    pub variants: Vec<Variant>,
    /// Examples wanted. Every copy of every sequence gives an equal part, so that a crowded one does
    /// not outvote the others; a short one may have fewer. Where not even half of them come together, the
    /// copies are made again, up to `ROUNDS` times in all: other detections are lost in each.
    pub examples: usize,
    /// Share of them to validate on: those of the last part of every sequence.
    pub validation: f64,
    /// Seed of all that is random here.
    pub seed: u64,
}

impl Default for Recipe {
    fn default() -> Self {
        let copy = |mirror, stride, jitter, dropout| Variant { mirror, stride, jitter, dropout };
        Self {
            teacher: Teacher::default(),
            variants: vec![
                copy(false, 1, 0.0, 0.0),
                copy(true, 1, 0.02, 0.05),
                copy(false, 2, 0.02, 0.0),
                copy(true, 3, 0.0, 0.05),
            ],
            examples: 150_000,
            validation: 0.05,
            seed: 1,
        }
    }
}

impl Recipe {
    /// Makes the examples; `tell` hears of every copy that is done: how many, of how many so far.
    pub fn collect(&self, sequences: &[&LabelledSequence], mut tell: impl FnMut(usize, usize)) -> Split {
        let mut rng = fastrand::Rng::with_seed(self.seed);
        let features = self.teacher.features;
        let mut all = Split { training: Examples::of(features), validation: Examples::of(features) };
        let copies = (sequences.len() * self.variants.len()).max(1);
        let wanted = self.examples.div_ceil(copies);
        let later = (wanted as f64 * self.validation).round() as usize;
        let mut done = 0;
        for round in 0..ROUNDS {
            let found = all.training.len();
            if round > 0 && (found == 0 || 2 * found >= self.examples) {
                break;
            }
            for sequence in sequences {
                for variant in &self.variants {
                    let copy = vary(sequence, variant, &mut rng);
                    let mut found = Examples::of(features);
                    self.teacher.collect(&copy, &mut rng, &mut found);
                    // Examples lie in the order of their frames.
                    let end = found.len() - (found.len() as f64 * self.validation).round() as usize;
                    all.training.append(&found.choose(0..end, wanted - later, &mut rng));
                    all.validation.append(&found.choose(end..found.len(), later, &mut rng));
                    done += 1;
                    tell(done, copies * (round + 1));
                }
            }
        }
        all
    }
}
