//! How fast the models are alone: no queue, no decoding of video, no pre-processing of frames.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Barrier};
use std::thread;
use std::time::{Duration, Instant};

use super::linker::LinkModel;
use super::manifest::Family;
use super::models::{Chosen, Plan, Reid, link_alone};
use super::{Arrangement, BatchModel, InferError, ModelSettings, Task};
use crate::detect::{DetectModel, DetectSpec};
use crate::embed::{EmbedJob, EmbedModel, NetworkModel};
use crate::track::{Association, LinkRequest, TrackerConfig};
use crate::types::{BBox, Image};

/// What the models are asked about one frame.
#[derive(Clone, Debug)]
pub struct FrameWork {
    /// The frame, for the detector and for appearance.
    pub image: Image,
    /// The boxes whose appearance is wanted.
    pub boxes: Vec<BBox>,
    /// The pairs to score.
    pub link: LinkRequest,
}

/// What [`models_alone`] measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AloneReport {
    /// Frames that were run.
    pub frames: usize,
    /// Threads, each with its own instance of every model.
    pub threads: usize,
    /// Frames that one call of the detector held.
    pub batch: usize,
    /// Time from the first frame to the last.
    pub wall: Duration,
    /// Time inside the detector, summed over the threads.
    pub detect: Duration,
    /// Time inside the appearance model, summed over the threads.
    pub reid: Duration,
    /// Time inside the link scorer, summed over the threads.
    pub link: Duration,
}

impl AloneReport {
    /// Frames a second of all threads together.
    pub fn frames_per_second(&self) -> f64 {
        self.frames as f64 / self.wall.as_secs_f64()
    }
}

/// Tensors that are prepared beforehand; a network takes the same time whatever is in the picture, so
/// they are used in turn.
const PREPARED: usize = 16;

/// Runs `frames` frames, taken from `work` in turn, through the detector, the appearance model and the
/// link scorer of `settings`, one after the other on each of the threads that the provider's
/// arrangement gives (single-threaded sessions, one a core, on the CPU).
///
/// # Errors
/// What [`super::Models::load`] says, a model's failure, or no work.
pub fn models_alone(
    settings: &ModelSettings,
    work: &[FrameWork],
    frames: usize,
) -> Result<AloneReport, InferError> {
    if work.is_empty() || frames == 0 {
        return Err(InferError::Setting { setting: "bench", reason: "no frames to run".into() });
    }
    let plan = Plan::new(settings)?;
    let arrangement = plan.runtime.provider.arrangement(Task::Detect, settings.threads);
    let Arrangement { workers: threads, max_batch: batch, .. } = arrangement;
    let spec = Arc::new(DetectSpec::new(&plan.detector.entry, &settings.detection)?);
    let barrier = Barrier::new(threads + 1);
    // Whoever is free takes the next frames: a thread that the machine holds up does not stand for all.
    let next = AtomicUsize::new(0);
    thread::scope(|scope| {
        let runs: Vec<_> = (0..threads)
            .map(|index| {
                let (plan, spec, barrier, next) = (&plan, &spec, &barrier, &next);
                let run = move || {
                    let instance = Instance::load(plan, spec, settings, arrangement, work);
                    // Everybody arrives, or nobody would ever start.
                    barrier.wait();
                    instance?.run(work, next, frames, batch)
                };
                thread::Builder::new()
                    .name(format!("bench-{index}"))
                    .spawn_scoped(scope, run)
                    .expect("a thread for a model")
            })
            .collect();
        barrier.wait();
        let mut report = AloneReport {
            frames,
            threads,
            batch,
            wall: Duration::ZERO,
            detect: Duration::ZERO,
            reid: Duration::ZERO,
            link: Duration::ZERO,
        };
        let (mut first, mut last) = (None, None);
        for run in runs {
            let (start, end, [detect, reid, link]) =
                run.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
            report.detect += detect;
            report.reid += reid;
            report.link += link;
            // This thread may wake up late from the barrier: the workers' own clocks count.
            first = Some(first.map_or(start, |first: Instant| first.min(start)));
            last = last.max(Some(end));
        }
        if let (Some(first), Some(last)) = (first, last) {
            report.wall = last - first;
        }
        Ok(report)
    })
}

/// The link scorer on the caller's thread: no queue and no worker, one single-threaded session.
pub struct LinkAlone(LinkModel);

