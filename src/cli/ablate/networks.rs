//! Link networks by what they read and by footage, loaded when they are first asked for.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};

use crate::infer::{Linker, ModelSettings};
use crate::track::{Association, Features};

/// What sets networks apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// The GRU over relative boxes.
    Implicit,
    /// Weights of what boxes give.
    Explicit,
    /// The GRU over relative boxes and likeness.
    ImplicitLooks,
    /// Weights of what boxes give and of likeness.
    ExplicitLooks,
    /// The GRU as the paper has it.
    Literal,
    /// The same without embeddings.
    Spatial,
}

impl Kind {
    /// All of them. The first that there is lends the table its filter and its existence head.
    pub const ALL: [Kind; 6] = [
        Kind::Implicit,
        Kind::Explicit,
        Kind::ImplicitLooks,
        Kind::ExplicitLooks,
        Kind::Literal,
        Kind::Spatial,
    ];

    fn of(linker: &Linker) -> Self {
        match (linker.association(), linker.features()) {
            (Association::Explicit, Features::Appearance { .. }) => Kind::ExplicitLooks,
            (Association::Explicit, _) => Kind::Explicit,
            (_, Features::Relative) => Kind::Implicit,
            (_, Features::Appearance { .. }) => Kind::ImplicitLooks,
            (_, Features::Literal { embedding: 0 }) => Kind::Spatial,
            (_, Features::Literal { .. }) => Kind::Literal,
        }
    }
}

/// The networks of a run.
pub struct Networks {
    settings: ModelSettings,
    /// Folders with a network for each footage.
    folders: BTreeMap<Kind, PathBuf>,
    /// One network for all footage.
    single: Option<Linker>,
    loaded: BTreeMap<(Kind, String), Option<Linker>>,
}

impl Networks {
    /// Networks of `folders`, or with `single` the one that `settings` name for every footage.
    ///
    /// # Errors
    /// A folder without networks, two with networks of one kind, a network that cannot be loaded.
    pub fn new(folders: &[PathBuf], settings: ModelSettings, single: bool) -> Result<Self> {
        let mut networks = Self { settings, folders: BTreeMap::new(), single: None, loaded: BTreeMap::new() };
        for folder in folders {
            let linker = networks.load(&first_network(folder)?)?;
            let kind = Kind::of(&linker);
            linker.shutdown();
            if let Some(other) = networks.folders.insert(kind, folder.clone()) {
                bail!(
                    "{} and {} hold networks of the same kind ({kind:?}): give one of them",
                    other.display(),
                    folder.display()
                );
            }
        }
        // The shipped network may have been trained on this very footage: only one that was named counts.
        if single {
            networks.single = Some(Linker::load(&networks.settings, Arc::new(()))?);
        }
        Ok(networks)
    }

    /// The network of this kind for `footage`, one that has not seen it; `None` when there is none.
    ///
    /// # Errors
    /// A network that cannot be loaded or is of another kind.
    pub fn get(&mut self, kind: Kind, footage: &str) -> Result<Option<Linker>> {
        let Some(folder) = self.folders.get(&kind) else {
            return Ok(self.single.clone().filter(|linker| Kind::of(linker) == kind));
        };
        let key = (kind, footage.to_owned());
        if !self.loaded.contains_key(&key) {
            let file = folder.join(format!("{footage}.onnx"));
            let linker = match file.is_file() {
                true => Some(self.load(&file)?),
                false => None,
            };
            if let Some(found) = linker.as_ref().map(Kind::of) {
                ensure!(
                    found == kind,
                    "{} is of another kind ({found:?}) than the first network of its folder ({kind:?})",
                    file.display()
                );
            }
            self.loaded.insert(key.clone(), linker);
        }
        Ok(self.loaded.get(&key).cloned().flatten())
    }

    fn load(&self, file: &Path) -> Result<Linker> {
        let mut settings = self.settings.clone();
        settings.link = file.display().to_string();
        Ok(Linker::load(&settings, Arc::new(()))?)
    }

    /// Ends all of them.
    pub fn end(self) {
        self.loaded.values().flatten().chain(&self.single).for_each(Linker::shutdown);
    }
}

fn first_network(folder: &Path) -> Result<PathBuf> {
    ensure!(folder.is_dir(), "there is no folder {}", folder.display());
    let unreadable = || format!("cannot read folder {}", folder.display());
    let mut files = vec![];
    for entry in folder.read_dir().with_context(unreadable)? {
        let file = entry.with_context(unreadable)?.path();
        if file.extension().is_some_and(|extension| extension == "onnx") {
            files.push(file);
        }
    }
    files.sort();
    files.into_iter().next().with_context(|| {
        format!(
            "no network in {}: expected FOOTAGE.onnx as `gakp train --loso` writes them",
            folder.display()
        )
    })
}
