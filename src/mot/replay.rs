//! A MOTChallenge sequence through the tracker: the offline driver of the core.

use super::{Row, Sequence};
use crate::track::{FrameInput, LinkRequest, Tracker, TrackerConfig};
use crate::types::{Embedding, FrameTracks, MediaTime, TrackReport, TrackState};

/// Tracks `sequence` from its first frame to its last. `score` answers the pairs of a frame (it is
/// never called without any); `embeddings` gives those of a 0-based frame's detections, or none.
///
/// # Errors
/// Whatever `score` fails with.
pub fn replay<E>(
    sequence: &Sequence,
    config: &TrackerConfig,
    mut embeddings: impl FnMut(usize) -> Vec<Option<Embedding>>,
    mut score: impl FnMut(&LinkRequest) -> Result<Vec<f32>, E>,
) -> Result<Vec<Row>, E> {
    let mut tracker = Tracker::new(config.clone());
    let mut request = LinkRequest::default();
    let mut rows = Vec::new();
    for (index, detections) in sequence.detections.iter().enumerate() {
        let embeddings = embeddings(index);
        let frame = FrameInput {
            time: MediaTime::from_secs(index as f64 / sequence.info.frame_rate),
            width: f64::from(sequence.info.width),
            height: f64::from(sequence.info.height),
            detections,
            embeddings: &embeddings,
            shift: None,
        };
        tracker.predict(frame, &mut request);
        let links = if request.is_empty() { Vec::new() } else { score(&request)? };
        let update = tracker.update(&links).unwrap_or_default();
        rows.extend(result_rows(index as u32 + 1, &update.tracks));
    }
    Ok(rows)
}

/// The rows of one frame (1-based number): confirmed tracks, which are those that the tracker stands
/// for. Tentative and lost ones are no results.
pub fn result_rows(frame: u32, tracks: &[TrackReport]) -> impl Iterator<Item = Row> {
    tracks.iter().filter(|t| t.state == TrackState::Confirmed).map(move |t| Row {
        frame,
        id: i64::try_from(t.id.0).unwrap_or(i64::MAX),
        bbox: t.bbox,
        conf: t.confidence,
        class: None,
        visibility: None,
    })
}

/// The rows of a report of the service: its 0-based frame is the 1-based row.
pub fn report_rows(report: &FrameTracks) -> impl Iterator<Item = Row> {
    result_rows(u32::try_from(report.frame + 1).unwrap_or(u32::MAX), &report.tracks)
}
