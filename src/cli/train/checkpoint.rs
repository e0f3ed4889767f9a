//! Where a run of `gakp train` leaves its state after every epoch.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

use super::{Args, write};
use crate::learn::{Checkpoint, Fit, Split};

/// Where a run leaves its state after every epoch.
pub struct CheckpointFile {
    path: PathBuf,
    /// What the state belongs to: settings and examples.
    fingerprint: String,
    /// State to go on from.
    pub found: Option<Checkpoint>,
}

#[derive(Serialize, Deserialize)]
struct Saved {
    fingerprint: String,
    state: Checkpoint,
}

impl CheckpointFile {
    /// The file beside `out`, and with `--resume` what it holds.
    ///
    /// # Errors
    /// It cannot be read, or is of other data or settings.
    pub fn open(args: &Args, out: &Path, fit: &Fit, examples: &Split) -> Result<Self> {
        let path = out.with_added_extension("checkpoint");
        // The number of threads does not change the result.
        let settings = Fit { threads: 1, ..fit.clone() };
        let digest: String = examples.fingerprint().iter().map(|byte| format!("{byte:02x}")).collect();
        let fingerprint =
            format!("{} {} {settings:?} {digest}", args.association, examples.training.features());
        let mut found = None;
        if args.resume && path.is_file() {
            let text =
                fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
            let saved: Saved = serde_json::from_str(&text)
                .with_context(|| format!("{} is no checkpoint: delete it to begin anew", path.display()))?;
            ensure!(
                saved.fingerprint == fingerprint,
                "{} is of other data or settings: give the same as then, or leave --resume out to begin anew",
                path.display()
            );
            println!("{}: going on after epoch {}", path.display(), saved.state.epochs.len());
            found = Some(saved.state);
        } else if args.resume {
            println!("{}: there is none, the run begins anew", path.display());
        }
        Ok(Self { path, fingerprint, found })
    }

    /// Takes down a state. Written beside its place first: an interrupted write leaves the last state.
    pub fn save(&self, state: &Checkpoint) -> Result<()> {
        let saved = Saved { fingerprint: self.fingerprint.clone(), state: state.clone() };
        let new = self.path.with_added_extension("new");
        write(&new, serde_json::to_string(&saved)?.as_bytes())?;
        fs::rename(&new, &self.path).with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Takes the file away.
    pub fn remove(self) {
        // Of no use any more; a later run without --resume does not look at it.
        let _ = fs::remove_file(&self.path);
    }
}
