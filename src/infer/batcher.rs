//! One batcher for every model: requests of all cameras go into one bounded queue, and worker threads
//! take them out in batches.
//!
//! The queue `<name>` holds [`Arrangement::capacity`] requests; when it is full the submitter waits
//! ([`Batcher::submit`]) or is told so ([`Batcher::try_submit`]). Requests start in the order in which
//! they were submitted, whoever sent them.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use futures::channel::oneshot;

use super::InferError;

/// A model that answers several requests at once. Each worker thread owns one.
pub trait BatchModel: Send + 'static {
    /// A request.
    type Job: Send + 'static;
    /// What it is answered with.
    type Answer: Send + 'static;

    /// Answers `jobs`, as many answers in the same order. `jobs` is never empty.
    ///
    /// After an error or a panic the same instance is used again, so nothing may be carried over from
    /// one call to the next but buffers. When a batch of several fails, each of its jobs is run alone,
    /// so that one bad request does not spoil its neighbours.
    fn run(&mut self, jobs: &[Self::Job]) -> Result<Vec<Self::Answer>, InferError>;

    /// How much of a batch a request fills: [`Arrangement::max_batch`] bounds the sum.
    fn items(_job: &Self::Job) -> usize {
        1
    }

    /// The part of the last [`BatchModel::run`] that passed inside the model itself, without preparation.
    fn session_time(&self) -> Duration {
        Duration::ZERO
    }
}

/// How a model is run: it belongs to the execution provider, not to the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrangement {
    /// Worker threads, each with its own instance of the model.
    pub workers: usize,
    /// Items that a batch holds at most (a request with more makes a batch of its own).
    pub max_batch: usize,
    /// How long the first request of a batch waits for more.
    pub max_wait: Duration,
    /// Requests that the queue holds.
    pub capacity: usize,
}

/// What a worker says about one batch.
#[derive(Clone, Copy, Debug)]
pub struct BatchStats<'a> {
    /// The batcher's name: `detect`, `reid` or `link`.
    pub model: &'static str,
    /// How long each request waited in the queue.
    pub waits: &'a [Duration],
    /// The sum of [`BatchModel::items`]: frames, crops or pairs.
    pub items: usize,
    /// How long the batch ran, preparation and decoding included.
    pub run: Duration,
    /// The part of `run` inside the model itself.
    pub session: Duration,
    /// Whether it failed.
    pub failed: bool,
}

impl BatchStats<'_> {
    /// Requests in the batch.
    pub fn jobs(&self) -> usize {
        self.waits.len()
    }
}

