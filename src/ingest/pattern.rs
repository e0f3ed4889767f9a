//! The generated picture: `test:?pattern=ball&width=640&height=480&fps=25&frames=100`.

use super::SourceError;

/// What `test:` shows.
#[derive(Clone, Debug, PartialEq)]
pub struct TestPattern {
    /// A pattern of GStreamer's `videotestsrc`.
    pub pattern: String,
    /// Width in pixels, 16 to 8192.
    pub width: u32,
    /// Height in pixels, 16 to 8192.
    pub height: u32,
    /// Frames per second, 1 to 240.
    pub fps: u32,
    /// Ends after this many; `None` runs for ever.
    pub frames: Option<u32>,
}

impl Default for TestPattern {
    fn default() -> Self {
        Self { pattern: "ball".into(), width: 640, height: 480, fps: 25, frames: None }
    }
}

const PATTERNS: [&str; 12] = [
    "ball",
    "smpte",
    "snow",
    "black",
    "white",
    "red",
    "green",
    "blue",
    "circular",
    "gradient",
    "colors",
    "zone-plate",
];

impl TestPattern {
    /// Reads what follows `test:`; every option may be left out.
    pub(crate) fn parse(options: &str) -> Result<Self, SourceError> {
        let mut pattern = Self::default();
        let options = options.trim_start_matches('/').trim_start_matches('?');
        for pair in options.split('&').filter(|pair| !pair.is_empty()) {
            let (key, value) =
                pair.split_once('=').ok_or_else(|| bad(format!("test: option {pair:?} has no value")))?;
            let number = |range: std::ops::RangeInclusive<u32>| {
                value.parse().ok().filter(|n| range.contains(n)).ok_or_else(|| {
                    bad(format!("test: {key} must be {} to {}, not {value:?}", range.start(), range.end()))
                })
            };
            match key {
                "pattern" if PATTERNS.contains(&value) => pattern.pattern = value.to_owned(),
                "pattern" => {
                    return Err(bad(format!(
                        "test: no pattern {value:?}; there are {}",
                        PATTERNS.join(", ")
                    )));
                }
                "width" => pattern.width = number(16..=8192)?,
                "height" => pattern.height = number(16..=8192)?,
                "fps" => pattern.fps = number(1..=240)?,
                "frames" => pattern.frames = Some(number(1..=i32::MAX as u32)?),
                _ => {
                    return Err(bad(format!(
                        "test: no option {key:?}; there are pattern, width, height, fps, frames"
                    )));
                }
            }
        }
        Ok(pattern)
    }
}

fn bad(what: String) -> SourceError {
    SourceError::Url(what)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options() {
        assert_eq!(TestPattern::parse("").unwrap(), TestPattern::default());
        let p = TestPattern::parse("?pattern=snow&width=320&height=240&fps=10&frames=7").unwrap();
        assert_eq!((p.pattern.as_str(), p.width, p.height, p.fps, p.frames), ("snow", 320, 240, 10, Some(7)));
        for wrong in
            ["?pattern=no", "?width=0", "?width=x", "?fps=1000", "?colour=red", "?width", "?frames=0"]
        {
            assert!(TestPattern::parse(wrong).is_err(), "{wrong}");
        }
    }
}
