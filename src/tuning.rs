//! The tuning file: noise of the Kalman filter, as `gakp tune` writes it and `serve` and `track` take it.
//!
//! ```toml
//! [filter]                     # names and units of `FilterConfig`; what is left out stays the link network's, or the default
//! centre_acceleration = 0.41
//! centre_measurement = 0.038
//!
//! [origin]                     # where the numbers come from; nothing reads it
//! statistic = "NEES"
//! cost = "likelihood"
//! data = ["MOT17-02-SDP"]
//! ```

use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::track::FilterConfig;

/// A tuning file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tuning {
    /// `[filter]`.
    pub filter: FilterTuning,
    /// `[origin]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<Origin>,
}

/// `[filter]`: what it sets of [`FilterConfig`], whose fields say what each means and in which unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FilterTuning {
    /// [`FilterConfig::centre_acceleration`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub centre_acceleration: Option<f64>,
    /// [`FilterConfig::size_acceleration`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size_acceleration: Option<f64>,
    /// [`FilterConfig::centre_walk`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub centre_walk: Option<f64>,
    /// [`FilterConfig::size_walk`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size_walk: Option<f64>,
    /// [`FilterConfig::centre_measurement`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub centre_measurement: Option<f64>,
    /// [`FilterConfig::size_measurement`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size_measurement: Option<f64>,
    /// [`FilterConfig::birth_centre_velocity`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub birth_centre_velocity: Option<f64>,
    /// [`FilterConfig::birth_size_velocity`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub birth_size_velocity: Option<f64>,
    /// [`FilterConfig::size_velocity_decay`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size_velocity_decay: Option<f64>,
}

/// `[origin]`: how a tuning came about.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    /// `NEES` or `NIS`.
    pub statistic: String,
    /// `likelihood` or `consistency`.
    pub cost: String,
    /// Sequences that were tuned on.
    pub data: Vec<String>,
    /// Trials a group of axes.
    pub evaluations: usize,
    /// Seed of the search.
    pub seed: u64,
    /// Cost of centre and size before.
    pub cost_before: [f64; 2],
    /// Cost of centre and size after.
    pub cost_after: [f64; 2],
}

/// Why a tuning file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TuningError {
    /// It cannot be read.
    #[error("cannot read the tuning file {}: {reason}", path.display())]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        reason: std::io::Error,
    },
    /// It is no TOML, or has a key that does not exist.
    #[error("in the tuning file {}: {message}", path.display())]
    Parse {
        /// Which.
        path: PathBuf,
        /// What is wrong, with its line.
        message: String,
    },
    /// A number that no filter can work with.
    #[error(
        "in the tuning file {}: filter.{key} = {value}: must be more than {MIN} and at most {MAX}",
        path.display()
    )]
    Value {
        /// Which file.
        path: PathBuf,
        /// Which key.
        key: &'static str,
        /// What it says.
        value: f64,
    },
}

/// Values must lie above this: a variance of zero makes the filter deaf or blind.
const MIN: f64 = 0.0;
/// Values may reach this: a hundred box heights are wider than any picture.
const MAX: f64 = 100.0;

impl Tuning {
    /// Reads a file.
    ///
    /// # Errors
    /// It cannot be read, has an unknown key, or a value that is wrong; the message names file and key.
    pub fn read(path: &Path) -> Result<Self, TuningError> {
        let text =
            fs::read_to_string(path).map_err(|reason| TuningError::Read { path: path.to_owned(), reason })?;
        let tuning: Self = toml::from_str(&text)
            .map_err(|error| TuningError::Parse { path: path.to_owned(), message: error.to_string() })?;
        if let Some((key, value)) = tuning.filter.mistake() {
            return Err(TuningError::Value { path: path.to_owned(), key, value });
        }
        Ok(tuning)
    }

    /// As TOML.
    ///
    /// # Errors
    /// None that [`toml`] has for such a table; it is passed on all the same.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }
}

