//! The detector as a batched model: frames in, boxes out.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use super::decode::{Decoder, Wanted};
use super::letterbox::Letterbox;
use super::nms::{Candidate, suppress};
use super::{DetectorSettings, grey};
use crate::infer::{
    Arrangement, BatchModel, InferError, InputSpec, ModelEntry, Normalisation, PictureGraph, Placement,
    Provider, Rasteriser, Runtime,
};
use crate::types::{BBox, ClassId, Detection, Image};

/// A detector's entry and the user's settings, checked against each other.
#[derive(Debug)]
pub(crate) struct DetectSpec {
    input: InputSpec,
    /// Largest input, width and height.
    size: (usize, usize),
    /// Whether the input may be smaller where the frame's shape allows.
    shrink: bool,
    decoder: Decoder,
    nms_iou: f32,
    /// The model's class names.
    pub classes: Vec<String>,
}

impl DetectSpec {
    pub(crate) fn new(
        entry: &ModelEntry,
        settings: &DetectorSettings,
        provider: Provider,
    ) -> Result<Self, InferError> {
        let wrong = |setting, reason: String| InferError::Setting { setting, reason };
        let (Some(input), Some(output)) = (&entry.input, &entry.output) else {
            return Err(InferError::Graph { name: entry.name.clone(), reason: "it is no detector".into() });
        };
        let dynamic = input.shape[2].fixed().is_none() && input.shape[3].fixed().is_none();
        let size = settings.size.unwrap_or((input.width, input.height));
        if size != (input.width, input.height) && !dynamic {
            return Err(wrong(
                "detector size",
                format!("{:?} takes {}x{} pictures only", entry.name, input.width, input.height),
            ));
        }
        let possible = |length: usize| length > 0 && length <= 8192 && length.is_multiple_of(input.multiple);
        if !possible(size.0) || !possible(size.1) {
            return Err(wrong(
                "detector size",
                format!("{}x{}: both must be multiples of {}, at most 8192", size.0, size.1, input.multiple),
            ));
        }
        let threshold = settings.score_threshold.or(output.score_threshold).unwrap_or(0.5);
        if !(threshold > 0.0 && threshold < 1.0) {
            return Err(wrong("detector threshold", format!("{threshold} is not between 0 and 1")));
        }
        for class in &settings.classes {
            if !output.classes.contains(class) {
                let known = output.classes.join(", ");
                return Err(wrong(
                    "detector classes",
                    format!("{:?} has no class {class:?}; it has: {known}", entry.name),
                ));
            }
        }
        let wanted = |(index, class)| match settings.classes.is_empty() {
            true => index == 0,
            false => settings.classes.contains(class),
        };
        Ok(Self {
            input: input.clone(),
            size,
            // An engine of TensorRT is built for one size, for minutes.
            shrink: dynamic && provider != Provider::TensorRt,
            decoder: Decoder {
                family: entry.family,
                strides: output.strides.clone(),
                wanted: Wanted {
                    threshold: threshold as f32,
                    classes: output.classes.iter().enumerate().map(wanted).collect(),
                },
            },
            nms_iou: output.nms_iou.unwrap_or(0.6) as f32,
            classes: output.classes.clone(),
        })
    }

    fn letterbox(&self, image: &Image) -> Letterbox {
        Letterbox::new(&self.input, self.size, (image.width, image.height), self.shrink)
    }
}

/// One instance of a detector.
pub(crate) struct DetectModel {
    graph: PictureGraph,
    spec: Arc<DetectSpec>,
    normalisation: Normalisation,
    rasteriser: Rasteriser,
    candidates: Vec<Candidate>,
    last: Duration,
}

impl DetectModel {
    pub(crate) fn load(
        runtime: &Runtime,
        entry: &ModelEntry,
        file: &Path,
        arrangement: Arrangement,
        spec: Arc<DetectSpec>,
    ) -> Result<Self, InferError> {
        let graph = PictureGraph::load(runtime, entry, file, arrangement.max_batch, spec.size)?;
        Ok(Self {
            graph,
            normalisation: Normalisation::new(&spec.input),
            rasteriser: Rasteriser::new(),
            spec,
            candidates: vec![],
            last: Duration::ZERO,
        })
    }

