//! `det_features.npy`: an appearance vector for each row of `det.txt`.

use super::npy::{NpyError, parse_npy};
use super::{RowError, SequenceInfo, first_half_length, parse_detections};
use crate::types::Embedding;

/// Embeddings of a sequence: of every frame one entry a detection, as [`super::Sequence`] has them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SequenceEmbeddings {
    width: Option<usize>,
    frames: Vec<Vec<Option<Embedding>>>,
}

/// Why features do not fit a sequence.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FeatureError {
    /// Not a matrix.
    #[error(transparent)]
    Npy(#[from] NpyError),
    /// Wrong detections.
    #[error("det.txt: {0}")]
    Detections(#[from] RowError),
    /// Another number of rows.
    #[error("{features} rows of features, but det.txt has {detections} rows: they must be in the same order")]
    Rows {
        /// Rows of features.
        features: usize,
        /// Rows of detections.
        detections: usize,
    },
    /// Too few columns.
    #[error("{0} columns: expected frame, id, x, y, w, h, score and then the features, or features alone")]
    Columns(usize),
    /// A row of another box.
    #[error("row {row} of the features is of another box than row {row} of det.txt")]
    Order {
        /// Row, from 1.
        row: usize,
    },
}

impl SequenceEmbeddings {
    /// Reads features for the rows of `detections` (the text of `det.txt`).
    ///
    /// Rows either hold features alone, or repeat their detection before them: the seven columns frame,
    /// id, x, y, w, h, score, or these and three times -1, as DeepSORT writes. A repeated detection must
    /// be that of its row.
    ///
    /// # Errors
    /// See [`FeatureError`].
    pub fn parse(bytes: &[u8], detections: &str, info: &SequenceInfo) -> Result<Self, FeatureError> {
        let matrix = parse_npy(bytes)?;
        let rows = parse_detections(detections, Some(info.length))?;
        if matrix.rows != rows.len() {
            return Err(FeatureError::Rows { features: matrix.rows, detections: rows.len() });
        }
        // Components of unit vectors are within 1; frames and ids repeat what the text says.
        let named = |row: usize| {
            let values = matrix.row(row);
            values.len() > 7 && values[0] == f64::from(rows[row].frame) && values[1] == -1.0
        };
        let repeats = !rows.is_empty() && (0..rows.len()).all(named);
        let world = |row: usize| matrix.row(row).get(7..10).is_some_and(|v| v == [-1.0; 3]);
        let skip = match repeats {
            true if (0..rows.len()).all(world) => 10,
            true => 7,
            false => 0,
        };
        if matrix.columns <= skip {
            return Err(FeatureError::Columns(matrix.columns));
        }
        let mut frames = vec![Vec::new(); info.length as usize];
        for (index, row) in rows.iter().enumerate() {
            let values = matrix.row(index);
            let b = row.bbox;
            let near = |(a, b): (&f64, f64)| (a - b).abs() <= 0.5;
            if repeats && !values[2..6].iter().zip([b.x, b.y, b.w, b.h]).all(near) {
                return Err(FeatureError::Order { row: index + 1 });
            }
            if b.is_valid() {
                let vector = values[skip..].iter().map(|v| *v as f32).collect();
                frames[row.frame as usize - 1].push(Embedding::normalised(vector));
            }
        }
        Ok(Self { width: Some(matrix.columns - skip), frames })
    }

    /// The embeddings of a 0-based frame's detections; none past the end.
    pub fn frame(&self, index: usize) -> &[Option<Embedding>] {
        self.frames.get(index).map_or(&[], Vec::as_slice)
    }

    /// Numbers in an embedding; `None` where no file was read.
    pub fn width(&self) -> Option<usize> {
        self.width
    }

    /// Those of the frames after [`first_half_length`], as [`super::Sequence::second_half`].
    pub fn second_half(mut self) -> Self {
        let skip = (first_half_length(self.frames.len() as u32) as usize).min(self.frames.len());
        self.frames.drain(..skip);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mot::Sequence;

    fn npy(columns: usize, values: &[f64]) -> Vec<u8> {
        let shape = (values.len() / columns, columns);
        let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape:?}, }}");
        let mut bytes = [b"\x93NUMPY\x01\x00".as_slice(), &(header.len() as u16).to_le_bytes()].concat();
        bytes.extend(header.as_bytes());
        bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        bytes
    }

    const DET: &str = "2,-1,5,6,7,8,1\n1,-1,1,2,3,4,1\n2,-1,9,9,0,5,1\n2,-1,3,3,3,3,1\n";

    fn info() -> SequenceInfo {
        SequenceInfo { name: "a".into(), frame_rate: 25.0, length: 4, width: 64, height: 48 }
    }

    #[test]
    fn each_detection_gets_its_own() {
        let alone = npy(2, &[3.0, 4.0, 0.0, 2.0, 1.0, 1.0, 0.0, 0.0]);
        let repeated = npy(
            9,
            &[
                [2.0, -1.0, 5.0, 6.0, 7.0, 8.0, 0.3, 3.0, 4.0],
                [1.0, -1.0, 1.0, 2.0, 3.0, 4.0, 0.3, 0.0, 2.0],
                [2.0, -1.0, 9.0, 9.0, 0.0, 5.0, 0.3, 1.0, 1.0],
                [2.0, -1.0, 3.0, 3.0, 3.0, 3.0, 0.3, 0.0, 0.0],
            ]
            .concat(),
        );
        let sequence = Sequence::parse(info(), DET).unwrap();
        for bytes in [alone, repeated] {
            let found = SequenceEmbeddings::parse(&bytes, DET, &info()).unwrap();
            for (frame, detections) in sequence.detections.iter().enumerate() {
                assert_eq!(found.frame(frame).len(), detections.len(), "frame {frame}");
            }
            assert_eq!(found.frame(0)[0].as_ref().unwrap().as_slice(), [0.0, 1.0]);
            assert_eq!(found.frame(1)[0].as_ref().unwrap().as_slice(), [0.6, 0.8]);
            // The box without an area is no detection; the vector without a length no appearance.
            assert_eq!(found.frame(1)[1], None);
            assert!(found.frame(9).is_empty());
            assert_eq!(found.second_half(), SequenceEmbeddings { width: Some(2), frames: vec![vec![]] });
        }
    }

    #[test]
    fn misfits_are_named() {
        let wrong = |bytes: &[u8]| SequenceEmbeddings::parse(bytes, DET, &info()).unwrap_err().to_string();
        assert!(wrong(&npy(2, &[1.0; 6])).contains("3 rows of features, but det.txt has 4 rows"));
        assert!(wrong(b"x").contains("not a NumPy array file"));
        let mut rows = vec![[2.0, -1.0, 5.0, 6.0, 7.0, 8.0, 1.0, 3.0, 4.0]; 4];
        rows[1] = [1.0, -1.0, 1.0, 2.0, 3.0, 9.0, 1.0, 3.0, 4.0];
        assert!(wrong(&npy(9, &rows.concat())).contains("row 2 of the features is of another box"));
    }
}
