//! A ReID network: crops in, vectors out.

use std::path::Path;
use std::time::Duration;

use super::EmbedJob;
use crate::infer::{
    InferError, InputSpec, ModelEntry, Normalisation, PictureGraph, Placement, Rasteriser, Runtime,
};
use crate::types::{BBox, Embedding, Image};

/// Crops that one call of the graph holds at most: a tensor of 64 crops of 256x128 is 25 MB.
const MOST: usize = 64;

/// One instance of a ReID network.
pub(crate) struct NetworkModel {
    graph: PictureGraph,
    input: InputSpec,
    normalisation: Normalisation,
    rasteriser: Rasteriser,
    width: usize,
    last: Duration,
}

impl NetworkModel {
    pub(crate) fn load(runtime: &Runtime, entry: &ModelEntry, file: &Path) -> Result<Self, InferError> {
        let (Some(input), Some(width)) = (&entry.input, entry.output.as_ref().and_then(|o| o.width)) else {
            return Err(InferError::Graph {
                name: entry.name.clone(),
                reason: "it is no ReID network".into(),
            });
        };
        let graph = PictureGraph::load(runtime, entry, file, MOST, (input.width, input.height))?;
        Ok(Self {
            graph,
            normalisation: Normalisation::new(input),
            rasteriser: Rasteriser::new(),
            width,
            input: input.clone(),
            last: Duration::ZERO,
        })
    }

    pub(crate) fn warm_up(&mut self) -> Result<(), InferError> {
        self.graph.warm_up((self.input.width, self.input.height))?;
        let image = crate::detect::grey(self.input.width as u32, self.input.height as u32);
        let boxes = vec![BBox::new(0.0, 0.0, image.width.into(), image.height.into())];
        self.run(&[EmbedJob { image, boxes }]).map(drop)
    }

    pub(crate) fn run(&mut self, jobs: &[EmbedJob]) -> Result<Vec<Vec<Option<Embedding>>>, InferError> {
        self.graph.take_time();
        let crops: Vec<(&Image, BBox)> =
            jobs.iter().flat_map(|job| job.boxes.iter().map(|bbox| (&job.image, *bbox))).collect();
        let mut all = Vec::with_capacity(crops.len());
        for some in crops.chunks(self.graph.most()) {
            self.run_crops(some, &mut all)?;
        }
        self.last = self.graph.take_time();
        let mut all = all.into_iter();
        Ok(jobs.iter().map(|job| all.by_ref().take(job.boxes.len()).collect()).collect())
    }

    pub(crate) fn session_time(&self) -> Duration {
        self.last
    }

    fn run_crops(
        &mut self,
        crops: &[(&Image, BBox)],
        all: &mut Vec<Option<Embedding>>,
    ) -> Result<(), InferError> {
        let (w, h) = (self.input.width, self.input.height);
        let place = Placement { width: w, height: h, x: 0, y: 0, w, h };
        let tensors = self.graph.input(crops.len(), (w, h))?.chunks_exact_mut(3 * w * h);
        for ((image, bbox), tensor) in crops.iter().zip(tensors) {
            self.rasteriser.write(image, *bbox, place, &self.normalisation, tensor);
        }
        let width = self.width;
        self.graph.run(|axes, output| {
            if axes[1..] != [width as i64] {
                return Err(format!("the output has the shape {axes:?}, [batch, {width}] is expected"));
            }
            all.extend(
                output.chunks_exact(width).take(crops.len()).map(|v| Embedding::normalised(v.to_vec())),
            );
            Ok(())
        })
    }
}
