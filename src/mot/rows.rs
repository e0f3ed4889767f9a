//! The rows of `gt.txt`, `det.txt` and result files: text to [`Row`]s and back.
//!
//! | file | columns |
//! | --- | --- |
//! | truth of MOT16 on | frame, id, x, y, w, h, counts (0 or 1), class, visibility (may be missing) |
//! | truth of MOT15 | frame, id, x, y, w, h, counts (0 or 1), and a place in the world, not used here |
//! | detections | frame, -1, x, y, w, h, score, and whatever follows |
//! | results | frame, id, x, y, w, h, confidence, and whatever follows, usually three times -1 |
//!
//! Columns are separated by commas or white space. Blank lines are skipped.

use std::collections::HashMap;
use std::fmt::Write as _;

use crate::types::BBox;

/// One box of a MOTChallenge file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Frame, from 1.
    pub frame: u32,
    /// Identity, from 0; -1 in detections.
    pub id: i64,
    /// Where, pixels.
    pub bbox: BBox,
    /// Column 7: a detection's score (any scale), a result's confidence, and in truth whether the box
    /// counts (0: it does not).
    pub conf: f64,
    /// Class 1 (pedestrian) to 13; only truth of MOT16 on has one.
    pub class: Option<i32>,
    /// Visible part in `[0, 1]`; only truth of MOT16 on has one.
    pub visibility: Option<f64>,
}

/// What is wrong with a file, and where.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct RowError {
    /// Line, from 1.
    pub line: usize,
    /// What is wrong with it.
    pub problem: RowProblem,
}

/// What can be wrong with a row.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RowProblem {
    /// Too few or too many columns.
    #[error("{found} columns, expected {expected}")]
    Columns {
        /// Columns of the line.
        found: usize,
        /// What would be right.
        expected: String,
    },
    /// A column that does not hold what it must.
    #[error("column {column} ({name}) is {text:?}, expected {expected}")]
    Value {
        /// Column, from 1.
        column: usize,
        /// Its name.
        name: &'static str,
        /// What stands there.
        text: String,
        /// What would be right.
        expected: &'static str,
    },
    /// A frame that the sequence does not have.
    #[error(
        "frame {frame} is past the end of the sequence, which has {length} frames (seqLength of seqinfo.ini)"
    )]
    PastEnd {
        /// Frame of the row.
        frame: u32,
        /// Frames of the sequence.
        length: u32,
    },
    /// An identity in two boxes of one frame.
    #[error(
        "identity {id} is in frame {frame} a second time (first in line {first}), expected it once a frame at most"
    )]
    Duplicate {
        /// The identity.
        id: i64,
        /// The frame.
        frame: u32,
        /// Line that had it first.
        first: usize,
    },
}

/// Reads a `gt.txt`: 10 columns are MOT15's (no class), 8 or 9 those of MOT16 and later.
///
/// `length`: frames of the sequence, when known; rows beyond are errors.
///
/// # Errors
/// The first line that TrackEval would refuse or that makes no sense: a wrong number of columns, a
/// number that is none, a negative size, frame 0, a frame past the end, an unknown class, an identity
/// twice in one frame.
pub fn parse_truth(text: &str, length: Option<u32>) -> Result<Vec<Row>, RowError> {
    parse(text, Kind::Truth, length)
}

/// Reads a result file; see [`parse_truth`] for `length` and errors. Column 8 must not name another
/// class than pedestrian (1, or -1).
pub fn parse_results(text: &str, length: Option<u32>) -> Result<Vec<Row>, RowError> {
    parse(text, Kind::Results, length)
}

/// Reads a `det.txt`; see [`parse_truth`] for `length` and errors. Ids are not looked at: every row's
/// is -1. Scores keep the file's scale: MOT15's public detections (`det_public.txt`) go beyond `[0, 1]`.
pub fn parse_detections(text: &str, length: Option<u32>) -> Result<Vec<Row>, RowError> {
    parse(text, Kind::Detections, length)
}

/// Writes a `gt.txt` that [`parse_truth`] reads back as the same rows: MOT15's columns where a row has
/// no class.
pub fn write_truth(rows: &[Row]) -> String {
    let mut out = String::new();
    for row in rows {
        let Row { frame, id, bbox: BBox { x, y, w, h }, conf, .. } = row;
        let _ = write!(out, "{frame},{id},{x},{y},{w},{h},{conf}");
        let _ = match (row.class, row.visibility) {
            (None, _) => writeln!(out, ",-1,-1,-1"),
            (Some(class), None) => writeln!(out, ",{class}"),
            (Some(class), Some(visibility)) => writeln!(out, ",{class},{visibility}"),
        };
    }
    out
}

