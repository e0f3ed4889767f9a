//! What the link scorer sees of a pair: the rows of a [`super::LinkRequest`].
//!
//! | name | file | a step | a candidate adds |
//! | --- | --- | --- | --- |
//! | `relative` (default) | [`relative`] | 14 values, relative to the track's last box | 6 that only a pair has |
//! | `appearance` | [`appearance`] | the same | these 6 and 4 of how alike they look |
//! | `literal` | [`literal`] | the embedding and 6 spatial values, as the paper has it | nothing |
//!
//! The network decides: its file says which it was trained on.

pub mod appearance;
pub mod literal;
pub mod relative;

use std::fmt;
use std::str::FromStr;

use super::pair::PairView;
use super::tracklet::Tracklet;

/// Which features a link scorer reads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Features {
    /// [`relative`]: boxes alone.
    #[default]
    Relative,
    /// [`appearance`]: boxes, and how alike track and detection look.
    Appearance {
        /// Numbers in an embedding of the kind that it was trained on.
        embedding: usize,
    },
    /// [`literal`]: embeddings themselves and normalised boxes.
    Literal {
        /// Numbers in an embedding; 0 leaves appearance out.
        embedding: usize,
    },
}

impl Features {
    /// The name without the width.
    pub const fn name(self) -> &'static str {
        match self {
            Features::Relative => "relative",
            Features::Appearance { .. } => "appearance",
            Features::Literal { .. } => "literal",
        }
    }

    /// Width of an observation's row.
    pub const fn step(self) -> usize {
        match self {
            Features::Relative | Features::Appearance { .. } => relative::STEP,
            Features::Literal { embedding } => embedding + literal::SPATIAL,
        }
    }

    /// Width of a candidate's row.
    pub const fn candidate(self) -> usize {
        match self {
            Features::Relative => relative::CANDIDATE,
            Features::Appearance { .. } => appearance::CANDIDATE,
            Features::Literal { .. } => self.step(),
        }
    }

    /// Whether embeddings are part of them.
    pub const fn see_appearance(self) -> bool {
        match self {
            Features::Relative => false,
            Features::Appearance { .. } => true,
            Features::Literal { embedding } => embedding > 0,
        }
    }

    /// Width that embeddings must have; `None` where none is seen.
    pub const fn embedding(self) -> Option<usize> {
        match self {
            Features::Appearance { embedding } => Some(embedding),
            Features::Literal { embedding } if embedding > 0 => Some(embedding),
            _ => None,
        }
    }
}

/// `relative`, `appearance N` or `literal N` with N numbers in an embedding.
impl fmt::Display for Features {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Features::Relative => f.write_str(self.name()),
            Features::Appearance { embedding } | Features::Literal { embedding } => {
                write!(f, "{} {embedding}", self.name())
            }
        }
    }
}

/// A text that names no features.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} names no features: \"relative\", \"appearance N\" and \"literal N\" (N numbers in an embedding) do"
)]
pub struct UnknownFeatures(String);

impl FromStr for Features {
    type Err = UnknownFeatures;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.split_once(' ') {
            None if text == "relative" => Some(Features::Relative),
            Some(("appearance", n)) => n.parse().ok().map(|embedding| Features::Appearance { embedding }),
            Some(("literal", n)) => n.parse().ok().map(|embedding| Features::Literal { embedding }),
            _ => None,
        }
        .ok_or_else(|| UnknownFeatures(text.into()))
    }
}

impl Features {
    /// Appends a track's history, `[HISTORY, step]` padded with zeros, to `out`; returns how many
    /// observations are valid. The picture is `(width, height)` pixels.
    pub fn push_history(self, track: &Tracklet, picture: (f64, f64), out: &mut Vec<f32>) -> usize {
        match self {
            Features::Relative | Features::Appearance { .. } => relative::push_history(track, out),
            Features::Literal { embedding } => literal::push_history(track, embedding, picture, out),
        }
        out.resize(out.len() + (super::HISTORY - track.history.len()) * self.step(), 0.0);
        track.history.len()
    }

    /// Appends a candidate's row to `out`.
    pub fn push_candidate(self, pair: &PairView<'_>, picture: (f64, f64), out: &mut Vec<f32>) {
        match self {
            Features::Relative => out.extend(relative::candidate(pair)),
            Features::Appearance { .. } => {
                out.extend(relative::candidate(pair));
                out.extend(appearance::likeness(pair));
            }
            Features::Literal { embedding } => literal::push_candidate(pair, embedding, picture, out),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_as_they_are_written() {
        for features in
            [Features::Relative, Features::Appearance { embedding: 9 }, Features::Literal { embedding: 128 }]
        {
            assert_eq!(features.to_string().parse(), Ok(features));
        }
        for wrong in ["", "Relative", "appearance", "literal", "literal -1", "literal 128 ", "literal  128"] {
            let error = wrong.parse::<Features>().expect_err(wrong);
            assert!(error.to_string().contains("appearance"), "{error}");
        }
        assert_eq!(Features::Literal { embedding: 128 }.step(), 134, "the paper's width");
    }
}
