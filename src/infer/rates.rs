//! How many frames, crops and pairs a second each model takes, against the batch: what the arrangement of a provider is
//! chosen by.

use std::sync::{Arc, Barrier};
use std::thread;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::linker::LinkModel;
use super::models::{Chosen, Plan, Reid};
use super::{Arrangement, BatchModel, InferError, ModelSettings, Task};
use crate::detect::{DetectModel, DetectSpec, grey};
use crate::embed::{EmbedJob, EmbedModel, NetworkModel};
use crate::track::{HISTORY, LinkRequest, Pair};
use crate::types::BBox;

/// Pairs of a track, in the requests that the link scorer is asked.
const PAIRS: usize = 4;

/// What is measured.
#[derive(Clone, Debug)]
pub struct Load {
    /// Width and height of a frame, pixels.
    pub frame: (u32, u32),
    /// Frames that the detector is given at once.
    pub frames: Vec<usize>,
    /// Crops, a quarter as wide and half as high as the frame, that the appearance model is given at once.
    pub crops: Vec<usize>,
    /// Pairs that the link scorer is given at once, four of a track.
    pub pairs: Vec<usize>,
    /// How long each is measured.
    pub lasts: Duration,
}

/// A model's rates.
#[derive(Clone, Debug, Serialize)]
pub struct ModelRates {
    /// `detect`, `reid` or `link`.
    pub task: &'static str,
    /// Its name in the manifest, or `builtin`.
    pub model: String,
    /// What is counted: `frames`, `crops` or `pairs`.
    pub items: &'static str,
    /// By batch.
    pub rates: Vec<Rate>,
}

impl ModelRates {
    /// Items a second if nothing but ONNX Runtime took time, in the best batch: the limit of the device. `None` for a
    /// model that is not ONNX Runtime's.
    pub fn limit(&self) -> Option<f64> {
        let alone = self.rates.iter().filter_map(Rate::alone);
        alone.reduce(f64::max)
    }
}

/// A rate with one batch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rate {
    /// Items of a call.
    pub batch: usize,
    /// Threads, each with its own session.
    pub threads: usize,
    /// Items a second of all threads together: pre-processing, the network, decoding.
    pub per_second: f64,
    /// The part of the time that is ONNX Runtime's.
    pub inside: f64,
    /// 50, 95 and 99 of 100 calls take at most so long, milliseconds.
    pub call_ms: [f64; 3],
}

impl Rate {
    /// Items a second of ONNX Runtime alone.
    pub fn alone(&self) -> Option<f64> {
        (self.inside > 0.0).then(|| self.per_second / self.inside)
    }
}

