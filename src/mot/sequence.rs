//! A sequence as a tracker takes it: its facts and its detections frame by frame.

use super::{Row, RowError, SequenceInfo, parse_detections};
use crate::types::Detection;

/// A MOTChallenge sequence.
#[derive(Clone, Debug, PartialEq)]
pub struct Sequence {
    /// Facts of `seqinfo.ini`.
    pub info: SequenceInfo,
    /// Detections of every frame, `info.length` lists; frame `n` of the files is index `n - 1`.
    pub detections: Vec<Vec<Detection>>,
}

impl Sequence {
    /// Reads a `det.txt`, in the order of its rows. All detections are persons.
    ///
    /// Boxes without an area are left out: there is nothing to track. Scores outside of `[0, 1]`
    /// (MOT15's public detections, raw DPM) are cut to it: whoever published them chose their scale.
    ///
    /// # Errors
    /// See [`parse_detections`].
    pub fn parse(info: SequenceInfo, detections: &str) -> Result<Self, RowError> {
        let mut frames = vec![Vec::new(); info.length as usize];
        for row in parse_detections(detections, Some(info.length))? {
            if row.bbox.is_valid() {
                let detection = Detection::person(row.bbox, row.conf.clamp(0.0, 1.0));
                frames[row.frame as usize - 1].push(detection);
            }
        }
        Ok(Self { info, detections: frames })
    }

    /// The frames after [`first_half_length`], numbered from 1 again.
    pub fn second_half(mut self) -> Self {
        let skip = first_half_length(self.info.length).min(self.info.length);
        self.detections.drain(..skip as usize);
        self.info.length -= skip;
        self
    }
}

/// The footage of a sequence's name: MOT16 and MOT17 publish one sequence under the names
/// `MOT17-02-DPM`, `MOT17-02-SDP`, and so on. Whoever holds out a sequence must hold out all of them.
pub fn footage(name: &str) -> &str {
    let mut parts = name.match_indices('-');
    let second = parts.nth(1);
    match (name.starts_with("MOT"), second) {
        (true, Some((at, _))) => &name[..at],
        _ => name,
    }
}

/// Frames that make the first half of a sequence of `length` frames: what detectors such as YOLOX were
/// trained on. Frames after `length / 2 + 1` are the second half.
pub fn first_half_length(length: u32) -> u32 {
    length / 2 + 1
}

/// The rows of the second half of a sequence of `length` frames, numbered from 1 again.
pub fn second_half(rows: &[Row], length: u32) -> Vec<Row> {
    let skip = first_half_length(length);
    let kept = rows.iter().filter(|row| row.frame > skip);
    kept.map(|row| Row { frame: row.frame - skip, ..*row }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::BBox;

    fn info(length: u32) -> SequenceInfo {
        SequenceInfo { name: "a".into(), frame_rate: 25.0, length, width: 640, height: 480 }
    }

    #[test]
    fn detections_by_frame() {
        let text = "3,-1,1,2,3,4,0.5,-1,-1,-1\n1,-1,5,6,7,8,42.8,-1,-1,-1\n3,-1,9,9,0,5,0.5,-1,-1,-1\n";
        let sequence = Sequence::parse(info(4), text).unwrap();
        let person = |x, y, w, h, score| Detection::person(BBox::new(x, y, w, h), score);
        let expected = vec![
            vec![person(5.0, 6.0, 7.0, 8.0, 1.0)],
            vec![],
            vec![person(1.0, 2.0, 3.0, 4.0, 0.5)],
            vec![],
        ];
        assert_eq!(sequence.detections, expected);
        assert!(Sequence::parse(info(2), text).is_err());
    }

    #[test]
    fn halves() {
        let rows = parse_detections("1,-1,1,1,1,1,1\n6,-1,1,1,1,1,1\n7,-1,2,2,2,2,1\n10,-1,1,1,1,1,1", None)
            .unwrap();
        let half = second_half(&rows, 10);
        assert_eq!(half.iter().map(|row| row.frame).collect::<Vec<_>>(), [1, 4]);
        let text = super::super::write_detections(&rows);
        let sequence = Sequence::parse(info(10), &text).unwrap().second_half();
        assert_eq!(
            (sequence.info.length, sequence.detections.len(), sequence.detections[0].len()),
            (4, 4, 1)
        );
        assert_eq!(Sequence::parse(info(1), "").unwrap().second_half().info.length, 0);
    }
}
