//! Identifiers, one type each, so that none is taken for another.

use std::fmt;
use std::sync::Arc;

/// Whether a text can name a camera, a line, a zone or a token: 1 to 64 of `A-Z a-z 0-9 . _ -`, of which the first
/// is a letter or digit.
pub fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
        && text.as_bytes()[0].is_ascii_alphanumeric()
}

/// A camera's name: 1 to 64 of `A-Z a-z 0-9 . _ -`, so that it fits a URL and a metric label.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CameraId(Arc<str>);

/// Why a text is no camera name.
#[derive(Debug, thiserror::Error)]
#[error("camera name {0:?} is not usable: use 1 to 64 of A-Z a-z 0-9 . _ - and begin with a letter or digit")]
pub struct CameraIdError(pub String);

impl CameraId {
    /// Checks and takes a name.
    pub fn new(name: &str) -> Result<Self, CameraIdError> {
        if is_name(name) {
            Ok(Self(name.into()))
        } else {
            Err(CameraIdError(name.chars().take(80).collect()))
        }
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for CameraId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A class of the detector; the manifest names it. 0 is a person.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClassId(pub u16);

impl ClassId {
    /// The class every default is about.
    pub const PERSON: ClassId = ClassId(0);
}

/// A track's identity: unique within its camera and [`Epoch`], from 1, never used again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TrackId(pub u64);

impl fmt::Display for TrackId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// Grows whenever a camera's track ids start anew; `(epoch, id)` names a track for good.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Epoch(pub u64);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn camera_names() {
        for good in ["gate", "Gate-1", "a", "0.1_x"] {
            assert!(CameraId::new(good).is_ok(), "{good}");
        }
        for bad in ["", "-x", "a b", "a/b", "ä", &"x".repeat(65)] {
            assert!(CameraId::new(bad).is_err(), "{bad}");
        }
    }
}
