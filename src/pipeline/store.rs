//! Cameras that were added at run time, remembered across restarts.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::api::{NewCamera, RulesSpec};
use crate::private;

/// A file `cameras.json` in the state folder. It holds camera passwords, so only its owner may read it.
pub struct Store {
    path: PathBuf,
}

/// What the file holds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Remembered {
    /// The last epoch that was given out: ids of an earlier run are never confused with later ones.
    pub epoch: u64,
    /// The cameras, in the order in which they were added.
    pub cameras: Vec<NewCamera>,
    /// Lines and zones that were changed at run time, by camera; also of cameras that the configuration names.
    #[serde(default)]
    pub rules: BTreeMap<String, RulesSpec>,
}

/// The state folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// Reading or writing failed.
    #[error("cannot {verb} {path}: {reason}; give another folder with --state-dir", path = path.display())]
    Io {
        /// What was tried.
        verb: &'static str,
        /// On what.
        path: PathBuf,
        /// What went wrong.
        reason: io::Error,
    },
    /// The file is not what was written.
    #[error("{path} is damaged ({reason}): mend it or move it away; the cameras in it are lost otherwise", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where.
        reason: serde_json::Error,
    },
}

impl Store {
    /// Reads what the folder remembers; one that is not there yet remembers nothing.
    ///
    /// # Errors
    /// [`StoreError`]; a damaged file is never overwritten.
    pub fn open(folder: &Path) -> Result<(Self, Remembered), StoreError> {
        let path = folder.join("cameras.json");
        let remembered = match fs::read_to_string(&path) {
            Ok(text) => serde_json::from_str(&text)
                .map_err(|reason| StoreError::Damaged { path: path.clone(), reason })?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => Remembered::default(),
            Err(reason) => return Err(StoreError::Io { verb: "read", path, reason }),
        };
        Ok((Self { path }, remembered))
    }

    /// Makes the folder, if it is not there.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn make_folder(&self) -> Result<(), StoreError> {
        let folder = self.path.parent().unwrap_or(&self.path);
        fs::create_dir_all(folder).map_err(|reason| StoreError::Io {
            verb: "make the folder",
            path: folder.to_path_buf(),
            reason,
        })
    }

    /// Writes everything; a crash leaves either the old or the new.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn save(&self, remembered: &Remembered) -> Result<(), StoreError> {
        private::write_json(&self.path, remembered).map_err(|reason| StoreError::Io {
            verb: "write",
            path: self.path.clone(),
            reason,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::CameraId;

    #[test]
    fn what_is_saved_comes_back_and_damage_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("state");
        let (store, empty) = Store::open(&folder).unwrap();
        assert_eq!(empty, Remembered::default());
        assert!(!folder.exists(), "looking leaves no trace");
        store.make_folder().unwrap();
        let camera = NewCamera {
            id: CameraId::new("gate").unwrap(),
            url: "rtsp://u:p@h/s".into(),
            transport: None,
            looped: false,
            paused: false,
            lines: vec![],
            zones: vec![],
            masks: vec![],
        };
        let rules = BTreeMap::from([("gate".into(), RulesSpec::default())]);
        let saved = Remembered { epoch: 7, cameras: vec![camera], rules };
        store.save(&saved).unwrap();
        assert_eq!(Store::open(&folder).unwrap().1, saved);
        fs::write(folder.join("cameras.json"), "{").unwrap();
        assert!(matches!(Store::open(&folder), Err(StoreError::Damaged { .. })));
    }
}
