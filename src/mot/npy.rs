//! NumPy's array files, as far as features need them: two dimensions of little-endian floats.
//!
//! Format: <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>.

/// A matrix, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Matrix {
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub columns: usize,
    /// `rows * columns` values.
    pub values: Vec<f64>,
}

impl Matrix {
    /// One row.
    ///
    /// # Panics
    /// When there is no such row.
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[row * self.columns..(row + 1) * self.columns]
    }
}

/// Why a file is no matrix.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NpyError {
    /// It does not begin as NumPy's files do, or its header ends too early.
    #[error("not a NumPy array file (.npy)")]
    NotNpy,
    /// A header that says something else than what is expected.
    #[error("its header {header:?} is not {expected}")]
    Header {
        /// The header.
        header: String,
        /// What would be right.
        expected: &'static str,
    },
    /// Fewer or more bytes than the header promises.
    #[error("{found} bytes of values, its header promises {expected}")]
    Size {
        /// Bytes that are there.
        found: usize,
        /// Bytes promised.
        expected: usize,
    },
}

/// Reads a `.npy` file of `float32` or `float64` in two dimensions, C order.
///
/// # Errors
/// Not such a file; see [`NpyError`].
pub fn parse_npy(bytes: &[u8]) -> Result<Matrix, NpyError> {
    let rest = bytes.strip_prefix(b"\x93NUMPY").ok_or(NpyError::NotNpy)?;
    let (version, rest) = rest.split_at_checked(2).ok_or(NpyError::NotNpy)?;
    let width = if version[0] == 1 { 2 } else { 4 };
    let (length, rest) = rest.split_at_checked(width).ok_or(NpyError::NotNpy)?;
    let length = length.iter().rev().fold(0usize, |sum, byte| sum << 8 | usize::from(*byte));
    let (header, data) = rest.split_at_checked(length).ok_or(NpyError::NotNpy)?;
    let header = std::str::from_utf8(header).map_err(|_| NpyError::NotNpy)?.trim();
    let wrong = |expected| NpyError::Header { header: header.into(), expected };

    let size = match value(header, "descr") {
        Some(descr) if descr.starts_with("'<f8'") => 8,
        Some(descr) if descr.starts_with("'<f4'") => 4,
        _ => return Err(wrong("of little-endian floats ('descr': '<f4' or '<f8')")),
    };
    if !value(header, "fortran_order").is_some_and(|order| order.starts_with("False")) {
        return Err(wrong("in C order ('fortran_order': False)"));
    }
    let two = wrong("of two dimensions ('shape': (rows, columns))");
    let shape = value(header, "shape").and_then(|s| s.strip_prefix('(')?.split_once(')'));
    let shape: Option<Vec<usize>> =
        shape.map(|(inside, _)| inside.split(',').map(|n| n.trim().parse().ok()).collect()).unwrap_or(None);
    let Some([rows, columns]) = shape.as_deref().and_then(|s| <[usize; 2]>::try_from(s).ok()) else {
        return Err(two);
    };
    let expected = rows.checked_mul(columns).and_then(|n| n.checked_mul(size)).ok_or(two)?;
    if data.len() != expected {
        return Err(NpyError::Size { found: data.len(), expected });
    }
    let values = match size {
        8 => data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        _ => data.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
    };
    Ok(Matrix { rows, columns, values })
}

/// A `.npy` file of `float64`, C order.
pub fn write_npy(matrix: &Matrix) -> Vec<u8> {
    let Matrix { rows, columns, values } = matrix;
    let mut header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    // The values begin at a multiple of 64 bytes; ten come before the header.
    let padded = (header.len() + 1 + 10).next_multiple_of(64) - 10;
    header.push_str(&" ".repeat(padded - header.len() - 1));
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    bytes
}

/// What follows `'key':` in the header's dictionary.
fn value<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let (_, rest) = header.split_once(&format!("'{key}'"))?;
    Some(rest.trim_start().strip_prefix(':')?.trim_start())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(header: &str, data: &[u8]) -> Vec<u8> {
        [b"\x93NUMPY\x01\x00".as_slice(), &(header.len() as u16).to_le_bytes(), header.as_bytes(), data]
            .concat()
    }

    #[test]
    fn floats_of_both_sizes() {
        let wide: Vec<u8> = [1.5f64, -2.0, 0.0, 4.0, 5.0, 6.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }      \n";
        let found = parse_npy(&file(header, &wide)).unwrap();
        assert_eq!((found.rows, found.columns, found.row(1)), (2, 3, &[4.0, 5.0, 6.0][..]));
        let narrow: Vec<u8> = [1.5f32, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let header = "{'shape': (1, 2), 'fortran_order': False, 'descr': '<f4'}";
        assert_eq!(parse_npy(&file(header, &narrow)).unwrap().values, [1.5, -2.0]);
        assert_eq!(parse_npy(&write_npy(&found)), Ok(found));
        let empty = "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 128), }";
        assert_eq!(parse_npy(&file(empty, &[])).unwrap().rows, 0);
    }

    #[test]
    fn other_files_are_refused_with_a_reason() {
        for (header, data, expected) in [
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (2, 1), }", &[0; 8][..], "8 bytes of values"),
            ("{'descr': '>f8', 'fortran_order': False, 'shape': (1, 1), }", &[0; 8], "little-endian floats"),
            ("{'descr': '<f8', 'fortran_order': True, 'shape': (1, 1), }", &[0; 8], "C order"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }", &[0; 8], "two dimensions"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999999999999, 9), }", &[], "two dim"),
        ] {
            let message = parse_npy(&file(header, data)).unwrap_err().to_string();
            assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        }
        for bytes in [&b""[..], b"PK\x03\x04", b"\x93NUMPY\x01", b"\x93NUMPY\x01\x00\xff\xff{}"] {
            assert_eq!(parse_npy(bytes), Err(NpyError::NotNpy));
        }
    }
}
