//! What can go wrong between a model's file and an answer.

use std::path::PathBuf;

/// Why a model could not be loaded or did not answer. Cheap to clone: one failed batch answers many.
#[derive(Clone, Debug, thiserror::Error)]
pub enum InferError {
    /// The manifest cannot be read or says something impossible.
    #[error("model manifest {}: {reason}", path.display())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// No entry of that name and task.
    #[error("model manifest {}: no {task} model named {name:?}; it has: {known}", path.display())]
    UnknownModel {
        /// The manifest.
        path: PathBuf,
        /// `detect`, `reid` or `link`.
        task: &'static str,
        /// The name that was asked for.
        name: String,
        /// The names it has for this task.
        known: String,
    },
    /// The model's file is not there.
    #[error("model {name:?}: {} is missing (sha256 {expected} expected): {FETCH}", file.display())]
    Missing {
        /// Its name in the manifest.
        name: String,
        /// Where it was looked for.
        file: PathBuf,
        /// The hash that the manifest declares.
        expected: String,
    },
    /// The model's file is not the one that the manifest describes.
    #[error(
        "model {name:?}: {} has sha256 {found}, but {expected} is expected: {FETCH} \
         (or put the new hash into the manifest, if the file was changed on purpose)",
        file.display()
    )]
    WrongHash {
        /// Its name in the manifest.
        name: String,
        /// The file.
        file: PathBuf,
        /// The hash that the manifest declares.
        expected: String,
        /// The file's hash.
        found: String,
    },
    /// The graph is not what the manifest declares, or ONNX Runtime refuses it.
    #[error("model {name:?}: {reason}")]
    Graph {
        /// Its name in the manifest.
        name: String,
        /// What disagrees.
        reason: String,
    },
    /// A link scorer of one association under the name of another.
    #[error(
        "model {name:?} is no network of the association {association:?}: \
         set --link (models.link) to one, or tracker.association to what it is"
    )]
    Association {
        /// Its name in the manifest.
        name: String,
        /// The association that was asked for.
        association: &'static str,
    },
    /// A link scorer that reads other embeddings than there are.
    #[error(
        "model {name:?} reads embeddings of {expected} numbers, and {}: give it the appearance that it was trained \
         with (models.reid, --reid; for a sequence det/det_features.npy and --features), or another --link",
        width.map_or("there are none".into(), |width| format!("these have {width}"))
    )]
    Embeddings {
        /// Its name in the manifest.
        name: String,
        /// The width that it reads.
        expected: usize,
        /// The width that there is.
        width: Option<usize>,
    },
    /// No link scorer for an association that asks one.
    #[error("the association {association:?} needs a link scorer: set --link (models.link) to one")]
    NoLinker {
        /// The association.
        association: &'static str,
    },
    /// ONNX Runtime itself could not be loaded.
    #[error(
        "ONNX Runtime cannot be loaded; {FETCH}, or point ORT_DYLIB_PATH at libonnxruntime.so. Tried: {tried}"
    )]
    Library {
        /// Every place that was tried, and what came of it.
        tried: String,
    },
    /// The execution provider that was asked for does not work on this machine.
    #[error(
        "execution provider {provider} was asked for and does not work here: {reason} \
         (use `auto` or `cpu` to go on without it)"
    )]
    Provider {
        /// Its name.
        provider: &'static str,
        /// ONNX Runtime's own words.
        reason: String,
    },
    /// A setting makes no sense.
    #[error("{setting}: {reason}")]
    Setting {
        /// Its name.
        setting: &'static str,
        /// What is wrong with it and what is right.
        reason: String,
    },
    /// A request that the model cannot take.
    #[error("{model}: {reason}")]
    Request {
        /// The batcher's name: `detect`, `reid` or `link`.
        model: &'static str,
        /// What is wrong with the request.
        reason: String,
    },
    /// A batch failed while it ran.
    #[error("{model}: {reason}")]
    Run {
        /// The batcher's name.
        model: &'static str,
        /// ONNX Runtime's own words, or the panic's.
        reason: String,
    },
    /// `try_submit` found the queue full.
    #[error("{model}: the queue is full ({capacity} requests)")]
    Full {
        /// The batcher's name.
        model: &'static str,
        /// Its size.
        capacity: usize,
    },
    /// The workers have stopped.
    #[error("{model}: the workers have stopped")]
    Stopped {
        /// The batcher's name.
        model: &'static str,
    },
}

/// What to do when a file of the set-up is missing or wrong.
const FETCH: &str = "run `bash deploy/setup.sh models`";
