//! The link scorer: histories of tracks and candidate detections to link probabilities.
//!
//! The graph takes `histories` f32 `[T, 6, S]`, `lengths` i32 `[T]`, `candidates` f32 `[P, C]` and
//! `pair_track` i64 `[P]` (which history a candidate belongs to) and gives `probability` f32 `[P]`.
//! The file's metadata may hold what belongs to the network: the [`Features`] that it reads, as `features`
//! (S and C are their widths; [`Features::Relative`], 14 and 20, without), the filter that it was trained
//! with, as `filter` (the table of a tuning file), and an [`ExistenceHead`], trained on what the tracker makes
//! of these very probabilities, as `existence`.
//!
//! Requests of several cameras are joined by concatenation; `pair_track` moves by the tracks before it.

use std::iter::successors;
use std::path::Path;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use ort::session::Session;
use ort::value::{TensorElementType, TensorRef};

use super::graph::check_type;
use super::manifest::{Family, ModelEntry};
use super::runtime::Runtime;
use super::{Arrangement, BatchModel, Batcher, InferError, Observer, Provider, Task};
use crate::track::{Association, ExistenceHead, Features, HISTORY, LinkRequest, TrackerConfig};
use crate::tuning::FilterTuning;

const MODEL: &str = Task::Link.as_str();
const INPUTS: [(&str, TensorElementType); 4] = [
    ("histories", TensorElementType::Float32),
    ("lengths", TensorElementType::Int32),
    ("candidates", TensorElementType::Float32),
    ("pair_track", TensorElementType::Int64),
];
const OUTPUT: &str = "probability";
/// Tracks and pairs of the largest request that is run beforehand, where requests are filled up.
const WARM: usize = 1024;
/// Metadata that names the features.
const FEATURES: &str = "features";
/// Metadata that holds the existence head.
const EXISTENCE: &str = "existence";
/// Metadata that holds the filter.
const FILTER: &str = "filter";

/// What a network's file says of the tracker around it.
#[derive(Clone, Debug, Default)]
pub(super) struct Surroundings {
    features: Features,
    existence: Option<Arc<ExistenceHead>>,
    filter: FilterTuning,
}

impl Surroundings {
    fn read(session: &Session) -> Result<Self, String> {
        let metadata = session.metadata().map_err(|e| format!("its metadata cannot be read: {e}"))?;
        let features = metadata.custom(FEATURES).map(|text| text.parse()).transpose();
        let existence = metadata.custom(EXISTENCE).map(|text| text.parse()).transpose();
        let filter = metadata.custom(FILTER).map(|text| FilterTuning::parse(&text)).transpose();
        Ok(Self {
            features: features.map_err(|e| format!("its features are unknown: {e}"))?.unwrap_or_default(),
            existence: existence.map_err(|e| format!("its existence head is broken: {e}"))?.map(Arc::new),
            filter: filter.map_err(|e| format!("its filter is broken: {e}"))?.unwrap_or_default(),
        })
    }

    /// What the network reads.
    pub(super) fn features(&self) -> Features {
        self.features
    }

    /// `tracker` with the network's features, and its filter and existence head where it has them.
    pub(super) fn calibrate(&self, mut tracker: TrackerConfig) -> TrackerConfig {
        tracker.association.features = self.features;
        tracker.filter = self.filter.apply(tracker.filter);
        tracker.existence.head = self.existence.clone();
        tracker
    }
}

/// Scores link requests. Clones share the model.
#[derive(Clone)]
pub struct Linker {
    batcher: Arc<Batcher<LinkModel>>,
    surroundings: Surroundings,
    name: Arc<str>,
    family: Family,
}

impl Linker {
    /// Starts the workers.
    pub(super) fn start(
        runtime: &Runtime,
        entry: &ModelEntry,
        file: &Path,
        arrangement: Arrangement,
        observer: Arc<dyn Observer>,
    ) -> Result<Self, InferError> {
        let (runtime, name, file) = (runtime.clone(), entry.name.clone(), file.to_path_buf());
        let surroundings = Arc::new(OnceLock::new());
        let found = surroundings.clone();
        let batcher = Batcher::start(MODEL, arrangement, observer, move |_| {
            let mut model = LinkModel::load(&runtime, &name, &file)?;
            found.get_or_init(|| model.surroundings.clone());
            model.warm_up()?;
            Ok(model)
        })?;
        Ok(Self {
            batcher: Arc::new(batcher),
            name: entry.name.as_str().into(),
            family: entry.family,
            surroundings: surroundings.get().cloned().unwrap_or_default(),
        })
    }