/// Is told what the workers do; called on their threads, so it must be quick.
pub trait Observer: Send + Sync + 'static {
    /// A batch has run.
    fn batch(&self, stats: &BatchStats<'_>);

    /// A request was skipped because nobody waits for its answer any more.
    fn abandoned(&self, _model: &'static str) {}
}

/// Nobody listens.
impl Observer for () {
    fn batch(&self, _stats: &BatchStats<'_>) {}
}

struct Envelope<M: BatchModel> {
    job: M::Job,
    reply: oneshot::Sender<Result<M::Answer, InferError>>,
    queued: Instant,
}

/// The queue and the threads behind it.
pub struct Batcher<M: BatchModel> {
    name: &'static str,
    arrangement: Arrangement,
    /// `None` once the batcher is shut down.
    queue: Mutex<Option<flume::Sender<Envelope<M>>>>,
    workers: Mutex<Vec<JoinHandle<()>>>,
}

impl<M: BatchModel> Batcher<M> {
    /// Starts the workers `<name>-0`, `<name>-1`, … Each builds its own instance by `build` on its own
    /// thread (all at the same time); this returns when all are ready.
    ///
    /// # Errors
    /// The first instance's error; then no thread is left behind.
    ///
    /// # Panics
    /// When the arrangement has a zero, or the system has no thread left.
    pub fn start(
        name: &'static str,
        arrangement: Arrangement,
        observer: Arc<dyn Observer>,
        build: impl Fn(usize) -> Result<M, InferError> + Send + Sync + 'static,
    ) -> Result<Self, InferError> {
        let Arrangement { workers, max_batch, capacity, .. } = arrangement;
        assert!(workers > 0 && max_batch > 0 && capacity > 0, "{name}: {arrangement:?}");
        let (sender, receiver) = flume::bounded(capacity);
        let (ready, built) = flume::bounded(workers);
        let build = Arc::new(build);
        let turn = Arc::new(Mutex::new(()));
        let handles = (0..workers)
            .map(|index| {
                let (build, ready, turn) = (build.clone(), ready.clone(), turn.clone());
                let (receiver, observer) = (receiver.clone(), observer.clone());
                thread::Builder::new()
                    .name(format!("{name}-{index}"))
                    .spawn(move || {
                        let built = catch_unwind(AssertUnwindSafe(|| build(index))).unwrap_or_else(|panic| {
                            Err(InferError::Run { model: name, reason: panic_text(&*panic) })
                        });
                        let model = match built {
                            Ok(model) => model,
                            Err(error) => return drop(ready.send(Err(error))),
                        };
                        let _ = ready.send(Ok(()));
                        drop((ready, build));
                        Worker { name, arrangement, receiver, observer, turn, model }.work();
                    })
                    .expect("a thread for a model")
            })
            .collect();
        drop((ready, receiver));
        let batcher =
            Self { name, arrangement, queue: Mutex::new(Some(sender)), workers: Mutex::new(handles) };
        for _ in 0..workers {
            built.recv().unwrap_or(Err(InferError::Stopped { model: name }))?;
        }
        Ok(batcher)
    }

    /// Submits a request and waits for its answer; waits for a place in the queue first if it is full.
    /// Dropping the future withdraws the request.
    ///
    /// # Errors
    /// The model's error, or [`InferError::Stopped`].
    pub async fn submit(&self, job: M::Job) -> Result<M::Answer, InferError> {
        let queue = self.queue()?;
        let (envelope, answer) = Self::envelope(job);
        queue.send_async(envelope).await.map_err(|_| self.stopped())?;
        drop(queue);
        answer.await.unwrap_or_else(|_| Err(self.stopped()))
    }

    /// Submits a request if the queue has a place now; the future is its answer.
    ///
    /// # Errors
    /// [`InferError::Full`] or [`InferError::Stopped`].
    pub fn try_submit(
        &self,
        job: M::Job,
    ) -> Result<impl Future<Output = Result<M::Answer, InferError>> + Send + use<M>, InferError> {
        let (envelope, answer) = Self::envelope(job);
        self.queue()?.try_send(envelope).map_err(|error| match error {
            flume::TrySendError::Full(_) => {
                InferError::Full { model: self.name, capacity: self.arrangement.capacity }
            }
            flume::TrySendError::Disconnected(_) => self.stopped(),
        })?;
        let stopped = self.stopped();
        Ok(async move { answer.await.unwrap_or(Err(stopped)) })
    }

    /// Requests in the queue now.
    pub fn depth(&self) -> usize {
        self.queue().map_or(0, |queue| queue.len())
    }

    /// How it runs.
    pub fn arrangement(&self) -> Arrangement {
        self.arrangement
    }

    /// Takes no more requests, answers those in the queue, and joins the workers.
    pub fn shutdown(&self) {
        drop(self.queue.lock().unwrap_or_else(PoisonError::into_inner).take());
        let workers = std::mem::take(&mut *self.workers.lock().unwrap_or_else(PoisonError::into_inner));
        for worker in workers {
            // A worker that drops the last handle cannot wait for itself.
            if worker.thread().id() != thread::current().id() {
                let _ = worker.join();
            }
        }
    }

    fn envelope(job: M::Job) -> (Envelope<M>, oneshot::Receiver<Result<M::Answer, InferError>>) {
        let (reply, answer) = oneshot::channel();
        (Envelope { job, reply, queued: Instant::now() }, answer)
    }

    fn queue(&self) -> Result<flume::Sender<Envelope<M>>, InferError> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner).clone().ok_or_else(|| self.stopped())
    }

    fn stopped(&self) -> InferError {
        InferError::Stopped { model: self.name }
    }
}

