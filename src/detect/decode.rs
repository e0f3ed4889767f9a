//! What the decoders share: the output of one picture, the grid, the classes that are wanted.

use super::nms::Candidate;
use super::{nanodet, yolov8, yolox};
use crate::infer::Family;

/// What to look for in an output.
#[derive(Clone, Debug)]
pub(super) struct Wanted {
    /// Boxes below it are dropped.
    pub threshold: f32,
    /// Whether each class is wanted.
    pub classes: Vec<bool>,
}

impl Wanted {
    /// The best wanted class of `scores` if it reaches the threshold.
    pub(super) fn best(&self, scores: impl Iterator<Item = f32>) -> Option<(u16, f32)> {
        let mut best = None;
        let mut least = self.threshold;
        for (class, (score, wanted)) in scores.zip(&self.classes).enumerate() {
            if *wanted && score >= least && best.is_none_or(|(_, s)| score > s) {
                least = score;
                best = Some((class as u16, score));
            }
        }
        best
    }
}

/// Reads the output of one picture.
#[derive(Clone, Debug)]
pub(super) struct Decoder {
    pub family: Family,
    pub strides: Vec<usize>,
    pub wanted: Wanted,
}

impl Decoder {
    /// Appends what `output` (of shape `axes`, without the batch) holds for an input of `width` x
    /// `height`.
    ///
    /// # Errors
    /// When the output has another shape than the input's size gives.
    pub(super) fn decode(
        &self,
        output: &[f32],
        axes: [usize; 2],
        (width, height): (usize, usize),
        found: &mut Vec<Candidate>,
    ) -> Result<(), String> {
        let classes = self.wanted.classes.len();
        let (channel_axis, extra) = match self.family {
            Family::Nanodet => (1, nanodet::EXTRA),
            Family::Yolox => (1, yolox::EXTRA),
            _ => (0, yolov8::EXTRA),
        };
        let points: usize = self.grid(width, height).map(|level| level.columns * level.rows).sum();
        let gridless = self.family == Family::Yolov8;
        if axes[channel_axis] != classes + extra || !(gridless || axes[0] == points) {
            return Err(format!(
                "the output of one picture is {axes:?}; {points} points of {} values are expected of a \
                 {width}x{height} input",
                classes + extra
            ));
        }
        match self.family {
            Family::Nanodet => nanodet::decode(output, self.grid(width, height), &self.wanted, found),
            Family::Yolox => yolox::decode(output, self.grid(width, height), &self.wanted, found),
            _ => yolov8::decode(output, axes[1], &self.wanted, found),
        }
        Ok(())
    }

    fn grid(&self, width: usize, height: usize) -> impl Iterator<Item = Level> {
        self.strides.iter().map(move |&stride| Level {
            stride: stride as f32,
            columns: width.div_ceil(stride),
            rows: height.div_ceil(stride),
        })
    }
}

/// One level of a detector's grid, row-major.
#[derive(Clone, Copy, Debug)]
pub(super) struct Level {
    pub stride: f32,
    pub columns: usize,
    pub rows: usize,
}

impl Level {
    /// `(column, row)` of every point.
    pub(super) fn points(self) -> impl Iterator<Item = (f32, f32)> {
        (0..self.rows).flat_map(move |row| (0..self.columns).map(move |column| (column as f32, row as f32)))
    }
}
