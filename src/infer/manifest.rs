//! `manifest.toml`: what each model file is, checked before anything is started.
//!
//! An entry says where the file is and its hash, what it takes (shape, colour order, normalisation,
//! how a picture is fitted) and what it gives. `models/README.md` describes every key.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::InferError;
use crate::track::{AppearanceConfig, TrackerConfig};

/// A manifest and the folder it lies in.
#[derive(Clone, Debug)]
pub struct Manifest {
    path: PathBuf,
    models: Vec<ModelEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    model: Vec<ModelEntry>,
}

/// One model.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelEntry {
    /// The name that settings use; unique within the manifest.
    pub name: String,
    /// What it is for.
    pub task: Task,
    /// How its output is read.
    pub family: Family,
    /// The ONNX file, relative to the manifest.
    pub file: PathBuf,
    /// The file's SHA-256, 64 hexadecimal digits.
    pub sha256: String,
    /// The licence of the weights.
    pub license: String,
    /// Where it came from.
    #[serde(default)]
    pub source: String,
    /// What it takes; `link` models have the four inputs of [`super::Linker`] instead.
    pub input: Option<InputSpec>,
    /// What it gives.
    pub output: Option<OutputSpec>,
}

/// What a model is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Task {
    /// Frames to boxes.
    Detect,
    /// Crops to appearance vectors.
    Reid,
    /// Track histories and candidates to link probabilities.
    Link,
}

impl Task {
    /// The name used in the manifest, in thread names and in metrics.
    pub const fn as_str(self) -> &'static str {
        match self {
            Task::Detect => "detect",
            Task::Reid => "reid",
            Task::Link => "link",
        }
    }
}

/// How a model's output is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Family {
    /// `[N, A, C + 44]`: class scores, then 4 x 11 distribution logits.
    Nanodet,
    /// `[N, A, 5 + C]`: grid offsets, objectness, class scores.
    Yolox,
    /// `[N, 4 + C, A]`: centre and size in input pixels, class scores.
    Yolov8,
    /// `[N, D]`: an appearance vector.
    Embedding,
    /// `[P]`: a probability a pair, by a GRU over history and candidate.
    Gru,
    /// `[P]`: a probability a pair, from explicit features whose weights a GRU over the history gives.
    Explicit,
}

impl Family {
    fn task(self) -> Task {
        match self {
            Family::Nanodet | Family::Yolox | Family::Yolov8 => Task::Detect,
            Family::Embedding => Task::Reid,
            Family::Gru | Family::Explicit => Task::Link,
        }
    }
}

/// One axis of a tensor.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(untagged)]
pub enum Dim {
    /// Always this.
    Fixed(usize),
    /// Any size; the name is for the reader.
    Dynamic(String),
}

impl Dim {
    /// The size, when it is fixed.
    pub fn fixed(&self) -> Option<usize> {
        match self {
            Dim::Fixed(size) => Some(*size),
            Dim::Dynamic(_) => None,
        }
    }
}

/// The picture that a model takes: f32 `[batch, 3, height, width]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputSpec {
    /// The graph's input.
    pub name: String,
    /// Its shape.
    pub shape: Vec<Dim>,
    /// Width that pictures are brought to, pixels.
    pub width: usize,
    /// Height that pictures are brought to, pixels.
    pub height: usize,
    /// Width and height are multiples of this.
    #[serde(default = "one")]
    pub multiple: usize,
    /// The order of the channels.
    pub colour: ColourOrder,
    /// Subtracted from 0..=255 values, in the order of `colour`.
    pub mean: [f32; 3],
    /// Divides what is left, in the order of `colour`.
    pub std: [f32; 3],
    /// How a picture is fitted.
    pub resize: Fit,
    /// Raw value (0..=255) of what the picture does not cover.
    #[serde(default)]
    pub pad: f32,
}

/// The order of colour channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColourOrder {
    /// Blue first.
    Bgr,
    /// Red first.
    Rgb,
}

/// How a picture is fitted into a model's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fit {
    /// Keeps its shape, lies in the top left corner.
    LetterboxTopLeft,
    /// Keeps its shape, lies in the middle.
    LetterboxCentre,
    /// Fills the input.
    Stretch,
}