/// Measures the models that `settings` name, on as many threads as the provider's arrangement has. Gives the provider's
/// name as well.
///
/// # Errors
/// What [`super::Models::load`] says, or a model's failure.
pub fn rates(settings: &ModelSettings, load: &Load) -> Result<(&'static str, Vec<ModelRates>), InferError> {
    let plan = Plan::new(settings)?;
    let (runtime, lasts) = (&plan.runtime, load.lasts);
    let arrangement = |task| runtime.provider.arrangement(task, settings.threads);
    let (width, height) = load.frame;
    let picture = grey(width, height);
    let mut all = Vec::new();

    let Chosen { entry, file } = &plan.detector;
    let spec = Arc::new(DetectSpec::new(entry, &settings.detection, runtime.provider)?);
    let detect = |batch: usize| {
        let arrangement = Arrangement { max_batch: batch, ..arrangement(Task::Detect) };
        let build = || {
            let mut model = DetectModel::load(runtime, entry, file, arrangement, spec.clone())?;
            model.warm_up().map(|()| model)
        };
        measure(batch, arrangement.workers, lasts, build, || vec![picture.clone(); batch])
    };
    let rates = load.frames.iter().map(|batch| detect(*batch)).collect::<Result<_, _>>()?;
    all.push(ModelRates { task: Task::Detect.as_str(), model: entry.name.clone(), items: "frames", rates });

    let reid = |batch: usize| {
        let build = || match &plan.reid {
            Reid::Network(network) => {
                let mut model = NetworkModel::load(runtime, &network.entry, &network.file)?;
                model.warm_up().map(|()| EmbedModel::Network(Box::new(model)))
            }
            _ => Ok(EmbedModel::Stripes(Box::default())),
        };
        let (w, h) = (f64::from(width) / 4.0, f64::from(height) / 2.0);
        let crop = |n: usize| BBox::new((n % 13) as f64 / 13.0 * 3.0 * w, (n % 7) as f64 / 7.0 * h, w, h);
        let job = || vec![EmbedJob { image: picture.clone(), boxes: (0..batch).map(crop).collect() }];
        measure(batch, arrangement(Task::Reid).workers, lasts, build, job)
    };
    let name = match &plan.reid {
        Reid::None => None,
        Reid::Stripes => Some("builtin"),
        Reid::Network(network) => Some(network.entry.name.as_str()),
    };
    if let Some(name) = name {
        let rates = load.crops.iter().map(|batch| reid(*batch)).collect::<Result<_, _>>()?;
        all.push(ModelRates { task: Task::Reid.as_str(), model: name.into(), items: "crops", rates });
    }

    if let Some(Chosen { entry, file }) = &plan.link {
        let features = LinkModel::load(runtime, &entry.name, file)?.surroundings.features();
        let link = |batch: usize| {
            let build = || {
                let mut model = LinkModel::load(runtime, &entry.name, file)?;
                model.warm_up().map(|()| model)
            };
            let tracks = batch.div_ceil(PAIRS);
            let request = || LinkRequest {
                features,
                histories: vec![0.0; tracks * HISTORY * features.step()],
                lengths: vec![HISTORY as i32; tracks],
                candidates: vec![0.0; batch * features.candidate()],
                pairs: (0..batch).map(|n| Pair { track: (n / PAIRS) as u32, detection: 0 }).collect(),
            };
            measure(batch, arrangement(Task::Link).workers, lasts, build, || vec![request()])
        };
        let rates = load.pairs.iter().map(|batch| link(*batch)).collect::<Result<_, _>>()?;
        all.push(ModelRates { task: Task::Link.as_str(), model: entry.name.clone(), items: "pairs", rates });
    }
    Ok((runtime.provider.as_str(), all))
}

/// Runs the same jobs of `batch` items, over and over, on each of the threads.
fn measure<M: BatchModel>(
    batch: usize,
    threads: usize,
    lasts: Duration,
    build: impl Fn() -> Result<M, InferError> + Sync,
    jobs: impl Fn() -> Vec<M::Job> + Sync,
) -> Result<Rate, InferError> {
    let barrier = Barrier::new(threads);
    let run = || {
        let model = build();
        // Everybody arrives, or nobody would ever start.
        barrier.wait();
        let (mut model, jobs) = (model?, jobs());
        let (start, mut inside, mut calls) = (Instant::now(), Duration::ZERO, Vec::new());
        let mut last = Duration::ZERO;
        while last < lasts {
            model.run(&jobs)?;
            inside += model.session_time();
            let now = start.elapsed();
            calls.push(now - last);
            last = now;
        }
        Ok((last, inside, calls))
    };
    let runs: Vec<_> = thread::scope(|scope| {
        let runs: Vec<_> = (0..threads).map(|_| scope.spawn(run)).collect();
        let joined = runs.into_iter().map(|run| run.join().unwrap_or_else(|p| std::panic::resume_unwind(p)));
        joined.collect::<Result<_, InferError>>()
    })?;
    let per_second = runs.iter().map(|(took, _, calls)| (calls.len() * batch) as f64 / took.as_secs_f64());
    let whole: Duration = runs.iter().map(|(took, ..)| *took).sum();
    let inside: Duration = runs.iter().map(|(_, inside, _)| *inside).sum();
    let mut calls: Vec<f64> =
        runs.iter().flat_map(|(.., calls)| calls).map(|c| c.as_secs_f64() * 1e3).collect();
    calls.sort_by(f64::total_cmp);
    Ok(Rate {
        batch,
        threads,
        per_second: per_second.sum(),
        inside: inside.as_secs_f64() / whole.as_secs_f64(),
        call_ms: [0.5, 0.95, 0.99].map(|share| calls[((calls.len() - 1) as f64 * share).round() as usize]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_the_best_batch_without_anything_else() {
        let rate =
            |batch, per_second, inside| Rate { batch, threads: 2, per_second, inside, call_ms: [0.0; 3] };
        let rates = |rates| ModelRates { task: "detect", model: "m".into(), items: "frames", rates };
        assert_eq!(rates(vec![rate(1, 200.0, 0.8), rate(4, 220.0, 0.5)]).limit(), Some(440.0));
        assert_eq!(rates(vec![rate(1, 200.0, 0.0)]).limit(), None);
    }
}