    /// Runs what will be run, so that the first frame does not pay for what is made lazily and a graph that gives
    /// another shape than its family's is found now.
    pub(crate) fn warm_up(&mut self) -> Result<(), InferError> {
        let (width, height) = self.spec.size;
        self.graph.warm_up(self.spec.size)?;
        self.run(&[grey(width as u32, height as u32)]).map(drop)
    }

    /// Writes `batch` copies of a frame into the network's input.
    pub(crate) fn prepare(&mut self, image: &Image, batch: usize) -> Result<(), InferError> {
        self.write(&vec![image; batch.min(self.graph.most())]).map(drop)
    }

    /// Runs the network alone, on what lies in its input.
    pub(crate) fn run_network(&mut self) -> Result<(), InferError> {
        self.graph.run(|_, _| Ok(()))
    }

    /// Writes frames whose tensors have one shape; where each lies in its tensor.
    fn write(&mut self, images: &[&Image]) -> Result<Vec<Letterbox>, InferError> {
        let letterboxes: Vec<Letterbox> = images.iter().map(|image| self.spec.letterbox(image)).collect();
        let Placement { width, height, .. } = letterboxes[0].place;
        let input = self.graph.input(images.len(), (width, height))?;
        let tensors = input.chunks_exact_mut(3 * width * height);
        for ((image, letterbox), tensor) in images.iter().zip(&letterboxes).zip(tensors) {
            let whole = BBox::new(0.0, 0.0, image.width.into(), image.height.into());
            self.rasteriser.write(image, whole, letterbox.place, &self.normalisation, tensor);
        }
        Ok(letterboxes)
    }

    /// Runs frames whose tensors have one shape.
    fn run_alike(&mut self, images: &[&Image]) -> Result<Vec<Vec<Detection>>, InferError> {
        let letterboxes = self.write(images)?;
        let Placement { width, height, .. } = letterboxes[0].place;
        let (spec, candidates) = (&self.spec, &mut self.candidates);
        self.graph.run(|axes, output| {
            let &[_, rows, columns] = axes else {
                return Err(format!("the output has the shape {axes:?}, three axes are expected"));
            };
            let (rows, columns) = (rows as usize, columns as usize);
            let mut answers = Vec::with_capacity(images.len());
            for (index, letterbox) in letterboxes.iter().enumerate() {
                let output = &output[index * rows * columns..][..rows * columns];
                candidates.clear();
                spec.decoder.decode(output, [rows, columns], (width, height), candidates)?;
                suppress(candidates, spec.nms_iou);
                answers.push(candidates.iter().filter_map(|c| detection(letterbox, c)).collect());
            }
            Ok(answers)
        })
    }
}

/// A candidate in the frame; a box without an area is none.
fn detection(letterbox: &Letterbox, candidate: &Candidate) -> Option<Detection> {
    let bbox = letterbox.frame_box(candidate.corners);
    let score = f64::from(candidate.score).min(1.0);
    bbox.is_valid().then_some(Detection { bbox, score, class: ClassId(candidate.class) })
}

impl BatchModel for DetectModel {
    type Job = Image;
    type Answer = Vec<Detection>;

    fn run(&mut self, jobs: &[Image]) -> Result<Vec<Vec<Detection>>, InferError> {
        self.graph.take_time();
        // Frames of one shape share a call of the graph.
        let sizes: Vec<(usize, usize)> = jobs
            .iter()
            .map(|image| self.spec.letterbox(image).place)
            .map(|place| (place.width, place.height))
            .collect();
        let mut order: Vec<usize> = (0..jobs.len()).collect();
        order.sort_by_key(|&index| sizes[index]);
        let mut answers = vec![vec![]; jobs.len()];
        for alike in order.chunk_by(|&a, &b| sizes[a] == sizes[b]) {
            for some in alike.chunks(self.graph.most()) {
                let images: Vec<&Image> = some.iter().map(|&index| &jobs[index]).collect();
                for (&index, found) in some.iter().zip(self.run_alike(&images)?) {
                    answers[index] = found;
                }
            }
        }
        self.last = self.graph.take_time();
        Ok(answers)
    }