/// Writes a `det.txt` that [`parse_detections`] reads back as the same rows.
pub fn write_detections(rows: &[Row]) -> String {
    let mut out = String::new();
    for Row { frame, bbox: BBox { x, y, w, h }, conf, .. } in rows {
        let _ = writeln!(out, "{frame},-1,{x},{y},{w},{h},{conf},-1,-1,-1");
    }
    out
}

/// Writes a result file: boxes to 2 decimals, confidences to 4 at most, in the order of `rows`. The
/// same rows give the same bytes, and what was read back gives them again.
pub fn write_results(rows: &[Row]) -> String {
    let mut out = String::new();
    for Row { frame, id, bbox: BBox { x, y, w, h }, conf, .. } in rows {
        let _ = write!(out, "{frame},{id}");
        for value in [x, y, w, h] {
            let _ = write!(out, ",{:.2}", unsigned_zero(*value, 0.005));
        }
        let conf = format!("{:.4}", unsigned_zero(*conf, 0.00005));
        let _ = writeln!(out, ",{},-1,-1,-1", conf.trim_end_matches('0').trim_end_matches('.'));
    }
    out
}

/// Zero for what rounds to zero, so that no `-0.00` is written.
fn unsigned_zero(value: f64, half_step: f64) -> f64 {
    if value.abs() <= half_step { 0.0 } else { value }
}

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Truth,
    Results,
    Detections,
}

/// Beyond this a number is garbage, and areas of such boxes would overflow.
const LARGEST: f64 = 1e9;

fn parse(text: &str, kind: Kind, length: Option<u32>) -> Result<Vec<Row>, RowError> {
    let mut rows = Vec::new();
    let mut width = None;
    let mut seen = HashMap::new();
    let mut columns = Vec::new();
    for (index, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = line.trim();
        if line.is_empty() {
            continue;
        }
        let fail = |problem| RowError { line: index + 1, problem };
        columns.clear();
        if line.contains(',') {
            columns.extend(line.strip_suffix(',').unwrap_or(line).split(',').map(str::trim));
        } else {
            columns.extend(line.split_whitespace());
        }
        check_columns(kind, columns.len(), *width.get_or_insert(columns.len())).map_err(fail)?;
        let row = parse_row(kind, &columns).map_err(fail)?;
        if let Some(length) = length
            && row.frame > length
        {
            return Err(fail(RowProblem::PastEnd { frame: row.frame, length }));
        }
        if kind != Kind::Detections
            && let Some(first) = seen.insert((row.frame, row.id), index + 1)
        {
            return Err(fail(RowProblem::Duplicate { id: row.id, frame: row.frame, first }));
        }
        rows.push(row);
    }
    Ok(rows)
}

fn check_columns(kind: Kind, found: usize, first: usize) -> Result<(), RowProblem> {
    let expected = match kind {
        Kind::Truth if !(8..=10).contains(&found) => {
            "9 (MOT16 and later: frame, id, x, y, w, h, counts, class, \
             visibility) or 10 (MOT15: frame, id, x, y, w, h, counts, and three more)"
                .to_string()
        }
        Kind::Results | Kind::Detections if found < 7 => {
            "7 at least: frame, id, x, y, w, h, confidence".to_string()
        }
        _ if found != first => format!("{first} as in the lines before"),
        _ => return Ok(()),
    };
    Err(RowProblem::Columns { found, expected })
}