    /// What its probabilities are named after.
    pub fn association(&self) -> Association {
        match self.family {
            Family::Explicit => Association::Explicit,
            _ => Association::Implicit,
        }
    }

    /// What it reads.
    pub fn features(&self) -> Features {
        self.surroundings.features
    }

    /// `tracker` with the features that the model reads, and the filter and the existence head that its file
    /// carries, if it does.
    pub fn calibrate(&self, tracker: TrackerConfig) -> TrackerConfig {
        self.surroundings.calibrate(tracker)
    }

    /// Whether its probabilities are those that `association` is named after.
    ///
    /// # Errors
    /// [`InferError::Association`]: it is a network of another association.
    pub fn check_suits(&self, association: Association) -> Result<(), InferError> {
        let wanted = match association {
            Association::Implicit => Family::Gru,
            Association::Explicit => Family::Explicit,
            _ => return Ok(()),
        };
        if self.family == wanted {
            return Ok(());
        }
        Err(InferError::Association { name: self.name.to_string(), association: association.as_str() })
    }

    /// Whether embeddings of `width` numbers, or none at all, are what it reads. A network that takes any
    /// or needs none is content.
    ///
    /// # Errors
    /// [`InferError::Embeddings`]: it was trained on others.
    pub fn check_embeddings(&self, width: Option<usize>) -> Result<(), InferError> {
        match self.features().embedding() {
            Some(expected) if Some(expected) != width => {
                Err(InferError::Embeddings { name: self.name.to_string(), expected, width })
            }
            _ => Ok(()),
        }
    }

    /// The probabilities of a request's pairs, in their order, each in `[0, 1]`. An empty request is
    /// answered at once.
    ///
    /// # Errors
    /// [`InferError::Request`] when the request's parts do not fit each other, or the model's failure.
    pub async fn score(&self, request: LinkRequest) -> Result<Vec<f32>, InferError> {
        check(&request, self.features())?;
        if request.is_empty() {
            return Ok(vec![]);
        }
        self.batcher.submit(request).await
    }

    /// [`Linker::score`] for a thread that may wait.
    ///
    /// # Errors
    /// As [`Linker::score`].
    pub fn score_blocking(&self, request: LinkRequest) -> Result<Vec<f32>, InferError> {
        futures::executor::block_on(self.score(request))
    }

    /// Requests in the queue now.
    pub fn depth(&self) -> usize {
        self.batcher.depth()
    }

    /// Stops taking requests, answers those in the queue and joins the workers.
    pub fn shutdown(&self) {
        self.batcher.shutdown();
    }
}

/// What the graph relies on: ONNX Runtime would read past a tensor or stop the process.
fn check(request: &LinkRequest, features: Features) -> Result<(), InferError> {
    let (tracks, pairs) = (request.tracks(), request.pairs.len());
    let reason = if !request.is_empty() && request.features != features {
        format!("{} features for a network that reads {features} ones", request.features)
    } else if request.histories.len() != tracks * HISTORY * features.step() {
        format!("{} history values for {tracks} tracks", request.histories.len())
    } else if request.candidates.len() != pairs * features.candidate() {
        format!("{} candidate values for {pairs} pairs", request.candidates.len())
    } else if let Some(pair) = request.pairs.iter().find(|pair| pair.track as usize >= tracks) {
        format!("a pair of track {} among {tracks} tracks", pair.track)
    } else if let Some(length) = request.lengths.iter().find(|&&n| n < 1 || n as usize > HISTORY) {
        format!("a history of {length} observations, 1 to {HISTORY} are possible")
    } else {
        return Ok(());
    };
    Err(InferError::Request { model: MODEL, reason })
}

/// As many tracks as pairs.
fn warm_up(features: Features, count: usize) -> LinkRequest {
    LinkRequest {
        features,
        histories: vec![0.0; count * HISTORY * features.step()],
        lengths: vec![1; count],
        candidates: vec![0.0; count * features.candidate()],
        pairs: vec![crate::track::Pair { track: 0, detection: 0 }; count],
    }
}

