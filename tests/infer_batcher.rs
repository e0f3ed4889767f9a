//! The laws of the batcher: order, bounds, isolation of errors, batch sizes, withdrawal, shutdown.
#![cfg(feature = "infer")]

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::FutureExt;
use futures::executor::block_on;
use gakp::infer::{Arrangement, BatchModel, BatchStats, Batcher, InferError, Observer};

/// Doubles numbers. Every batch needs a permit, so a test decides when it runs.
struct Doubler {
    permits: Arc<Mutex<Receiver<()>>>,
    log: Arc<Log>,
}

#[derive(Default)]
struct Log {
    batches: Mutex<Vec<Vec<i64>>>,
    threads: Mutex<Vec<String>>,
    stats: Mutex<Vec<(usize, usize, bool)>>,
    abandoned: Mutex<usize>,
    alive: Mutex<isize>,
    /// Batches that have begun, with or without a permit.
    begun: Mutex<usize>,
}

impl Observer for Log {
    fn batch(&self, stats: &BatchStats<'_>) {
        assert_eq!(stats.model, "double");
        assert!(stats.run >= stats.session);
        self.stats.lock().unwrap().push((stats.jobs(), stats.items, stats.failed));
    }

    fn abandoned(&self, model: &'static str) {
        assert_eq!(model, "double");
        *self.abandoned.lock().unwrap() += 1;
    }
}

const BAD: i64 = -1;
const PANIC: i64 = -2;

impl BatchModel for Doubler {
    type Job = i64;
    type Answer = i64;

    fn run(&mut self, jobs: &[i64]) -> Result<Vec<i64>, InferError> {
        *self.log.begun.lock().unwrap() += 1;
        self.permits.lock().unwrap().recv().expect("the test is alive");
        self.log.batches.lock().unwrap().push(jobs.to_vec());
        let name = std::thread::current().name().unwrap_or_default().to_owned();
        self.log.threads.lock().unwrap().push(name);
        assert!(!jobs.contains(&PANIC), "a bad day");
        if jobs.contains(&BAD) {
            return Err(InferError::Run { model: "double", reason: "a bad number".into() });
        }
        Ok(jobs.iter().map(|n| 2 * n).collect())
    }

    /// Numbers from 100 on weigh their hundreds.
    fn items(job: &i64) -> usize {
        (*job / 100).max(1) as usize
    }
}

impl Drop for Doubler {
    fn drop(&mut self) {
        *self.log.alive.lock().unwrap() -= 1;
    }
}

struct World {
    batcher: Batcher<Doubler>,
    permits: Sender<()>,
    log: Arc<Log>,
}

fn world(workers: usize, max_batch: usize, max_wait: Duration, capacity: usize) -> World {
    let (permits, receiver) = channel();
    let receiver = Arc::new(Mutex::new(receiver));
    let log = Arc::new(Log::default());
    let arrangement = Arrangement { workers, max_batch, max_wait, capacity };
    let batcher = Batcher::start("double", arrangement, log.clone(), {
        let log = log.clone();
        move |_| {
            *log.alive.lock().unwrap() += 1;
            Ok(Doubler { permits: receiver.clone(), log: log.clone() })
        }
    })
    .expect("workers");
    World { batcher, permits, log }
}

impl World {
    fn permit(&self, batches: usize) {
        (0..batches).for_each(|_| self.permits.send(()).unwrap());
    }

    /// Submits `first`, and returns once a worker has begun a batch with it.
    fn occupy(&self, first: i64) -> impl Future<Output = Result<i64, InferError>> + use<> {
        let begun = *self.log.begun.lock().unwrap();
        let answer = self.batcher.try_submit(first).expect("an empty queue");
        while *self.log.begun.lock().unwrap() == begun {
            std::thread::yield_now();
        }
        answer
    }

    fn batches(&self) -> Vec<Vec<i64>> {
        self.log.batches.lock().unwrap().clone()
    }
}

const NO_WAIT: Duration = Duration::ZERO;

#[test]
fn batches_keep_the_order_and_the_bound() {
    let world = world(1, 3, NO_WAIT, 16);
    let mut answers = vec![world.occupy(0).boxed()];
    answers.extend((1..=7).map(|n| world.batcher.try_submit(n).expect("a place").boxed()));
    world.permit(4);
    let answers: Vec<i64> = answers.into_iter().map(|a| block_on(a).expect("an answer")).collect();
    assert_eq!(answers, [0, 2, 4, 6, 8, 10, 12, 14]);
    assert_eq!(world.batches(), [vec![0], vec![1, 2, 3], vec![4, 5, 6], vec![7]]);
    assert_eq!(world.log.threads.lock().unwrap()[0], "double-0");
    world.batcher.shutdown();
    assert_eq!(
        *world.log.stats.lock().unwrap(),
        [(1, 1, false), (3, 3, false), (3, 3, false), (1, 1, false)]
    );
}

#[test]
fn heavy_requests_fill_a_batch_alone() {
    let world = world(1, 10, NO_WAIT, 16);
    let mut answers = vec![world.occupy(0).boxed()];
    for n in [600, 600, 400, 2500, 1] {
        answers.push(world.batcher.try_submit(n).expect("a place").boxed());
    }
    world.permit(5);
    answers.into_iter().for_each(|a| assert!(block_on(a).is_ok()));
    assert_eq!(world.batches(), [vec![0], vec![600], vec![600, 400], vec![2500], vec![1]]);
}

