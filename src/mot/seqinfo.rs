//! `seqinfo.ini`: what a sequence folder says about its sequence.

use std::fmt::Write as _;

/// A sequence's facts.
#[derive(Clone, Debug, PartialEq)]
pub struct SequenceInfo {
    /// Name as the file has it; copies of a sequence may keep another's name, so folders are told
    /// apart by their own names.
    pub name: String,
    /// Frames per second.
    pub frame_rate: f64,
    /// Number of frames, `1..=MAX_LENGTH`.
    pub length: u32,
    /// Width of the images, pixels.
    pub width: u32,
    /// Height of the images, pixels.
    pub height: u32,
}

/// What is wrong with a `seqinfo.ini`.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SeqInfoError {
    /// A line that is neither section, comment nor `key = value`.
    #[error("line {line}: {text:?} is no `key=value`")]
    Line {
        /// Line, from 1.
        line: usize,
        /// What stands there.
        text: String,
    },
    /// A key that is needed.
    #[error("{key} is missing from section [Sequence]")]
    Missing {
        /// The key.
        key: &'static str,
    },
    /// A value that cannot be.
    #[error("line {line}: {key} is {text:?}, expected {expected}")]
    Value {
        /// Line, from 1.
        line: usize,
        /// The key.
        key: &'static str,
        /// What stands there.
        text: String,
        /// What would be right.
        expected: &'static str,
    },
}

/// Frames that a sequence may have: four days at 25 a second. A larger number is a mistake, and memory
/// is set aside by it.
const MAX_LENGTH: u32 = 10_000_000;

impl SequenceInfo {
    /// Reads a `seqinfo.ini`. Keys are compared without case; other keys and sections are passed over.
    ///
    /// # Errors
    /// A line that cannot be read, a missing key of the five, or a value that cannot be.
    pub fn parse(text: &str) -> Result<Self, SeqInfoError> {
        let mut section = String::new();
        let mut entries: Vec<(usize, String, &str)> = Vec::new();
        for (index, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line.starts_with(['#', ';']) {
                continue;
            }
            if let Some(name) = line.strip_prefix('[').and_then(|l| l.strip_suffix(']')) {
                section = name.trim().to_string();
                continue;
            }
            let Some((key, value)) = line.split_once(['=', ':']) else {
                return Err(SeqInfoError::Line { line: index + 1, text: line.chars().take(80).collect() });
            };
            if section == "Sequence" {
                entries.push((index + 1, key.trim().to_ascii_lowercase(), value.trim()));
            }
        }
        let find = |key: &'static str| {
            let wanted = key.to_ascii_lowercase();
            let entry = entries.iter().rev().find(|(_, k, _)| *k == wanted);
            entry.map(|(line, _, value)| (*line, *value)).ok_or(SeqInfoError::Missing { key })
        };
        let whole = |key, most: u32, expected| {
            let (line, text) = find(key)?;
            match text.parse::<u32>() {
                Ok(value) if (1..=most).contains(&value) => Ok(value),
                _ => Err(SeqInfoError::Value { line, key, text: text.to_string(), expected }),
            }
        };
        let (line, rate) = find("frameRate")?;
        let frame_rate = match rate.parse::<f64>() {
            Ok(value) if value > 0.0 && value <= 1e6 => value,
            _ => {
                let expected = "frames per second, above 0";
                return Err(SeqInfoError::Value { line, key: "frameRate", text: rate.to_string(), expected });
            }
        };
        Ok(Self {
            name: find("name")?.1.to_string(),
            frame_rate,
            length: whole("seqLength", MAX_LENGTH, "a whole number of frames, 1 to 10000000")?,
            width: whole("imWidth", u32::MAX, "a whole number of pixels, at least 1")?,
            height: whole("imHeight", u32::MAX, "a whole number of pixels, at least 1")?,
        })
    }

    /// Writes a `seqinfo.ini` that [`SequenceInfo::parse`] reads back as the same.
    pub fn write(&self) -> String {
        let mut out = String::new();
        let Self { name, frame_rate, length, width, height } = self;
        let _ = writeln!(out, "[Sequence]\nname={name}\nframeRate={frame_rate}\nseqLength={length}");
        let _ = writeln!(out, "imWidth={width}\nimHeight={height}");
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "[Sequence]\r\nname=MOT17-02-DPM\nimDir=img1\nframeRate = 30\nseqlength: 600\n\
                        imWidth=1920\n; a comment\nimHeight=1080\nimExt=.jpg\n\n[Other]\nseqLength=9\n";

    #[test]
    fn reads_and_writes() {
        let info = SequenceInfo::parse(GOOD).unwrap();
        let expected = SequenceInfo {
            name: "MOT17-02-DPM".into(),
            frame_rate: 30.0,
            length: 600,
            width: 1920,
            height: 1080,
        };
        assert_eq!(info, expected);
        assert_eq!(SequenceInfo::parse(&info.write()).unwrap(), info);
    }

    #[test]
    fn says_what_is_wrong() {
        for (from, to, expected) in [
            ("imWidth=1920\n", "", "imWidth is missing from section [Sequence]"),
            (
                "frameRate = 30",
                "frameRate = fast",
                "line 4: frameRate is \"fast\", expected frames per second",
            ),
            (
                "seqlength: 600",
                "seqlength: 0",
                "line 5: seqLength is \"0\", expected a whole number of frames",
            ),
            ("seqlength: 600", "seqlength: 4000000000", "seqLength is \"4000000000\""),
            ("imDir=img1", "imDir", "line 3: \"imDir\" is no `key=value`"),
            ("[Sequence]", "[Camera]", "frameRate is missing"),
        ] {
            let message = SequenceInfo::parse(&GOOD.replace(from, to)).unwrap_err().to_string();
            assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        }
    }
}
