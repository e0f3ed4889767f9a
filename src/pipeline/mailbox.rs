//! A camera's mailbox between its source's thread and the detect stage.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use prometheus::IntGauge;
use tokio::sync::Notify;

/// What a full mailbox does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Policy {
    /// Gives its oldest entry back to the sender: a live camera does not wait.
    NewestWins,
    /// Makes the sender's thread wait, until no more than a quarter is left: a file loses nothing, and is
    /// decoded in bursts rather than a frame at a time, which costs fewer changes of threads (3 percent
    /// of the frames/s of an offline run on two cores).
    Wait,
}

/// A bounded queue from one thread to one task.
pub struct Mailbox<T> {
    state: Mutex<State<T>>,
    readable: Notify,
    writable: Condvar,
    capacity: usize,
    policy: Policy,
    depth: IntGauge,
}

struct State<T> {
    entries: VecDeque<T>,
    closed: bool,
}

impl<T> Mailbox<T> {
    /// An empty mailbox of `capacity` (at least 1) entries; `depth` shows how many wait.
    pub fn new(capacity: usize, policy: Policy, depth: IntGauge) -> Self {
        let state = State { entries: VecDeque::with_capacity(capacity), closed: false };
        Self {
            state: Mutex::new(state),
            readable: Notify::new(),
            writable: Condvar::new(),
            capacity: capacity.max(1),
            policy,
            depth,
        }
    }

    /// Puts an entry in. `Ok(Some(old))` gives back what had to make room; `Err(entry)` that the
    /// mailbox is closed. Waits for room only under [`Policy::Wait`].
    pub fn put(&self, entry: T) -> Result<Option<T>, T> {
        let mut state = self.lock();
        let mut displaced = None;
        while state.entries.len() >= self.capacity && !state.closed {
            match self.policy {
                Policy::NewestWins => {
                    displaced = state.entries.pop_front();
                    self.depth.dec();
                }
                Policy::Wait => {
                    let full = |state: &mut State<T>| !self.has_drained(state) && !state.closed;
                    let waited = self.writable.wait_while(state, full);
                    state = waited.unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
        if state.closed {
            return Err(entry);
        }
        state.entries.push_back(entry);
        self.depth.inc();
        drop(state);
        self.readable.notify_one();
        Ok(displaced)
    }

    /// Waits for an entry; `false` once the mailbox is closed and empty. The only reader finds it there, or a newer one.
    pub async fn ready(&self) -> bool {
        loop {
            {
                let state = self.lock();
                if !state.entries.is_empty() || state.closed {
                    return !state.entries.is_empty();
                }
            }
            self.readable.notified().await;
        }
    }

    /// The oldest entry; waits for one. `None` once the mailbox is closed and empty.
    pub async fn take(&self) -> Option<T> {
        loop {
            {
                let mut state = self.lock();
                if let Some(entry) = state.entries.pop_front() {
                    self.depth.dec();
                    if self.has_drained(&state) {
                        self.writable.notify_one();
                    }
                    return Some(entry);
                }
                if state.closed {
                    return None;
                }
            }
            // A put between the look and the wait leaves its permit: notify_one stores one.
            self.readable.notified().await;
        }
    }

    /// Takes no more entries; those inside can still be taken.
    pub fn close(&self) {
        self.lock().closed = true;
        self.readable.notify_one();
        self.writable.notify_all();
    }

    /// Whether a sender that found it full may go on.
    fn has_drained(&self, state: &State<T>) -> bool {
        state.entries.len() <= self.capacity / 4
    }

    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T> Drop for Mailbox<T> {
    fn drop(&mut self) {
        self.depth.sub(self.lock().entries.len() as i64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    fn gauge() -> IntGauge {
        IntGauge::new("depth", "depth").unwrap()
    }

    #[tokio::test]
    async fn the_newest_wins() {
        let depth = gauge();
        let mailbox = Mailbox::new(1, Policy::NewestWins, depth.clone());
        assert_eq!(mailbox.put(1), Ok(None));
        assert_eq!(mailbox.put(2), Ok(Some(1)));
        assert_eq!(depth.get(), 1);
        assert_eq!(mailbox.take().await, Some(2));
        mailbox.put(3).unwrap();
        mailbox.close();
        assert_eq!(mailbox.put(4), Err(4));
        assert_eq!(mailbox.take().await, Some(3));
        assert_eq!(mailbox.take().await, None);
        assert_eq!(depth.get(), 0);
    }

    #[tokio::test]
    async fn a_waiting_sender_loses_nothing() {
        for capacity in [1, 2, 8] {
            let mailbox = Arc::new(Mailbox::new(capacity, Policy::Wait, gauge()));
            let sender = {
                let mailbox = mailbox.clone();
                std::thread::Builder::new().name("sender".into()).spawn(move || {
                    for i in 0..1000 {
                        assert_eq!(mailbox.put(i), Ok(None));
                    }
                    mailbox.close();
                })
            };
            let mut seen = Vec::new();
            while let Some(i) = mailbox.take().await {
                seen.push(i);
            }
            sender.unwrap().join().unwrap();
            assert_eq!(seen, (0..1000).collect::<Vec<_>>());
        }
    }

    #[test]
    fn closing_frees_a_waiting_sender() {
        let mailbox = Arc::new(Mailbox::new(1, Policy::Wait, gauge()));
        mailbox.put(1).unwrap();
        let sender = {
            let mailbox = mailbox.clone();
            std::thread::Builder::new().name("sender".into()).spawn(move || mailbox.put(2)).unwrap()
        };
        mailbox.close();
        assert_eq!(sender.join().unwrap(), Err(2));
    }
}