/// One instance of the link scorer.
pub(super) struct LinkModel {
    session: Session,
    pub(super) surroundings: Surroundings,
    /// Whether tracks and pairs are filled up to powers of two: a GPU prepares itself anew for every shape.
    filled: bool,
    /// The joined request of a batch.
    joined: LinkRequest,
    pair_track: Vec<i64>,
    last: Duration,
}

impl LinkModel {
    pub(super) fn load(runtime: &Runtime, name: &str, file: &Path) -> Result<Self, InferError> {
        let wrong = |reason: String| InferError::Graph { name: name.into(), reason };
        let session = runtime.session(name, file, None)?;
        for (input, element) in INPUTS {
            let outlet = session.inputs().iter().find(|outlet| outlet.name() == input);
            let outlet = outlet.ok_or_else(|| wrong(format!("it has no input {input:?}")))?;
            check_type("input", outlet, element).map_err(wrong)?;
        }
        if session.inputs().len() != INPUTS.len() {
            return Err(wrong(format!(
                "it has {} inputs, {} are expected",
                session.inputs().len(),
                INPUTS.len()
            )));
        }
        let outlet = session.outputs().iter().find(|outlet| outlet.name() == OUTPUT);
        let outlet = outlet.ok_or_else(|| wrong(format!("it has no output {OUTPUT:?}")))?;
        check_type("output", outlet, TensorElementType::Float32).map_err(wrong)?;
        let surroundings = Surroundings::read(&session).map_err(wrong)?;
        let features = surroundings.features;
        for (input, width) in [("histories", features.step()), ("candidates", features.candidate())] {
            let outlet = session.inputs().iter().find(|outlet| outlet.name() == input);
            let found = outlet.and_then(|o| o.dtype().tensor_shape()).and_then(|shape| shape.last().copied());
            if let Some(found) = found.filter(|found| *found >= 0 && *found as usize != width) {
                let reason =
                    format!("input {input:?} is {found} wide, its features ({features}) are {width}");
                return Err(wrong(reason));
            }
        }
        Ok(Self {
            session,
            surroundings,
            filled: runtime.provider != Provider::Cpu,
            joined: LinkRequest::default(),
            pair_track: vec![],
            last: Duration::ZERO,
        })
    }

    /// Runs what will be run, so that the first request does not pay for what is made lazily.
    pub(super) fn warm_up(&mut self) -> Result<(), InferError> {
        let most = if self.filled { WARM } else { 1 };
        let mut counts = successors(Some(1), |count| (*count < most).then_some(2 * count));
        let features = self.surroundings.features;
        counts.try_for_each(|count| self.run(&[warm_up(features, count)]).map(drop))
    }

    /// What [`Linker::score`] checks.
    pub(super) fn check(&self, request: &LinkRequest) -> Result<(), InferError> {
        check(request, self.surroundings.features)
    }

    /// Runs the joined request; `None` when ONNX Runtime gives fewer or more probabilities than pairs.
    fn probabilities(&mut self) -> ort::Result<Option<Vec<f32>>> {
        let wanted = self.pair_track.len();
        let [step, candidate] = [self.surroundings.features.step(), self.surroundings.features.candidate()];
        let joined = &mut self.joined;
        if self.filled {
            let [tracks, pairs] = [joined.tracks(), wanted].map(usize::next_power_of_two);
            joined.histories.resize(tracks * HISTORY * step, 0.0);
            joined.lengths.resize(tracks, 1);
            joined.candidates.resize(pairs * candidate, 0.0);
            self.pair_track.resize(pairs, 0);
        }
        let (tracks, pairs) = (joined.lengths.len(), self.pair_track.len());
        let outputs = self.session.run(ort::inputs![
            "histories" => TensorRef::from_array_view(([tracks, HISTORY, step], &joined.histories[..]))?,
            "lengths" => TensorRef::from_array_view(([tracks], &joined.lengths[..]))?,
            "candidates" => TensorRef::from_array_view(([pairs, candidate], &joined.candidates[..]))?,
            "pair_track" => TensorRef::from_array_view(([pairs], &self.pair_track[..]))?,
        ])?;
        let (_, values) = outputs[OUTPUT].try_extract_tensor::<f32>()?;
        Ok((values.len() == pairs).then(|| values[..wanted].to_vec()))
    }
}