#[test]
fn the_first_request_waits_for_more_only_as_long_as_it_may() {
    // With all the time in the world a batch is complete when it is full…
    let patient = world(1, 2, Duration::from_secs(3600), 16);
    patient.permit(1);
    let one = patient.batcher.try_submit(1).expect("a place");
    let two = patient.batcher.try_submit(2).expect("a place");
    assert_eq!((block_on(one).unwrap(), block_on(two).unwrap()), (2, 4));
    assert_eq!(patient.batches(), [vec![1, 2]]);
    // …and a batch that nobody joins runs when the time is up.
    let brief = world(1, 2, Duration::from_millis(5), 16);
    brief.permit(1);
    assert_eq!(block_on(brief.batcher.submit(3)).unwrap(), 6);
}

#[test]
fn a_full_queue_refuses_or_makes_wait() {
    let world = world(1, 1, NO_WAIT, 2);
    let first = world.occupy(1);
    let queued: Vec<_> = [2, 3].map(|n| world.batcher.try_submit(n).expect("a place")).into();
    let refused = world.batcher.try_submit(4).err();
    assert!(matches!(refused, Some(InferError::Full { model: "double", capacity: 2 })), "{refused:?}");
    let mut waiting = Box::pin(world.batcher.submit(5));
    assert!((&mut waiting).now_or_never().is_none());
    assert_eq!(world.batcher.depth(), 2);
    world.permit(4);
    assert_eq!(block_on(waiting).unwrap(), 10);
    assert_eq!(block_on(first).unwrap(), 2);
    for (answer, expected) in queued.into_iter().zip([4, 6]) {
        assert_eq!(block_on(answer).unwrap(), expected);
    }
    assert_eq!(world.batches(), [[1], [2], [3], [5]]);
}

#[test]
fn one_bad_request_spoils_nobody_else() {
    for bad in [BAD, PANIC] {
        let world = world(1, 3, NO_WAIT, 16);
        let first = world.occupy(0);
        let answers = [1, bad, 3, 4].map(|n| world.batcher.try_submit(n).expect("a place"));
        // The first; the batch of three, then each of them alone; the last.
        world.permit(6);
        assert_eq!(block_on(first).unwrap(), 0);
        let [one, bad_answer, three, four] = answers.map(block_on);
        assert_eq!((one.unwrap(), three.unwrap(), four.unwrap()), (2, 6, 8));
        let error = bad_answer.expect_err("the bad one").to_string();
        let reason = if bad == PANIC { "panicked: a bad day" } else { "a bad number" };
        assert!(error.contains(reason), "{error}");
        world.batcher.shutdown();
        let failed: Vec<bool> = world.log.stats.lock().unwrap().iter().map(|s| s.2).collect();
        assert_eq!(failed, [false, true, false]);
    }
}

#[test]
fn a_withdrawn_request_is_not_run() {
    let world = world(1, 2, NO_WAIT, 16);
    let first = world.occupy(1);
    drop(world.batcher.try_submit(2).expect("a place"));
    let third = world.batcher.try_submit(3).expect("a place");
    let fourth = world.batcher.try_submit(4).expect("a place");
    world.permit(2);
    block_on(first).unwrap();
    assert_eq!((block_on(third).unwrap(), block_on(fourth).unwrap()), (6, 8));
    assert_eq!(world.batches(), [vec![1], vec![3, 4]]);
    assert_eq!(*world.log.abandoned.lock().unwrap(), 1);
}

#[test]
fn workers_run_at_the_same_time() {
    let world = world(3, 1, NO_WAIT, 16);
    // None of the three can end before all have begun: no permit is given until then.
    let answers = [1, 2, 3].map(|n| world.occupy(n));
    world.permit(3);
    assert_eq!(answers.map(|a| block_on(a).unwrap()), [2, 4, 6]);
    let mut threads = world.log.threads.lock().unwrap().clone();
    threads.sort();
    assert_eq!(threads, ["double-0", "double-1", "double-2"]);
}

#[test]
fn shutdown_answers_what_is_queued_and_leaves_no_thread() {
    let world = world(2, 1, NO_WAIT, 16);
    let answers: Vec<_> = (0..6).map(|n| world.batcher.try_submit(n).expect("a place")).collect();
    world.permit(6);
    world.batcher.shutdown();
    assert_eq!(*world.log.alive.lock().unwrap(), 0);
    for (n, answer) in answers.into_iter().enumerate() {
        assert_eq!(block_on(answer).unwrap(), 2 * n as i64);
    }
    let late = block_on(world.batcher.submit(9));
    assert!(matches!(late, Err(InferError::Stopped { model: "double" })), "{late:?}");
    world.batcher.shutdown();
}

#[test]
fn a_model_that_cannot_be_built_is_an_error() {
    let arrangement = Arrangement { workers: 3, max_batch: 1, max_wait: NO_WAIT, capacity: 1 };
    for panics in [false, true] {
        let built = Batcher::<Doubler>::start("double", arrangement, Arc::new(()), move |index| {
            assert!(!(panics && index == 1), "no such model");
            Err(InferError::Run { model: "double", reason: "no such model".into() })
        });
        let error = built.err().expect("an error").to_string();
        assert!(error.contains("no such model"), "{error}");
    }
}
