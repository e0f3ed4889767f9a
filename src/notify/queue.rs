//! Events that wait to be delivered: bounded, in order, the oldest dropped when full.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use crate::publish::NumberedEvent;

/// An event and since when it waits.
#[derive(Clone, Debug)]
pub(super) struct Waiting {
    pub event: Arc<NumberedEvent>,
    pub since: Instant,
}

/// The queue between what collects events and what delivers them.
#[derive(Debug)]
pub(super) struct Queue {
    inner: Mutex<Inner>,
    ready: Notify,
}

#[derive(Debug)]
struct Inner {
    /// How many may wait besides the one being delivered.
    bound: usize,
    waiting: VecDeque<Waiting>,
    /// Being delivered.
    current: Option<Waiting>,
    /// Nothing more comes.
    closed: bool,
}

impl Queue {
    pub fn new(bound: usize) -> Self {
        let inner = Inner { bound, waiting: VecDeque::new(), current: None, closed: false };
        Self { inner: Mutex::new(inner), ready: Notify::new() }
    }

    /// Adds an event; whether the oldest had to go for it.
    pub fn push(&self, event: Arc<NumberedEvent>) -> bool {
        let mut inner = self.lock();
        let full = inner.waiting.len() >= inner.bound;
        let dropped = if full { inner.waiting.pop_front() } else { None };
        inner.waiting.push_back(Waiting { event, since: Instant::now() });
        drop(inner);
        self.ready.notify_one();
        dropped.is_some()
    }

    /// Another bound from now on; how many of the oldest had to go for it.
    pub fn resize(&self, bound: usize) -> u64 {
        let mut inner = self.lock();
        inner.bound = bound;
        let over = inner.waiting.len().saturating_sub(bound);
        inner.waiting.drain(..over);
        over as u64
    }

    /// The next event to deliver, which is [`Queue::done`] later; `None` when it is closed and empty.
    pub async fn next(&self) -> Option<Waiting> {
        loop {
            {
                let mut inner = self.lock();
                if inner.current.is_none() {
                    inner.current = inner.waiting.pop_front();
                }
                if inner.current.is_some() || inner.closed {
                    return inner.current.clone();
                }
            }
            self.ready.notified().await;
        }
    }

    /// The event that was being delivered is settled.
    pub fn done(&self) {
        self.lock().current = None;
    }

    /// Gives up those that have waited for so long, the one being delivered too; how many.
    pub fn expire(&self, after: Duration) -> u64 {
        let mut inner = self.lock();
        let before = inner.count();
        inner.current.take_if(|waiting| waiting.since.elapsed() >= after);
        let old = inner.waiting.iter().take_while(|waiting| waiting.since.elapsed() >= after).count();
        inner.waiting.drain(..old);
        (before - inner.count()) as u64
    }

    /// Nothing more comes.
    pub fn close(&self) {
        self.lock().closed = true;
        self.ready.notify_one();
    }

    /// Resolves once nothing more comes. For whoever takes events out.
    pub async fn closed(&self) {
        while !self.lock().closed {
            self.ready.notified().await;
        }
    }

    /// Takes all that is left; how many.
    pub fn clear(&self) -> u64 {
        let mut inner = self.lock();
        let left = inner.count() as u64;
        inner.current = None;
        inner.waiting.clear();
        left
    }

    /// How many wait, the one being delivered among them.
    pub fn len(&self) -> usize {
        self.lock().count()
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    fn count(&self) -> usize {
        self.waiting.len() + usize::from(self.current.is_some())
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::analytics::{Direction, Happening, Point, RuleId, What};
    use crate::types::{CameraId, Epoch};

    /// A crossing of camera `gate`.
    pub(crate) fn event(n: u32) -> NumberedEvent {
        let what = What::Crossed { line: RuleId::new("door").unwrap(), direction: Direction::In };
        NumberedEvent {
            id: n.to_string(),
            kind: "line.crossed",
            camera: CameraId::new("gate").unwrap(),
            epoch: Epoch(1),
            unix_ns: 0,
            happening: Happening { track: None, place: Point { x: 0.5, y: 0.5 }, what },
            json: "{}".into(),
        }
    }

    #[tokio::test]
    async fn the_oldest_goes_when_it_is_full_but_not_the_one_under_way() {
        let queue = Queue::new(2);
        assert!(!queue.push(event(1).into()));
        assert_eq!(queue.next().await.unwrap().event.id, "1");
        assert!(!queue.push(event(2).into()) && !queue.push(event(3).into()) && queue.push(event(4).into()));
        assert_eq!((queue.next().await.unwrap().event.id.as_str(), queue.len()), ("1", 3));
        assert_eq!((queue.resize(1), queue.len()), (1, 2));
        assert_eq!(queue.resize(2), 0);
        assert!(!queue.push(event(5).into()));
        queue.done();
        queue.close();
        for id in ["4", "5"] {
            assert_eq!(queue.next().await.unwrap().event.id, id);
            queue.done();
        }
        assert!(queue.next().await.is_none());
    }

    #[tokio::test]
    async fn what_has_waited_too_long_goes() {
        let queue = Queue::new(5);
        for n in 1..=3 {
            queue.push(event(n).into());
        }
        queue.next().await.unwrap();
        assert_eq!((queue.expire(Duration::from_secs(60)), queue.len()), (0, 3));
        assert_eq!((queue.expire(Duration::ZERO), queue.len()), (3, 0));
    }
}