    fn session_time(&self) -> Duration {
        self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::testing::{fixture, runtime};
    use crate::infer::{ColourOrder, Dim, Family, Fit, OutputSpec, Task};
    use crate::types::{Plane, YuvMatrix, YuvRange};

    /// The small detector of `tests/fixtures/infer`: it sees cells of 8x8 pixels that are bright.
    fn entry(batch: Dim) -> ModelEntry {
        let any = |name: &str| Dim::Dynamic(name.into());
        ModelEntry {
            name: "cells".into(),
            task: Task::Detect,
            family: Family::Yolox,
            file: "yolox.onnx".into(),
            sha256: String::new(),
            license: String::new(),
            source: String::new(),
            input: Some(InputSpec {
                name: "images".into(),
                shape: vec![batch, Dim::Fixed(3), any("height"), any("width")],
                width: 64,
                height: 64,
                multiple: 8,
                colour: ColourOrder::Rgb,
                mean: [0.0; 3],
                std: [1.0; 3],
                resize: Fit::LetterboxTopLeft,
                pad: 0.0,
            }),
            output: Some(OutputSpec {
                name: "output".into(),
                shape: vec![any("batch"), any("points"), Dim::Fixed(6)],
                classes: vec!["person".into()],
                strides: vec![8],
                score_threshold: Some(0.3),
                nms_iou: Some(0.6),
                width: None,
                tracking: crate::infer::Calibration::default(),
            }),
        }
    }

    /// A dark picture with one bright cell.
    fn picture((width, height): (u32, u32), (x0, y0): (usize, usize)) -> Image {
        let (w, h) = (width as usize, height as usize);
        let mut bytes = vec![0; w * h];
        for y in y0..y0 + 8 {
            bytes[y * w + x0..y * w + x0 + 8].fill(255);
        }
        bytes.extend(vec![128; w * h / 2]);
        let planes =
            [(0, w), (w * h, w / 2), (w * h * 5 / 4, w / 2)].map(|(offset, stride)| Plane { offset, stride });
        Image::i420((width, height), YuvRange::Full, YuvMatrix::Bt601, planes, Arc::new(bytes))
            .expect("a picture")
    }

    #[test]
    fn frames_of_many_shapes_are_batched() {
        let Some(runtime) = runtime() else { return };
        let frames: Vec<((u32, u32), (usize, usize))> = (0..11)
            .map(|n| match n % 3 {
                0 => ((64, 64), (n * 8 % 64, n / 4 * 8)),
                1 => ((64, 32), (8, n / 4 * 8)),
                _ => ((32, 64), (n / 4 * 8, 16)),
            })
            .collect();
        let images: Vec<Image> = frames.iter().map(|&(size, at)| picture(size, at)).collect();
        // As many as one call may hold; a file that takes two at a time.
        for (batch, max_batch) in [(Dim::Dynamic("batch".into()), 4), (Dim::Fixed(2), 16)] {
            let entry = entry(batch);
            let spec = DetectSpec::new(&entry, &DetectorSettings::default(), runtime.provider);
            let spec = Arc::new(spec.expect("a detector"));
            let arrangement = Arrangement { workers: 1, max_batch, max_wait: Duration::ZERO, capacity: 1 };
            let file = fixture("yolox.onnx");
            let mut model = DetectModel::load(&runtime, &entry, &file, arrangement, spec).expect("the graph");
            let answers = model.run(&images).expect("detections");
            assert_eq!(answers.len(), frames.len());
            for (&(size, (x, y)), found) in frames.iter().zip(answers) {
                assert_eq!(found.len(), 1, "{size:?}: {found:?}");
                let expected = BBox::new(x as f64, y as f64, 8.0, 8.0);
                assert!(found[0].bbox.iou(&expected) > 0.999, "{size:?}: {found:?}");
            }
            assert!(model.session_time() > Duration::ZERO);
        }
    }
}