/// What a model gives.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputSpec {
    /// The graph's output.
    pub name: String,
    /// Its shape.
    pub shape: Vec<Dim>,
    /// `detect`: the names of the classes, in the order of the output; class 0 is what the tracker calls a person.
    #[serde(default)]
    pub classes: Vec<String>,
    /// `detect`: pixels between grid points, level by level in the order of the output.
    #[serde(default)]
    pub strides: Vec<usize>,
    /// `detect`: the useful threshold of the score.
    pub score_threshold: Option<f64>,
    /// `detect`: boxes of one class that overlap more than this are the same object.
    pub nms_iou: Option<f64>,
    /// `reid`: numbers in a vector.
    pub width: Option<usize>,
    /// What the tracker should know of the model's numbers.
    #[serde(default)]
    pub tracking: Calibration,
}

/// A model's numbers as the tracker reads them; what is not given is the tracker's default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Calibration {
    /// `detect`: detections from this score on are trusted ([`AssociationConfig::high_score`]).
    ///
    /// [`AssociationConfig::high_score`]: crate::track::AssociationConfig::high_score
    pub high_score: Option<f64>,
    /// `detect`: least score of a birth.
    pub birth_score: Option<f64>,
    /// `reid`: logits that a unit of cosine similarity is worth; [`AppearanceConfig::deep`]'s without.
    pub appearance_weight: Option<f64>,
    /// `reid`: the cosine similarity that says nothing either way; [`AppearanceConfig::deep`]'s without.
    pub appearance_pivot: Option<f64>,
}

impl Calibration {
    /// What is usual of deep ReID networks for what the entry does not say.
    pub(super) fn or_deep(self) -> Self {
        let AppearanceConfig { weight, pivot, .. } = AppearanceConfig::deep();
        Self {
            appearance_weight: self.appearance_weight.or(Some(weight)),
            appearance_pivot: self.appearance_pivot.or(Some(pivot)),
            ..self
        }
    }

    /// `tracker` with what is known of the model.
    pub fn apply(&self, tracker: &mut TrackerConfig) {
        for (value, into) in [
            (self.high_score, &mut tracker.association.high_score),
            (self.birth_score, &mut tracker.birth.score),
            (self.appearance_weight, &mut tracker.appearance.weight),
            (self.appearance_pivot, &mut tracker.appearance.pivot),
        ] {
            *into = value.unwrap_or(*into);
        }
    }
}

fn one() -> usize {
    1
}

impl Manifest {
    /// Reads and checks a manifest; the model files are not touched ([`Manifest::verify`]).
    ///
    /// # Errors
    /// [`InferError::Manifest`]: not there, no TOML, unknown or missing keys, impossible values.
    pub fn read(path: &Path) -> Result<Self, InferError> {
        let unreadable =
            |e| InferError::Manifest { path: path.into(), reason: format!("cannot be read: {e}") };
        Self::parse(path, &fs::read_to_string(path).map_err(unreadable)?)
    }

    /// Checks the text of the manifest that lies at `path`.
    ///
    /// # Errors
    /// As [`Manifest::read`].
    pub fn parse(path: &Path, text: &str) -> Result<Self, InferError> {
        let wrong = |reason: String| InferError::Manifest { path: path.into(), reason };
        let File { model: models } =
            toml::from_str(text).map_err(|e| wrong(format!("is not a manifest: {e}")))?;
        for (index, model) in models.iter().enumerate() {
            model.check().map_err(|reason| wrong(format!("model {:?}: {reason}", model.name)))?;
            if models[..index].iter().any(|other| other.name == model.name) {
                return Err(wrong(format!("two models are named {:?}", model.name)));
            }
        }
        Ok(Self { path: path.into(), models })
    }

    /// Where it was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// All entries.
    pub fn models(&self) -> &[ModelEntry] {
        &self.models
    }

    /// The entry of that name.
    ///
    /// # Errors
    /// [`InferError::UnknownModel`], with the names there are.
    pub fn find(&self, task: Task, name: &str) -> Result<&ModelEntry, InferError> {
        let mut of_task = self.models.iter().filter(|m| m.task == task);
        of_task.clone().find(|m| m.name == name).ok_or_else(|| {
            let known: Vec<_> = of_task.by_ref().map(|m| m.name.as_str()).collect();
            InferError::UnknownModel {
                path: self.path.clone(),
                task: task.as_str(),
                name: name.into(),
                known: if known.is_empty() { "none".into() } else { known.join(", ") },
            }
        })
    }

