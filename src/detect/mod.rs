//! Frames to detections: pre-processing, one decoder a model family, non-maximum suppression.
//!
//! All of it runs on the detector's own worker threads (`detect-0`, …); an async caller only waits.

mod decode;
mod letterbox;
mod model;
mod nanodet;
mod nms;
mod yolov8;
mod yolox;

use std::path::Path;
use std::sync::Arc;

pub(crate) use model::{DetectModel, DetectSpec};

use crate::infer::{Arrangement, Batcher, InferError, ModelEntry, Observer, Runtime, Task};
use crate::types::{Detection, Image, YuvMatrix, YuvRange};

/// What to look for.
#[derive(Clone, Debug, Default)]
pub struct DetectorSettings {
    /// Largest input (width, height) instead of the manifest's; multiples of the manifest's `multiple`.
    pub size: Option<(usize, usize)>,
    /// Score threshold instead of the manifest's, in `(0, 1)`.
    pub score_threshold: Option<f64>,
    /// Classes to report, by name; empty means the model's first class alone (a person).
    pub classes: Vec<String>,
}

/// Finds objects in frames. Clones share the model.
#[derive(Clone)]
pub struct Detector {
    batcher: Arc<Batcher<DetectModel>>,
    spec: Arc<DetectSpec>,
}

impl Detector {
    /// Loads `file` on every worker, checks it against its entry and runs it once.
    ///
    /// # Errors
    /// A setting that the model cannot follow, or a file that is not what the manifest says.
    pub(crate) fn start(
        runtime: &Runtime,
        entry: &ModelEntry,
        file: &Path,
        settings: &DetectorSettings,
        arrangement: Arrangement,
        observer: Arc<dyn Observer>,
    ) -> Result<Self, InferError> {
        let spec = Arc::new(DetectSpec::new(entry, settings, runtime.provider)?);
        let (runtime, entry, file) = (runtime.clone(), entry.clone(), file.to_path_buf());
        let build = {
            let spec = spec.clone();
            move |_| {
                let mut model = DetectModel::load(&runtime, &entry, &file, arrangement, spec.clone())?;
                model.warm_up()?;
                Ok(model)
            }
        };
        let batcher = Batcher::start(Task::Detect.as_str(), arrangement, observer, build)?;
        Ok(Self { batcher: Arc::new(batcher), spec })
    }

    /// The objects in a frame, the best score first, boxes in pixels of the frame (they may reach
    /// outside). Waits while the queue is full; dropping the future withdraws the request.
    ///
    /// # Errors
    /// The model's failure, or [`InferError::Stopped`].
    pub async fn detect(&self, image: Image) -> Result<Vec<Detection>, InferError> {
        self.batcher.submit(image).await
    }

    /// [`Detector::detect`] if the queue has a place now; the future is the answer.
    ///
    /// # Errors
    /// [`InferError::Full`] or [`InferError::Stopped`].
    pub fn try_detect(
        &self,
        image: Image,
    ) -> Result<impl Future<Output = Result<Vec<Detection>, InferError>> + Send + use<>, InferError> {
        self.batcher.try_submit(image)
    }

    /// [`Detector::detect`] for a thread that may wait.
    ///
    /// # Errors
    /// As [`Detector::detect`].
    pub fn detect_blocking(&self, image: Image) -> Result<Vec<Detection>, InferError> {
        futures::executor::block_on(self.detect(image))
    }

    /// The names of the model's classes; [`crate::types::ClassId`] counts them.
    pub fn classes(&self) -> &[String] {
        &self.spec.classes
    }

    /// Frames in the queue now.
    pub fn depth(&self) -> usize {
        self.batcher.depth()
    }

    /// How it runs.
    pub fn arrangement(&self) -> Arrangement {
        self.batcher.arrangement()
    }

    /// Stops taking frames, answers those in the queue and joins the workers.
    pub fn shutdown(&self) {
        self.batcher.shutdown();
    }
}

/// A grey picture to warm up with.
pub(crate) fn grey(width: u32, height: u32) -> Image {
    use crate::types::Plane;
    let (w, h) = (width as usize, height as usize);
    let (cw, ch) = (w.div_ceil(2), h.div_ceil(2));
    let planes = [
        Plane { offset: 0, stride: w },
        Plane { offset: w * h, stride: cw },
        Plane { offset: w * h + cw * ch, stride: cw },
    ];
    let buffer = Arc::new(vec![128u8; w * h + 2 * cw * ch]);
    Image::i420((width.max(1), height.max(1)), YuvRange::Full, YuvMatrix::Bt601, planes, buffer)
        .expect("a picture that is not empty")
}
