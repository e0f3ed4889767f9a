//! Everything that the flow asks a model for, loaded and warmed up.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::{
    Arrangement, Calibration, InferError, Linker, Manifest, ModelEntry, Observer, Provider, ProviderChoice,
    Runtime, Task,
};
use crate::detect::{Detector, DetectorSettings};
use crate::embed::Embedder;
use crate::track::{Association, TrackerConfig};

/// What the user says about models.
#[derive(Clone, Debug)]
pub struct ModelSettings {
    /// The manifest, or the folder that `manifest.toml` lies in.
    pub manifest: PathBuf,
    /// The detector: a name in the manifest; `auto`, which is the first `-int8` one on the CPU and the
    /// first other one on a GPU; or a model of the user's own, as `own.toml` (its only entry of the
    /// task), `own.toml#name`, or `own.onnx` with an `own.toml` beside it.
    pub detector: String,
    /// The detector's size, threshold and classes.
    pub detection: DetectorSettings,
    /// `builtin` (colour stripes), `none`, or a network: a name or a path, as for the detector.
    pub reid: String,
    /// `none`, or the link scorer: a name or a path, as for the detector.
    pub link: String,
    /// The execution provider.
    pub provider: ProviderChoice,
    /// CPU cores to use for models; all, when not given.
    pub threads: Option<usize>,
    /// ONNX Runtime's library, when it lies in no usual place.
    pub onnxruntime: Option<PathBuf>,
}

impl Default for ModelSettings {
    fn default() -> Self {
        Self {
            manifest: "models".into(),
            detector: "auto".into(),
            detection: DetectorSettings::default(),
            reid: "builtin".into(),
            link: "gakp-gru".into(),
            provider: ProviderChoice::Auto,
            threads: None,
            onnxruntime: None,
        }
    }
}

/// The models, ready. Clones share them.
#[derive(Clone)]
pub struct Models {
    /// Frames to boxes.
    pub detector: Detector,
    /// Boxes to appearance vectors, unless it is switched off.
    pub embedder: Option<Embedder>,
    /// Pairs to link probabilities, unless it is switched off.
    pub linker: Option<Linker>,
    /// What is really used.
    pub report: Arc<Report>,
    /// What the tracker should know of the detector's and the appearance model's numbers.
    pub calibration: [Calibration; 2],
}

/// What is really used, for logs and metrics.
#[derive(Clone, Debug)]
pub struct Report {
    /// `cpu`, `cuda` or `tensorrt`.
    pub provider: &'static str,
    /// Why `auto` did not take a GPU.
    pub fallback: Option<String>,
    /// ONNX Runtime's library.
    pub library: PathBuf,
    /// Each model: its task, its name, how it runs.
    pub models: Vec<(Task, String, Arrangement)>,
}