impl FilterTuning {
    /// Reads the text of a `[filter]` table: what a link network's file carries.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str) -> Result<Self, String> {
        let filter: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        match filter.mistake() {
            Some((key, value)) => Err(format!("{key} = {value}: must be more than {MIN} and at most {MAX}")),
            None => Ok(filter),
        }
    }

    /// The text that [`FilterTuning::parse`] reads.
    ///
    /// # Errors
    /// As [`Tuning::to_toml`].
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }

    /// The first number that no filter can work with.
    fn mistake(&self) -> Option<(&'static str, f64)> {
        let set = self.entries().into_iter().filter_map(|(key, value)| Some((key, value?)));
        { set }.find(|(_, v)| !(v.is_finite() && *v > MIN && *v <= MAX))
    }

    /// Everything that `filter` says, but for its adaptation.
    pub fn of(filter: &FilterConfig) -> Self {
        Self {
            centre_acceleration: Some(filter.centre_acceleration),
            size_acceleration: Some(filter.size_acceleration),
            centre_walk: Some(filter.centre_walk),
            size_walk: Some(filter.size_walk),
            centre_measurement: Some(filter.centre_measurement),
            size_measurement: Some(filter.size_measurement),
            birth_centre_velocity: Some(filter.birth_centre_velocity),
            birth_size_velocity: Some(filter.birth_size_velocity),
            size_velocity_decay: Some(filter.size_velocity_decay),
        }
    }

    /// `base` with what this sets.
    pub fn apply(&self, base: FilterConfig) -> FilterConfig {
        FilterConfig {
            centre_acceleration: self.centre_acceleration.unwrap_or(base.centre_acceleration),
            size_acceleration: self.size_acceleration.unwrap_or(base.size_acceleration),
            centre_walk: self.centre_walk.unwrap_or(base.centre_walk),
            size_walk: self.size_walk.unwrap_or(base.size_walk),
            centre_measurement: self.centre_measurement.unwrap_or(base.centre_measurement),
            size_measurement: self.size_measurement.unwrap_or(base.size_measurement),
            birth_centre_velocity: self.birth_centre_velocity.unwrap_or(base.birth_centre_velocity),
            birth_size_velocity: self.birth_size_velocity.unwrap_or(base.birth_size_velocity),
            size_velocity_decay: self.size_velocity_decay.unwrap_or(base.size_velocity_decay),
            adaptation: base.adaptation,
        }
    }

    fn entries(&self) -> [(&'static str, Option<f64>); 9] {
        [
            ("centre_acceleration", self.centre_acceleration),
            ("size_acceleration", self.size_acceleration),
            ("centre_walk", self.centre_walk),
            ("size_walk", self.size_walk),
            ("centre_measurement", self.centre_measurement),
            ("size_measurement", self.size_measurement),
            ("birth_centre_velocity", self.birth_centre_velocity),
            ("birth_size_velocity", self.birth_size_velocity),
            ("size_velocity_decay", self.size_velocity_decay),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Tuning, TuningError> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("t.toml");
        fs::write(&path, text).expect("written");
        Tuning::read(&path)
    }

    #[test]
    fn what_is_written_is_read() {
        let mut filter =
            FilterConfig { centre_walk: 0.1234, size_measurement: 1.0 / 3.0, ..Default::default() };
        filter.adaptation.lambda = 0.7;
        let origin = Origin {
            statistic: "NEES".into(),
            cost: "likelihood".into(),
            data: vec!["a".into(), "b".into()],
            evaluations: 7,
            seed: u64::from(u32::MAX),
            cost_before: [1.5, 2.5],
            cost_after: [0.25, 0.125],
        };
        let written = Tuning { filter: FilterTuning::of(&filter), origin: Some(origin) };
        let tuning = read(&written.to_toml().expect("TOML")).expect("read");
        assert_eq!(tuning, written);
        // The adaptation is the tracker's own: a tuning leaves it alone.
        let applied = tuning.filter.apply(FilterConfig::default());
        assert_eq!(applied, FilterConfig { adaptation: Default::default(), ..filter });
    }

    #[test]
    fn a_table_in_a_network_is_checked_as_a_file_is() {
        let filter = FilterTuning::of(&FilterConfig::hand_set());
        assert_eq!(FilterTuning::parse(&filter.to_toml().expect("TOML")), Ok(filter));
        for (text, expected) in
            [("size_walk = -1.0", "size_walk = -1: must be more"), ("x = 1", "unknown field")]
        {
            let message = FilterTuning::parse(text).expect_err(text);
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn what_is_left_out_keeps_its_default() {
        let tuning = read("[filter]\nsize_walk = 0.5\n").expect("read");
        let expected = FilterConfig { size_walk: 0.5, ..Default::default() };
        assert_eq!(tuning.filter.apply(FilterConfig::default()), expected);
    }

    #[test]
    fn mistakes_are_named() {
        for (text, expected) in [
            ("[filter]\ncenter_walk = 1.0", "unknown field `center_walk`"),
            ("[filters]\n", "unknown field `filters`"),
            ("", "missing field `filter`"),
            ("[filter]\nsize_walk = 0.0", "filter.size_walk = 0: must be more than 0 and at most 100"),
            ("[filter]\nsize_walk = -1.0", "filter.size_walk = -1"),
            ("[filter]\ncentre_measurement = nan", "filter.centre_measurement = NaN"),
            ("[filter]\ncentre_measurement = inf", "filter.centre_measurement = inf"),
            ("[filter]\ncentre_measurement = \"x\"", "line 2"),
            ("[filter]\nsize_walk = 1.0\n[origin]\nseeds = 1", "unknown field `seeds`"),
        ] {
            let message = read(text).expect_err(text).to_string();
            assert!(message.contains(expected) && message.contains("t.toml"), "{text:?} gave {message:?}");
        }
        let missing = Tuning::read(Path::new("no/such/tuning.toml")).expect_err("no file").to_string();
        assert!(missing.contains("no/such/tuning.toml"), "{missing}");
    }
}
