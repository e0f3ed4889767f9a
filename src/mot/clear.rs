//! CLEAR MOT (Bernardin and Stiefelhagen 2008, "Evaluating Multiple Object Tracking Performance").

use super::hota::ratio;
use super::matching::best_pairs;
use super::preprocess::{MATCH_IOU, Scene};

/// CLEAR's counts.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Clear {
    /// Matches at an IoU of one half.
    pub tp: u64,
    /// Truth boxes without a match.
    pub fn_: u64,
    /// Result boxes without a match.
    pub fp: u64,
    /// Identity switches: a truth identity matched to another track than the last time.
    pub idsw: u64,
    /// Truth identities matched in more than 80 % of their boxes.
    pub mt: u64,
    /// Truth identities between [`Clear::mt`] and [`Clear::ml`].
    pub pt: u64,
    /// Truth identities matched in less than 20 % of their boxes.
    pub ml: u64,
    /// Fragmentations: times that a truth identity was found again after a loss.
    pub frag: u64,
    /// Sum of the IoUs of the matches.
    pub iou_sum: f64,
}

impl Clear {
    /// `1 - (FN + FP + IDSW) / truth boxes`; negative where errors outnumber truth, 0 without truth.
    pub fn mota(&self) -> f64 {
        match self.tp + self.fn_ {
            0 => 0.0,
            truth => (self.tp as f64 - self.fp as f64 - self.idsw as f64) / truth as f64,
        }
    }

    /// Mean IoU of the matches, 0 without any.
    pub fn motp(&self) -> f64 {
        self.iou_sum / self.tp.max(1) as f64
    }

    pub(super) fn of(scene: &Scene) -> Self {
        let mut out = Self::default();
        let identities = scene.truth_counts.len();
        if identities == 0 || scene.track_counts.is_empty() {
            return Self {
                fn_: scene.truth_boxes(),
                fp: scene.track_boxes(),
                ml: identities as u64,
                ..Self::default()
            };
        }
        let mut matched = vec![0; identities];
        let mut pieces = vec![0u64; identities];
        let mut last_track = vec![None; identities];
        let mut previous: Vec<Option<usize>> = vec![None; identities];
        for frame in &scene.frames {
            let (boxes, results) = (frame.truth.len() as u64, frame.tracks.len() as u64);
            // A frame without truth or results leaves `previous` as it is: TrackEval bridges it.
            if boxes == 0 || results == 0 {
                out.fn_ += boxes;
                out.fp += results;
                continue;
            }
            let score = |(row, col): (usize, usize), iou: f64| {
                let goes_on = previous[frame.truth[row]] == Some(frame.tracks[col]);
                match iou < MATCH_IOU {
                    true => 0.0,
                    false => f64::from(u8::from(goes_on)) * 1000.0 + iou,
                }
            };
            let mut pairs = best_pairs(&frame.similarity.map(score));
            pairs.retain(|&at| frame.similarity[at] >= MATCH_IOU);
            let mut now = vec![None; identities];
            for &(row, col) in &pairs {
                let (truth, track) = (frame.truth[row], frame.tracks[col]);
                out.idsw += u64::from(last_track[truth].is_some_and(|last| last != track));
                pieces[truth] += u64::from(previous[truth].is_none());
                matched[truth] += 1;
                last_track[truth] = Some(track);
                now[truth] = Some(track);
                out.iou_sum += frame.similarity[(row, col)];
            }
            previous = now;
            out.tp += pairs.len() as u64;
            out.fn_ += boxes - pairs.len() as u64;
            out.fp += results - pairs.len() as u64;
        }
        for (matched, count) in matched.into_iter().zip(&scene.truth_counts) {
            let part = ratio(matched, *count);
            match part {
                _ if part > 0.8 => out.mt += 1,
                _ if part >= 0.2 => out.pt += 1,
                _ => out.ml += 1,
            }
        }
        out.frag = pieces.iter().map(|n| n.saturating_sub(1)).sum();
        out
    }

    pub(super) fn combine<'a>(parts: impl Iterator<Item = &'a Clear>) -> Self {
        parts.fold(Self::default(), |a, b| Self {
            tp: a.tp + b.tp,
            fn_: a.fn_ + b.fn_,
            fp: a.fp + b.fp,
            idsw: a.idsw + b.idsw,
            mt: a.mt + b.mt,
            pt: a.pt + b.pt,
            ml: a.ml + b.ml,
            frag: a.frag + b.frag,
            iou_sum: a.iou_sum + b.iou_sum,
        })
    }
}