impl Models {
    /// Checks every file, loads ONNX Runtime and the models, and runs each of them once.
    ///
    /// # Errors
    /// The first thing that is wrong: a setting, the manifest, a hash, the library, the provider, a graph.
    pub fn load(settings: &ModelSettings, observer: Arc<dyn Observer>) -> Result<Self, InferError> {
        let plan = Plan::new(settings)?;
        let mut report = Report {
            provider: plan.runtime.provider.as_str(),
            fallback: plan.runtime.fallback.clone(),
            library: plan.runtime.library.clone(),
            models: vec![],
        };
        let runtime = &plan.runtime;
        let mut arrange = |task: Task, name: &str, provider: Provider| {
            let arrangement = provider.arrangement(task, settings.threads);
            let Arrangement { workers, max_batch, max_wait, .. } = arrangement;
            tracing::info!(
                task = task.as_str(),
                model = name,
                provider = provider.as_str(),
                workers,
                max_batch,
                max_wait_ms = max_wait.as_millis() as u64,
                "model"
            );
            report.models.push((task, name.into(), arrangement));
            arrangement
        };
        let Chosen { entry, file } = &plan.detector;
        let arrangement = arrange(Task::Detect, &entry.name, runtime.provider);
        let detector =
            Detector::start(runtime, entry, file, &settings.detection, arrangement, observer.clone())?;
        let embedder = match &plan.reid {
            Reid::None => None,
            Reid::Stripes => {
                // No graph, so the CPU's arrangement, whatever the provider is.
                let arrangement = arrange(Task::Reid, "builtin", Provider::Cpu);
                Some(Embedder::start_stripes(arrangement, observer.clone())?)
            }
            Reid::Network(network) => {
                let Chosen { entry, file } = &**network;
                let arrangement = arrange(Task::Reid, &entry.name, runtime.provider);
                Some(Embedder::start_network(runtime, entry, file, arrangement, observer.clone())?)
            }
        };
        let linker = match &plan.link {
            None => None,
            Some(Chosen { entry, file }) => {
                let arrangement = arrange(Task::Link, &entry.name, runtime.provider);
                Some(Linker::start(runtime, entry, file, arrangement, observer)?)
            }
        };
        tracing::info!(
            provider = report.provider,
            library = %report.library.display(),
            "models are ready"
        );
        let calibrated =
            |chosen: &Chosen| chosen.entry.output.as_ref().map(|o| o.tracking).unwrap_or_default();
        let appearance = match &plan.reid {
            Reid::None => Calibration::default(),
            Reid::Stripes => crate::embed::stripes::CALIBRATION,
            Reid::Network(chosen) => calibrated(chosen).or_deep(),
        };
        let calibration = [calibrated(&plan.detector), appearance];
        Ok(Self { detector, embedder, linker, report: Arc::new(report), calibration })
    }

    /// `tracker` with what is known of the models.
    pub fn calibrate(&self, mut tracker: TrackerConfig) -> TrackerConfig {
        self.calibration.iter().for_each(|calibration| calibration.apply(&mut tracker));
        match &self.linker {
            Some(linker) => linker.calibrate(tracker),
            None => tracker,
        }
    }

    /// Checks that the link scorer is one that `association` can use with these embeddings, if it asks one.
    ///
    /// # Errors
    /// [`InferError::NoLinker`], [`InferError::Association`] or [`InferError::Embeddings`].
    pub fn check_suits(&self, association: Association) -> Result<(), InferError> {
        match &self.linker {
            Some(linker) if association.asks_scorer() => {
                linker.check_suits(association)?;
                linker.check_embeddings(self.embedder.as_ref().map(Embedder::width))
            }
            Some(_) => Ok(()),
            None if association.asks_scorer() => {
                Err(InferError::NoLinker { association: association.as_str() })
            }
            None => Ok(()),
        }
    }

    /// Stops all models: takes no more requests, answers those in the queues, joins the workers.
    pub fn shutdown(&self) {
        self.detector.shutdown();
        self.embedder.iter().for_each(Embedder::shutdown);
        self.linker.iter().for_each(Linker::shutdown);
    }
}

/// The models that the settings name, their files checked.
pub(super) struct Plan {
    pub runtime: Runtime,
    pub detector: Chosen,
    pub reid: Reid,
    pub link: Option<Chosen>,
}

/// An entry and its file, whose hash is right.
pub(super) struct Chosen {
    pub entry: ModelEntry,
    pub file: PathBuf,
}

/// Where appearance comes from.
pub(super) enum Reid {
    None,
    Stripes,
    Network(Box<Chosen>),
}