fn parse_row(kind: Kind, columns: &[&str]) -> Result<Row, RowProblem> {
    let number = |column: usize, name, expected, ok: &dyn Fn(f64) -> bool| {
        let text = columns[column - 1];
        match text.parse::<f64>() {
            Ok(value) if value.abs() <= LARGEST && ok(value) => Ok(value),
            _ => Err(RowProblem::Value { column, name, text: text.chars().take(40).collect(), expected }),
        }
    };
    let whole = |value: f64| value.fract() == 0.0;
    let frame = number(1, "frame", "a whole number from 1 on", &|v| whole(v) && v >= 1.0)? as u32;
    let id = match kind {
        Kind::Detections => -1,
        _ => number(2, "id", "a whole number from 0 on", &|v| whole(v) && v >= 0.0)? as i64,
    };
    const ANY: &str = "a finite number of pixels";
    const SIZE: &str = "a finite number of pixels, not negative";
    let bbox = BBox {
        x: number(3, "x", ANY, &|_| true)?,
        y: number(4, "y", ANY, &|_| true)?,
        w: number(5, "w", SIZE, &|v| v >= 0.0)?,
        h: number(6, "h", SIZE, &|v| v >= 0.0)?,
    };
    let conf = number(7, "confidence", "a finite number", &|_| true)?;
    let (mut class, mut visibility) = (None, None);
    match kind {
        Kind::Truth if columns.len() < 10 => {
            let known = |v| whole(v) && (1.0..=13.0).contains(&v);
            class = Some(number(8, "class", "MOTChallenge's 1 (pedestrian) to 13", &known)? as i32);
            if columns.len() == 9 {
                visibility = Some(number(9, "visibility", "a finite number", &|_| true)?);
            }
        }
        Kind::Results if columns.len() > 7 => {
            number(8, "class", "1 (pedestrian) or -1: other classes are not scored", &|v| v < 2.0)?;
        }
        _ => {}
    }
    Ok(Row { frame, id, bbox, conf, class, visibility })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_the_forms_of_the_benchmarks() {
        let classes =
            parse_truth("1,1,912,484,97,109,0,7,1\n\n2, 3, 10.5, -4, 5, 6, 1, 1, 0.25,\r\n", Some(2))
                .unwrap();
        let first = Row {
            frame: 1,
            id: 1,
            bbox: BBox::new(912.0, 484.0, 97.0, 109.0),
            conf: 0.0,
            class: Some(7),
            visibility: Some(1.0),
        };
        assert_eq!(classes[0], first);
        assert_eq!((classes[1].frame, classes[1].id, classes[1].visibility), (2, 3, Some(0.25)));
        let mot15 = parse_truth("1,2,181,95,75.808,227.01,1,4.4091,4.4283,0\n", None).unwrap();
        assert_eq!((mot15[0].class, mot15[0].conf), (None, 1.0));
        let public = parse_detections(
            "1,-1,45,184,62.22,141.19,50.514,-5.3,12.2,0.69\n1,-1,45,184,62,141,-0.5,1,2,3",
            None,
        );
        assert_eq!(
            public.unwrap().iter().map(|r| (r.id, r.conf)).collect::<Vec<_>>(),
            [(-1, 50.514), (-1, -0.5)]
        );
        let spaces = parse_results("1 7 1.0 2.0 3.0 4.0 1 -1 -1 -1", None).unwrap();
        assert_eq!((spaces[0].id, spaces[0].bbox), (7, BBox::new(1.0, 2.0, 3.0, 4.0)));
        assert_eq!(parse_results("", Some(5)), Ok(vec![]));
    }

    #[test]
    fn says_what_is_wrong_and_where() {
        let truth = |text| parse_truth(text, Some(10)).unwrap_err().to_string();
        let results = |text| parse_results(text, Some(10)).unwrap_err().to_string();
        for (message, expected) in [
            (results("1,1,1,1,1,1"), "line 1: 6 columns, expected 7 at least"),
            (
                results("1,1,1,1,1,1,1\n1,2,1,1,1,1,1,-1"),
                "line 2: 8 columns, expected 7 as in the lines before",
            ),
            (
                results("0,1,1,1,1,1,1"),
                "line 1: column 1 (frame) is \"0\", expected a whole number from 1 on",
            ),
            (results("1.5,1,1,1,1,1,1"), "column 1 (frame) is \"1.5\""),
            (results("1,-1,1,1,1,1,1"), "column 2 (id) is \"-1\", expected a whole number from 0 on"),
            (
                results("\n\n1,1,nan,1,1,1,1"),
                "line 3: column 3 (x) is \"nan\", expected a finite number of pixels",
            ),
            (results("1,1,1,inf,1,1,1"), "column 4 (y) is \"inf\""),
            (
                results("1,1,1,1,-3,1,1"),
                "column 5 (w) is \"-3\", expected a finite number of pixels, not negative",
            ),
            (results("1,1,1,1,1,1e300,1"), "column 6 (h) is \"1e300\""),
            (results("1,1,1,1,1,1,high"), "column 7 (confidence) is \"high\""),
            (results("1,1,1,1,1,1,1,3,-1,-1"), "column 8 (class) is \"3\", expected 1 (pedestrian) or -1"),
            (
                results("11,1,1,1,1,1,1"),
                "line 1: frame 11 is past the end of the sequence, which has 10 frames",
            ),
            (
                results("1,4,1,1,1,1,1\n1,4,9,9,1,1,1"),
                "line 2: identity 4 is in frame 1 a second time (first in line 1)",
            ),
            (truth("1,1,1,1,1,1,1"), "line 1: 7 columns, expected 9 (MOT16"),
            (truth("1,1,1,1,1,1,1,14,1"), "column 8 (class) is \"14\", expected MOTChallenge's 1"),
        ] {
            assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        }
    }

    #[test]
    fn results_are_written_as_the_benchmark_takes_them() {
        let row = |x, conf| Row {
            frame: 3,
            id: 12,
            bbox: BBox::new(x, -0.001, 10.126, 7.0),
            conf,
            class: None,
            visibility: None,
        };
        assert_eq!(
            write_results(&[row(1.0, 1.0), row(-2.5, 0.87654), row(0.0, 0.0)]),
            "3,12,1.00,0.00,10.13,7.00,1,-1,-1,-1\n\
             3,12,-2.50,0.00,10.13,7.00,0.8765,-1,-1,-1\n\
             3,12,0.00,0.00,10.13,7.00,0,-1,-1,-1\n"
        );
    }
}