impl<M: BatchModel> Drop for Batcher<M> {
    fn drop(&mut self) {
        self.shutdown();
    }
}

struct Worker<M: BatchModel> {
    name: &'static str,
    arrangement: Arrangement,
    receiver: flume::Receiver<Envelope<M>>,
    observer: Arc<dyn Observer>,
    /// Held while a batch is collected, so that two workers do not share out one batch's requests.
    turn: Arc<Mutex<()>>,
    model: M,
}

/// A batch being collected; the vectors are reused.
struct Batch<M: BatchModel> {
    jobs: Vec<M::Job>,
    replies: Vec<oneshot::Sender<Result<M::Answer, InferError>>>,
    waits: Vec<Duration>,
    items: usize,
}

impl<M: BatchModel> Worker<M> {
    fn work(mut self) {
        let mut batch = Batch { jobs: vec![], replies: vec![], waits: vec![], items: 0 };
        // A request that would make the batch too large begins the next one.
        let mut carried = None;
        while self.collect(&mut batch, &mut carried) {
            let start = Instant::now();
            let answers = self.answer(&batch.jobs);
            let run = start.elapsed();
            self.observer.batch(&BatchStats {
                model: self.name,
                waits: &batch.waits,
                items: batch.items,
                run,
                session: self.model.session_time(),
                failed: answers.iter().any(Result::is_err),
            });
            batch.jobs.clear();
            batch.waits.clear();
            batch.items = 0;
            for (reply, answer) in batch.replies.drain(..).zip(answers) {
                // Whoever asked may be gone.
                let _ = reply.send(answer);
            }
        }
    }

    /// Fills an empty batch; false when the queue is closed and empty.
    fn collect(&self, batch: &mut Batch<M>, carried: &mut Option<Envelope<M>>) -> bool {
        let Arrangement { max_batch, max_wait, .. } = self.arrangement;
        let alone = max_batch == 1;
        let _turn = (!alone).then(|| self.turn.lock().unwrap_or_else(PoisonError::into_inner));
        let mut deadline = None;
        while batch.items < max_batch {
            let next = match (carried.take(), deadline) {
                (Some(envelope), _) => Ok(envelope),
                (None, None) => self.receiver.recv().map_err(drop),
                (None, Some(deadline)) => self.receiver.recv_deadline(deadline).map_err(drop),
            };
            let Ok(envelope) = next else { break };
            if envelope.reply.is_canceled() {
                self.observer.abandoned(self.name);
                continue;
            }
            let items = M::items(&envelope.job);
            if batch.items > 0 && batch.items + items > max_batch {
                *carried = Some(envelope);
                break;
            }
            batch.jobs.push(envelope.job);
            batch.replies.push(envelope.reply);
            batch.waits.push(envelope.queued.elapsed());
            batch.items += items;
            deadline.get_or_insert_with(|| Instant::now() + max_wait);
        }
        !batch.jobs.is_empty()
    }

    fn answer(&mut self, jobs: &[M::Job]) -> Vec<Result<M::Answer, InferError>> {
        match self.run(jobs) {
            Ok(answers) => answers.into_iter().map(Ok).collect(),
            Err(error) if jobs.len() == 1 => vec![Err(error)],
            Err(_) => jobs.chunks(1).map(|job| self.run(job).map(|mut answers| answers.remove(0))).collect(),
        }
    }

    fn run(&mut self, jobs: &[M::Job]) -> Result<Vec<M::Answer>, InferError> {
        let failed = |reason| InferError::Run { model: self.name, reason };
        let answers = catch_unwind(AssertUnwindSafe(|| self.model.run(jobs)))
            .unwrap_or_else(|panic| Err(failed(panic_text(&*panic))))?;
        if answers.len() != jobs.len() {
            return Err(failed(format!("{} answers to {} requests", answers.len(), jobs.len())));
        }
        Ok(answers)
    }
}

fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied().or(panic.downcast_ref::<String>().map(String::as_str));
    format!("panicked: {}", text.unwrap_or("(no message)"))
}
