//! The best picture of each track, where pictures are kept.
//!
//! Once a second each camera's newest picture is looked at: a track whose box shows more of it than before, larger,
//! surer and not cut off by the border, is cut out of it.

use std::collections::HashMap;
use std::sync::Arc;

use tokio::task::spawn_blocking;

use super::recorder::TrackKey;
use crate::publish::{Picture, PictureError, Rgb, RgbConverter};
use crate::types::{TrackReport, TrackState};

/// How much better a picture must be to take the place of the last one.
const BETTER: f64 = 1.2;
/// Part of the box's height that is shown around it.
const AROUND: f64 = 0.08;
/// JPEG quality.
const QUALITY: u8 = 85;
/// Tracks whose best picture is remembered at most.
const MAX_KNOWN: usize = 10_000;

/// Gives the newest picture of each camera.
pub type Pictures = Arc<dyn Fn() -> Vec<Arc<Picture>> + Send + Sync>;

/// A track's picture.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// Whose.
    pub key: TrackKey,
    /// How good it is; only the order means anything.
    pub score: f64,
    /// The picture.
    pub jpeg: Vec<u8>,
}

/// Knows the best picture of each track so far.
#[derive(Default)]
pub struct Album {
    best: HashMap<TrackKey, f64>,
}

impl Album {
    /// Pictures that are better than those kept.
    pub async fn look(&self, pictures: &Pictures) -> Vec<Snapshot> {
        let mut found = vec![];
        for picture in pictures() {
            let wanted: Vec<_> =
                picture.tracks.tracks.iter().filter_map(|t| self.wanted(&picture, t)).collect();
            if wanted.is_empty() {
                continue;
            }
            let cut = spawn_blocking(move || cut_out(&picture, wanted)).await;
            match cut {
                Ok(Ok(snapshots)) => found.extend(snapshots),
                Ok(Err(error)) => tracing::warn!("a snapshot could not be made: {error}"),
                Err(error) => tracing::warn!("a snapshot could not be made: {error}"),
            }
        }
        found
    }

    /// It was kept.
    pub fn kept(&mut self, snapshot: &Snapshot) {
        if self.best.len() >= MAX_KNOWN {
            // Whose picture is forgotten here may get another one that is not better: rare and harmless.
            self.best.clear();
        }
        self.best.insert(snapshot.key.clone(), snapshot.score);
    }

    fn wanted(&self, picture: &Picture, track: &TrackReport) -> Option<(TrackKey, TrackReport, f64)> {
        let report = &picture.tracks;
        let (width, height) = (f64::from(report.width), f64::from(report.height));
        let b = &track.bbox;
        if track.state != TrackState::Confirmed || !track.matched || width < 1.0 || height < 1.0 {
            return None;
        }
        let whole = b.x > 1.0 && b.y > 1.0 && b.x + b.w < width - 1.0 && b.y + b.h < height - 1.0;
        let score =
            track.confidence * (b.w * b.h / (width * height)).max(0.0).sqrt() * if whole { 1.0 } else { 0.3 };
        let key = TrackKey { camera: report.camera.clone(), epoch: report.epoch, id: track.id };
        let better = self.best.get(&key).is_none_or(|best| score > best * BETTER);
        better.then_some((key, *track, score))
    }
}

fn cut_out(
    picture: &Picture,
    wanted: Vec<(TrackKey, TrackReport, f64)>,
) -> Result<Vec<Snapshot>, PictureError> {
    let mut canvas = Rgb::default();
    RgbConverter::default().convert(picture, usize::MAX, &mut canvas)?;
    let mut snapshots = vec![];
    for (key, track, score) in wanted {
        let (b, around) = (track.bbox, AROUND * track.bbox.h);
        let part = canvas.part([b.x - around, b.y - around, b.x + b.w + around, b.y + b.h + around]);
        if part.width > 0 && part.height > 0 {
            snapshots.push(Snapshot { key, score, jpeg: part.to_jpeg(QUALITY)? });
        }
    }
    Ok(snapshots)
}