impl Plan {
    /// Checks the files that need no runtime first: a wrong hash is told even where ONNX Runtime is missing.
    pub(super) fn new(settings: &ModelSettings) -> Result<Self, InferError> {
        let path = manifest_path(settings);
        let manifest = Manifest::read(&path)?;
        let reid = match settings.reid.as_str() {
            "none" => Reid::None,
            "builtin" => Reid::Stripes,
            name => Reid::Network(Box::new(choose(&manifest, Task::Reid, name)?)),
        };
        let link = match settings.link.as_str() {
            "none" => None,
            name => Some(choose(&manifest, Task::Link, name)?),
        };
        let named = match settings.detector.as_str() {
            "auto" => None,
            name => Some(choose(&manifest, Task::Detect, name)?),
        };
        let folder = path.parent().unwrap_or(Path::new(""));
        let runtime = Runtime::load(settings.provider, settings.onnxruntime.as_deref(), folder)?;
        let detector = match named {
            Some(chosen) => chosen,
            None => automatic(&manifest, runtime.provider == Provider::Cpu)?,
        };
        Ok(Self { runtime, detector, reid, link })
    }
}

/// The detector that suits the provider: integers on the CPU; a GPU runs the float network faster.
fn automatic(manifest: &Manifest, cpu: bool) -> Result<Chosen, InferError> {
    let mut detectors = manifest.models().iter().filter(|model| model.task == Task::Detect);
    let suits = |model: &&ModelEntry| model.name.ends_with("-int8") == cpu;
    let best = detectors.clone().find(suits).or_else(|| detectors.next());
    // Without any detector the error lists what there is.
    choose(manifest, Task::Detect, best.map_or("auto", |model| &model.name))
}

/// Finds what a setting names, in the manifest or in the user's own, and checks its hash.
fn choose(manifest: &Manifest, task: Task, setting: &str) -> Result<Chosen, InferError> {
    let (path, name) = setting.split_once('#').map_or((setting, None), |(path, name)| (path, Some(name)));
    let extension = Path::new(path).extension().and_then(|e| e.to_str());
    let own = match extension {
        Some("toml") => Manifest::read(Path::new(path))?,
        Some("onnx") => Manifest::read(&Path::new(path).with_extension("toml"))?,
        _ => {
            let entry = manifest.find(task, setting)?.clone();
            let file = manifest.verify(&entry)?;
            return Ok(Chosen { entry, file });
        }
    };
    let entry = match name {
        Some(name) => own.find(task, name)?.clone(),
        None => {
            let mut of_task = own.models().iter().filter(|model| model.task == task);
            match (of_task.next(), of_task.next()) {
                (Some(entry), None) => entry.clone(),
                (first, _) => {
                    let count = if first.is_some() { "several" } else { "no" };
                    return Err(InferError::Manifest {
                        path: own.path().into(),
                        reason: format!("has {count} {} models; name one as {path}#name", task.as_str()),
                    });
                }
            }
        }
    };
    let file = own.verify(&entry)?;
    Ok(Chosen { entry, file })
}

impl Linker {
    /// Loads the link scorer alone, for detections that are already there.
    ///
    /// # Errors
    /// As [`Models::load`]; also when `settings.link` is `none`.
    pub fn load(settings: &ModelSettings, observer: Arc<dyn Observer>) -> Result<Self, InferError> {
        let (runtime, Chosen { entry, file }) = link_alone(settings)?;
        let arrangement = runtime.provider.arrangement(Task::Link, settings.threads);
        Self::start(&runtime, &entry, &file, arrangement, observer)
    }
}

/// The link scorer that `settings` name, and a runtime for it.
pub(super) fn link_alone(settings: &ModelSettings) -> Result<(Runtime, Chosen), InferError> {
    let manifest = Manifest::read(&manifest_path(settings))?;
    let chosen = choose(&manifest, Task::Link, &settings.link)?;
    let folder = manifest.path().parent().unwrap_or(Path::new(""));
    let runtime = Runtime::load(settings.provider, settings.onnxruntime.as_deref(), folder)?;
    Ok((runtime, chosen))
}

/// The manifest's file.
fn manifest_path(settings: &ModelSettings) -> PathBuf {
    if settings.manifest.extension().is_some_and(|e| e == "toml") {
        settings.manifest.clone()
    } else {
        settings.manifest.join("manifest.toml")
    }
}