impl BatchModel for LinkModel {
    type Job = LinkRequest;
    type Answer = Vec<f32>;

    fn run(&mut self, jobs: &[LinkRequest]) -> Result<Vec<Vec<f32>>, InferError> {
        self.joined.clear();
        self.pair_track.clear();
        for job in jobs {
            let before = self.joined.tracks() as i64;
            self.joined.histories.extend(&job.histories);
            self.joined.lengths.extend(&job.lengths);
            self.joined.candidates.extend(&job.candidates);
            self.pair_track.extend(job.pairs.iter().map(|pair| before + i64::from(pair.track)));
        }
        let failed = |reason: String| InferError::Run { model: MODEL, reason };
        if self.pair_track.is_empty() {
            // ONNX Runtime's GRU stops the whole process on an empty batch.
            return Ok(vec![vec![]; jobs.len()]);
        }
        let start = Instant::now();
        let all = self.probabilities().map_err(|error| failed(error.to_string()))?;
        self.last = start.elapsed();
        let all = all.ok_or_else(|| failed("not one probability a pair".into()))?;
        if let Some(odd) = all.iter().find(|p| !(0.0..=1.0).contains(*p)) {
            return Err(failed(format!("{odd} is no probability")));
        }
        let mut rest = &all[..];
        Ok(jobs
            .iter()
            .map(|job| {
                let (own, others) = rest.split_at(job.pairs.len());
                rest = others;
                own.to_vec()
            })
            .collect())
    }

    fn items(job: &LinkRequest) -> usize {
        job.pairs.len()
    }

    fn session_time(&self) -> Duration {
        self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::testing::{fixture, runtime};
    use crate::track::Pair;

    /// A request of `tracks` histories and a pair of each `(track)` of `pairs`.
    fn request(seed: usize, tracks: usize, pairs: &[u32]) -> LinkRequest {
        let pattern = |n: usize| (0..n).map(|i| ((i + seed) % 11) as f32 / 10.0 - 0.5).collect();
        let features = Features::Relative;
        LinkRequest {
            features,
            histories: pattern(tracks * HISTORY * features.step()),
            lengths: (0..tracks).map(|track| ((track + seed) % HISTORY + 1) as i32).collect(),
            candidates: pattern(pairs.len() * features.candidate()),
            pairs: pairs.iter().map(|&track| Pair { track, detection: 0 }).collect(),
        }
    }

    #[test]
    fn requests_of_many_cameras_are_one_call() {
        let Some(runtime) = runtime() else { return };
        let mut model = LinkModel::load(&runtime, "link", &fixture("link.onnx")).expect("the graph");
        // One has histories and no pairs, one has neither.
        let requests = [
            request(0, 3, &[2, 0, 0, 1]),
            request(1, 2, &[]),
            request(2, 1, &[0]),
            LinkRequest::default(),
            request(5, 4, &[3, 1]),
        ];
        let together = model.run(&requests).expect("probabilities");
        for (request, together) in requests.iter().zip(&together) {
            let alone = &model.run(std::slice::from_ref(request)).expect("probabilities")[0];
            assert_eq!(alone.len(), request.pairs.len());
            assert_eq!(together.len(), alone.len());
            for (a, b) in alone.iter().zip(together) {
                assert!((a - b).abs() < 1e-6, "{alone:?} alone, {together:?} together");
            }
        }
        assert!((together[0][0] - together[0][1]).abs() > 1e-4, "the tracks differ: {together:?}");
        // As for a GPU, whose tensors have a few shapes only.
        model.filled = true;
        model.warm_up().expect("every size");
        let filled = model.run(&requests).expect("probabilities");
        for (a, b) in together.iter().flatten().zip(filled.iter().flatten()) {
            assert!((a - b).abs() < 1e-6, "{together:?}, filled up {filled:?}");
        }
        assert_eq!(filled.iter().map(Vec::len).collect::<Vec<_>>(), [4, 0, 1, 0, 2]);
        assert_eq!(model.run(&[LinkRequest::default()]).expect("nothing"), [vec![0f32; 0]]);
    }
}
