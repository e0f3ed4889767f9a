//! What a network is trained on: sequences, their changed copies, how many pairs of each.

use super::dataset::{LabelledSequence, Variant, vary};
use super::examples::Examples;
use super::teacher::Teacher;

/// How examples are made of sequences.
#[derive(Clone, Debug, PartialEq)]
pub struct Recipe {
    /// How pairs are made.
    pub teacher: Teacher,
    /// Copies made of every sequence.
    pub variants: Vec<Variant>,
    /// Examples wanted. Every copy of every sequence gives an equal part, so that a crowded one does
    /// not outvote the others; a short one may have fewer.
    pub examples: usize,
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
            seed: 1,
        }
    }
}

impl Recipe {
    /// Makes the examples; `tell` hears of every copy that is done.
    pub fn collect(&self, sequences: &[&LabelledSequence], mut tell: impl FnMut()) -> Examples {
        let mut rng = fastrand::Rng::with_seed(self.seed);
        let mut all = Examples::default();
        let copies = (sequences.len() * self.variants.len()).max(1);
        for sequence in sequences {
            for variant in &self.variants {
                let copy = vary(sequence, variant, &mut rng);
                let mut found = Examples::default();
                self.teacher.collect(&copy, &mut rng, &mut found);
                all.append(&found.choose(self.examples.div_ceil(copies), &mut rng));
                tell();
            }
        }
        all
    }
}
