//! Detections to embeddings: an appearance vector of each box.
//!
//! Built in are [`stripes`], colour statistics that need no weights; any ReID network that the
//! manifest describes takes their place.

mod network;
pub mod stripes;

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures::future::try_join_all;

pub(crate) use network::NetworkModel;

use crate::infer::{Arrangement, BatchModel, Batcher, InferError, ModelEntry, Observer, Runtime, Task};
use crate::types::{BBox, Embedding, Image};

/// Boxes that show fewer pixels of the frame than this, in width or height, have no appearance.
const MIN_SIDE: f64 = 4.0;

/// Gives boxes of a frame their appearance. Clones share the model.
#[derive(Clone)]
pub struct Embedder {
    batcher: Arc<Batcher<EmbedModel>>,
    /// Boxes of one frame that go into one request.
    share: usize,
    width: usize,
}

impl Embedder {
    /// Starts the workers with the built-in colour stripes.
    pub(crate) fn start_stripes(
        arrangement: Arrangement,
        observer: Arc<dyn Observer>,
    ) -> Result<Self, InferError> {
        let build = |_| Ok(EmbedModel::Stripes(Box::default()));
        let batcher = Batcher::start(Task::Reid.as_str(), arrangement, observer, build)?;
        // A crop takes microseconds: a frame's boxes stay together.
        Ok(Self { batcher: Arc::new(batcher), share: 256, width: stripes::WIDTH })
    }

    /// Loads a ReID network on every worker, checks it against its entry and runs it once.
    pub(crate) fn start_network(
        runtime: &Runtime,
        entry: &ModelEntry,
        file: &Path,
        arrangement: Arrangement,
        observer: Arc<dyn Observer>,
    ) -> Result<Self, InferError> {
        let width = entry.output.as_ref().and_then(|output| output.width).unwrap_or(0);
        let (runtime, entry, file) = (runtime.clone(), entry.clone(), file.to_path_buf());
        let build = move |_| {
            let mut model = NetworkModel::load(&runtime, &entry, &file)?;
            model.warm_up()?;
            Ok(EmbedModel::Network(Box::new(model)))
        };
        let batcher = Batcher::start(Task::Reid.as_str(), arrangement, observer, build)?;
        // Without batches the boxes of one frame spread over the workers.
        let share = if arrangement.max_batch == 1 { 2 } else { arrangement.max_batch };
        Ok(Self { batcher: Arc::new(batcher), share, width })
    }

    /// The appearance of each box, in their order; `None` where a box shows too little of the frame.
    ///
    /// # Errors
    /// The model's failure, or [`InferError::Stopped`].
    pub async fn embed(&self, image: Image, boxes: Vec<BBox>) -> Result<Vec<Option<Embedding>>, InferError> {
        let crops: Vec<Option<BBox>> = boxes.iter().map(|bbox| visible(&image, bbox)).collect();
        let inside: Vec<BBox> = crops.iter().copied().flatten().collect();
        let requests = inside
            .chunks(self.share)
            .map(|boxes| self.batcher.submit(EmbedJob { image: image.clone(), boxes: boxes.to_vec() }));
        let mut found = try_join_all(requests).await?.into_iter().flatten();
        Ok(crops.iter().map(|crop| crop.and_then(|_| found.next().flatten())).collect())
    }

    /// [`Embedder::embed`] for a thread that may wait.
    ///
    /// # Errors
    /// As [`Embedder::embed`].
    pub fn embed_blocking(
        &self,
        image: Image,
        boxes: Vec<BBox>,
    ) -> Result<Vec<Option<Embedding>>, InferError> {
        futures::executor::block_on(self.embed(image, boxes))
    }

    /// Numbers in an embedding.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Requests in the queue now.
    pub fn depth(&self) -> usize {
        self.batcher.depth()
    }

    /// How it runs.
    pub fn arrangement(&self) -> Arrangement {
        self.batcher.arrangement()
    }

    /// Stops taking requests, answers those in the queue and joins the workers.
    pub fn shutdown(&self) {
        self.batcher.shutdown();
    }
}

/// The part of a box that lies in the frame, when it is worth looking at.
pub(crate) fn visible(image: &Image, bbox: &BBox) -> Option<BBox> {
    if !bbox.is_valid() {
        return None;
    }
    let part = bbox.clipped(image.width.into(), image.height.into())?;
    (part.w >= MIN_SIDE && part.h >= MIN_SIDE).then_some(part)
}

/// Boxes of one frame; every one lies inside it.
pub(crate) struct EmbedJob {
    pub image: Image,
    pub boxes: Vec<BBox>,
}

/// One instance of an appearance model.
pub(crate) enum EmbedModel {
    Stripes(Box<stripes::ColourStripes>),
    Network(Box<NetworkModel>),
}

impl BatchModel for EmbedModel {
    type Job = EmbedJob;
    type Answer = Vec<Option<Embedding>>;

    fn run(&mut self, jobs: &[EmbedJob]) -> Result<Vec<Vec<Option<Embedding>>>, InferError> {
        match self {
            EmbedModel::Stripes(stripes) => Ok(jobs
                .iter()
                .map(|job| job.boxes.iter().map(|bbox| stripes.embed(&job.image, bbox)).collect())
                .collect()),
            EmbedModel::Network(network) => network.run(jobs),
        }
    }

    fn items(job: &EmbedJob) -> usize {
        job.boxes.len()
    }

    fn session_time(&self) -> Duration {
        match self {
            EmbedModel::Stripes(_) => Duration::ZERO,
            EmbedModel::Network(network) => network.session_time(),
        }
    }
}