    /// The path of an entry's file, once its hash is right.
    ///
    /// # Errors
    /// [`InferError::Missing`] or [`InferError::WrongHash`].
    pub fn verify(&self, model: &ModelEntry) -> Result<PathBuf, InferError> {
        let folder = self.path.parent().unwrap_or(Path::new(""));
        let file = folder.join(&model.file);
        let expected = model.sha256.to_ascii_lowercase();
        let found = sha256(&file).map_err(|error| match error.kind() {
            std::io::ErrorKind::NotFound => InferError::Missing {
                name: model.name.clone(),
                file: file.clone(),
                expected: expected.clone(),
            },
            _ => InferError::Graph {
                name: model.name.clone(),
                reason: format!("{} cannot be read: {error}", file.display()),
            },
        })?;
        if found != expected {
            return Err(InferError::WrongHash { name: model.name.clone(), file, expected, found });
        }
        Ok(file)
    }
}

impl ModelEntry {
    /// What the types do not say.
    fn check(&self) -> Result<(), String> {
        fn ensure(ok: bool, reason: &str) -> Result<(), String> {
            if ok { Ok(()) } else { Err(reason.into()) }
        }
        ensure(!self.name.is_empty(), "its name is empty")?;
        ensure(self.family.task() == self.task, "its family does not fit its task")?;
        ensure(
            self.sha256.len() == 64 && self.sha256.bytes().all(|b| b.is_ascii_hexdigit()),
            "sha256 must be 64 hexadecimal digits",
        )?;
        if self.task == Task::Link {
            return ensure(self.input.is_none(), "a link model has no [model.input]: its inputs are fixed");
        }
        let input = self.input.as_ref().ok_or("[model.input] is missing")?;
        let output = self.output.as_ref().ok_or("[model.output] is missing")?;
        ensure(input.shape.len() == 4, "input.shape must have 4 axes: batch, 3, height, width")?;
        ensure(input.shape[1].fixed() == Some(3), "input.shape[1] must be 3 (the colours)")?;
        ensure(input.multiple > 0, "input.multiple must be at least 1")?;
        for (what, size, dim) in
            [("height", input.height, &input.shape[2]), ("width", input.width, &input.shape[3])]
        {
            ensure(
                size > 0 && size <= 8192 && size.is_multiple_of(input.multiple),
                &format!(
                    "input.{what} {size} must be 1 to 8192 and a multiple of input.multiple {}",
                    input.multiple
                ),
            )?;
            ensure(
                dim.fixed().is_none_or(|fixed| fixed == size),
                &format!("input.{what} {size} differs from input.shape"),
            )?;
        }
        ensure(
            input.std.iter().all(|s| s.is_finite() && *s > 0.0) && input.mean.iter().all(|m| m.is_finite()),
            "input.mean must be finite and input.std positive",
        )?;
        ensure((0.0..=255.0).contains(&input.pad), "input.pad must be within 0..=255")?;
        if self.task == Task::Reid {
            ensure(input.resize == Fit::Stretch, "input.resize must be \"stretch\" for crops")?;
            ensure(output.shape.len() == 2, "output.shape must have 2 axes: batch, width")?;
            let width = output.width.ok_or("output.width is missing")?;
            ensure(width > 0, "output.width must be at least 1")?;
            return ensure(
                output.shape[1].fixed().is_none_or(|fixed| fixed == width),
                "output.width differs from output.shape[1]",
            );
        }
        ensure(!output.classes.is_empty(), "output.classes is missing")?;
        ensure(
            output.score_threshold.is_some_and(|t| (0.0..1.0).contains(&t)),
            "output.score_threshold must be given, within 0..1",
        )?;
        ensure(
            output.nms_iou.is_some_and(|t| t > 0.0 && t <= 1.0),
            "output.nms_iou must be given, within 0..=1",
        )?;
        ensure(output.shape.len() == 3, "output.shape must have 3 axes")?;
        let (axis, extra) = match self.family {
            Family::Nanodet => (2, 44),
            Family::Yolox => (2, 5),
            _ => (1, 4),
        };
        let channels = output.classes.len() + extra;
        ensure(
            output.shape[axis].fixed() == Some(channels),
            &format!("output.shape[{axis}] must be {channels}: {} classes and {extra}", output.classes.len()),
        )?;
        ensure(
            self.family == Family::Yolov8
                || (!output.strides.is_empty() && output.strides.iter().all(|s| *s > 0)),
            "output.strides is missing",
        )
    }
}

/// The SHA-256 of a file, in lower-case hexadecimal.
fn sha256(path: &Path) -> std::io::Result<String> {
    let mut file = fs::File::open(path)?;
    let mut hash = Sha256::new();
    let mut block = vec![0; 1 << 16];
    loop {
        match file.read(&mut block)? {
            0 => return Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()),
            n => hash.update(&block[..n]),
        }
    }
}