impl LinkAlone {
    /// Loads the link scorer that `settings` name, one of the implicit association.
    ///
    /// # Errors
    /// As [`super::Linker::load`] and [`super::Linker::check_suits`].
    pub fn load(settings: &ModelSettings) -> Result<Self, InferError> {
        let (runtime, Chosen { entry, file }) = link_alone(settings)?;
        if entry.family != Family::Gru {
            let association = Association::Implicit.as_str();
            return Err(InferError::Association { name: entry.name, association });
        }
        Ok(Self(LinkModel::load(&runtime, &entry.name, &file)?))
    }

    /// As [`super::Linker::calibrate`].
    pub fn calibrate(&self, tracker: TrackerConfig) -> TrackerConfig {
        self.0.surroundings.calibrate(tracker)
    }

    /// As [`super::Linker::score`].
    ///
    /// # Errors
    /// The model's failure.
    pub fn score(&mut self, request: &LinkRequest) -> Result<Vec<f32>, InferError> {
        self.0.check(request)?;
        let mut answers = self.0.run(std::slice::from_ref(request))?;
        Ok(answers.pop().unwrap_or_default())
    }
}

/// One thread's models.
struct Instance {
    detector: DetectModel,
    tensors: Vec<([usize; 4], Vec<f32>)>,
    reid: Option<EmbedModel>,
    link: Option<LinkModel>,
}

impl Instance {
    fn load(
        plan: &Plan,
        spec: &Arc<DetectSpec>,
        settings: &ModelSettings,
        arrangement: Arrangement,
        work: &[FrameWork],
    ) -> Result<Self, InferError> {
        let runtime = &plan.runtime;
        let Chosen { entry, file } = &plan.detector;
        let mut detector = DetectModel::load(runtime, entry, file, arrangement, spec.clone())?;
        detector.warm_up()?;
        let frames = work.iter().take(PREPARED);
        let tensors = frames.map(|work| detector.tensor(&work.image, arrangement.max_batch)).collect();
        let reid = match &plan.reid {
            Reid::None => None,
            Reid::Stripes => Some(EmbedModel::Stripes(Box::default())),
            Reid::Network(network) => {
                let Chosen { entry, file } = &**network;
                let arrangement = runtime.provider.arrangement(Task::Reid, settings.threads);
                let mut network = NetworkModel::load(runtime, entry, file, arrangement)?;
                network.warm_up()?;
                Some(EmbedModel::Network(Box::new(network)))
            }
        };
        let link = match &plan.link {
            None => None,
            Some(Chosen { entry, file }) => Some(LinkModel::load(runtime, &entry.name, file)?),
        };
        Ok(Self { detector, tensors, reid, link })
    }

    /// Runs frames until none is left. When it began and ended, and the time in the detector, the
    /// appearance model and the link scorer.
    fn run(
        mut self,
        work: &[FrameWork],
        next: &AtomicUsize,
        frames: usize,
        batch: usize,
    ) -> Result<Span, InferError> {
        let mut spent = [Duration::ZERO; 3];
        let start = Instant::now();
        let mut clock = start;
        let mut lap = |spent: &mut Duration| {
            let now = Instant::now();
            *spent += now - clock;
            clock = now;
        };
        loop {
            let first = next.fetch_add(batch, Ordering::Relaxed);
            if first >= frames {
                break;
            }
            let (shape, tensor) = &self.tensors[first / batch % self.tensors.len()];
            self.detector.run_tensor(*shape, tensor)?;
            lap(&mut spent[0]);
            for at in first..frames.min(first + batch) {
                let FrameWork { image, boxes, link } = &work[at % work.len()];
                if let Some(reid) = &mut self.reid
                    && !boxes.is_empty()
                {
                    let boxes = boxes.iter().filter_map(|bbox| crate::embed::visible(image, bbox)).collect();
                    reid.run(&[EmbedJob { image: image.clone(), boxes }])?;
                }
                lap(&mut spent[1]);
                if let Some(scorer) = &mut self.link
                    && !link.is_empty()
                {
                    scorer.check(link)?;
                    scorer.run(std::slice::from_ref(link))?;
                }
                lap(&mut spent[2]);
            }
        }
        Ok((start, clock, spent))
    }
}

/// Beginning, end, time in each model.
type Span = (Instant, Instant, [Duration; 3]);
