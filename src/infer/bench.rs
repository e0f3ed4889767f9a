//! How fast the models are alone: no queue, no decoding of video, no pre-processing of frames.

use std::cell::Cell;
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

/// [`models_alone`] at a camera's pace: a frame in every `interval`, on one thread. In between, others use the caches and
/// the core sleeps, so that a frame takes longer than one of many.
///
/// # Errors
/// As [`models_alone`].
pub fn models_at_pace(
    settings: &ModelSettings,
    work: &[FrameWork],
    frames: usize,
    interval: Duration,
) -> Result<AloneReport, InferError> {
    run_alone(&ModelSettings { threads: Some(1), ..settings.clone() }, work, frames, Some(interval))
}

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
    run_alone(settings, work, frames, None)
}

fn run_alone(
    settings: &ModelSettings,
    work: &[FrameWork],
    frames: usize,
    pace: Option<Duration>,
) -> Result<AloneReport, InferError> {
    if work.is_empty() || frames == 0 {
        return Err(InferError::Setting { setting: "bench", reason: "no frames to run".into() });
    }
    let plan = Plan::new(settings)?;
    let arrangement = plan.runtime.provider.arrangement(Task::Detect, settings.threads);
    let Arrangement { workers: threads, max_batch: batch, .. } = arrangement;
    let spec = Arc::new(DetectSpec::new(&plan.detector.entry, &settings.detection, plan.runtime.provider)?);
    let barrier = Barrier::new(threads + 1);
    // Whoever is free takes the next frames: a thread that the machine holds up does not stand for all.
    let next = AtomicUsize::new(0);
    thread::scope(|scope| {
        let runs: Vec<_> = (0..threads)
            .map(|index| {
                let (plan, spec, barrier, next) = (&plan, &spec, &barrier, &next);
                let run = move || {
                    let instance = Instance::load(plan, spec, arrangement, work);
                    // Everybody arrives, or nobody would ever start.
                    barrier.wait();
                    instance?.run(work, next, frames, batch, pace)
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
    reid: Option<EmbedModel>,
    link: Option<LinkModel>,
}

impl Instance {
    fn load(
        plan: &Plan,
        spec: &Arc<DetectSpec>,
        arrangement: Arrangement,
        work: &[FrameWork],
    ) -> Result<Self, InferError> {
        let runtime = &plan.runtime;
        let Chosen { entry, file } = &plan.detector;
        let mut detector = DetectModel::load(runtime, entry, file, arrangement, spec.clone())?;
        detector.warm_up()?;
        // A network takes the same time whatever is in the picture.
        detector.prepare(&work[0].image, arrangement.max_batch)?;
        let reid = match &plan.reid {
            Reid::None => None,
            Reid::Stripes => Some(EmbedModel::Stripes(Box::default())),
            Reid::Network(network) => {
                let Chosen { entry, file } = &**network;
                let mut network = NetworkModel::load(runtime, entry, file)?;
                network.warm_up()?;
                Some(EmbedModel::Network(Box::new(network)))
            }
        };
        let link = match &plan.link {
            None => None,
            Some(Chosen { entry, file }) => Some(LinkModel::load(runtime, &entry.name, file)?),
        };
        Ok(Self { detector, reid, link })
    }

    /// Runs frames until none is left. When it began and ended, and the time in the detector, the
    /// appearance model and the link scorer.
    fn run(
        mut self,
        work: &[FrameWork],
        next: &AtomicUsize,
        frames: usize,
        batch: usize,
        pace: Option<Duration>,
    ) -> Result<Span, InferError> {
        let mut spent = [Duration::ZERO; 3];
        let start = Instant::now();
        let clock = Cell::new(start);
        let lap = |spent: &mut Duration| {
            let now = Instant::now();
            *spent += now - clock.replace(now);
        };
        loop {
            let first = next.fetch_add(batch, Ordering::Relaxed);
            if first >= frames {
                break;
            }
            if let Some(interval) = pace {
                let due = start + interval * (first as u32);
                thread::sleep(due.saturating_duration_since(Instant::now()));
                clock.set(Instant::now());
            }
            self.detector.run_network()?;
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
        Ok((start, clock.get(), spent))
    }
}

/// Beginning, end, time in each model.
type Span = (Instant, Instant, [Duration; 3]);
