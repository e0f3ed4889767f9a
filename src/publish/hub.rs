//! The hub: one publisher side that waits for nobody, a bounded ring for each subscriber.
//!
//! ```text
//! tracker --publish--> [ring of A] --next--> A
//!                      [ring of B] --next--> B     (B is slow: its oldest reports go, a gap stays)
//! ```
//!
//! Policy of a ring: at most [`HubConfig::capacity`] reports; when full the oldest is dropped, counted
//! (`gakp_hub_reports_dropped_total`) and remembered as part of a [`Gap`]. Dropped reports are older
//! than all that remain, so handing out the pending gaps before the next report announces every hole
//! in its place. Locks guard a push or a pop, never an encoding, an await or a caller's code.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use prometheus::{IntCounter, IntGauge, Registry};
use tokio::sync::Notify;

use super::Report;
use crate::types::{CameraId, Epoch, FrameTracks};

/// Reports that a subscriber did not get because it was slow: `first..=last` of one camera and epoch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// Whose reports.
    pub camera: CameraId,
    /// Of which epoch.
    pub epoch: Epoch,
    /// `seq` of the first report that is missing.
    pub first: u64,
    /// `seq` of the last report that is missing.
    pub last: u64,
}

/// What a subscriber receives.
#[derive(Clone, Debug)]
pub enum Event {
    /// The next report.
    Tracks(Arc<Report>),
    /// A hole in one camera's reports, before the next report of that camera.
    Gap(Gap),
}

/// Which cameras a subscriber wants.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Only {
    /// All, present and future.
    #[default]
    All,
    /// These, whether they exist yet or not.
    Cameras(BTreeSet<CameraId>),
}

impl Only {
    fn wants(&self, camera: &CameraId) -> bool {
        match self {
            Only::All => true,
            Only::Cameras(set) => set.contains(camera),
        }
    }
}

/// Bounds of the hub.
#[derive(Clone, Copy, Debug)]
pub struct HubConfig {
    /// Reports a subscriber may lag behind before its oldest are dropped (20 s of one camera at
    /// 25 frames/s by default).
    pub capacity: usize,
    /// Separate holes a subscriber may have pending before it is given up. Holes of one camera and
    /// epoch are one, so only a subscriber that has stopped reading while cameras restart again and
    /// again gets here.
    pub max_gaps: usize,
}

impl Default for HubConfig {
    fn default() -> Self {
        Self { capacity: 512, max_gaps: 1024 }
    }
}

/// The hub's figures.
#[derive(Clone, Debug)]
pub struct HubMetrics {
    /// Reports published.
    pub published: IntCounter,
    /// Reports dropped from a subscriber's ring because it lagged (one report dropped for two
    /// subscribers counts twice).
    pub dropped_by_lag: IntCounter,
    /// Subscribers given up because they had too many holes pending.
    pub given_up: IntCounter,
    /// Subscribers now.
    pub subscribers: IntGauge,
}

impl HubMetrics {
    fn new() -> Self {
        let counter = |name, help| IntCounter::new(name, help).expect("a valid metric name");
        Self {
            published: counter("gakp_hub_reports_published_total", "Reports published to subscribers."),
            dropped_by_lag: counter(
                "gakp_hub_reports_dropped_total",
                "Reports dropped from a subscriber's ring because it was slow, summed over subscribers.",
            ),
            given_up: counter(
                "gakp_hub_subscribers_given_up_total",
                "Subscribers closed because they stopped reading while cameras restarted too often.",
            ),
            subscribers: IntGauge::new("gakp_hub_subscribers", "Subscribers of the track stream now.")
                .expect("a valid metric name"),
        }
    }

    /// Adds the hub's figures to a registry.
    ///
    /// # Errors
    /// A name is taken: the figures were registered before.
    pub fn register(&self, registry: &Registry) -> prometheus::Result<()> {
        registry.register(Box::new(self.published.clone()))?;
        registry.register(Box::new(self.dropped_by_lag.clone()))?;
        registry.register(Box::new(self.given_up.clone()))?;
        registry.register(Box::new(self.subscribers.clone()))
    }
}

/// Hands every report to every subscriber. Cheap to clone; clones are the same hub.
#[derive(Clone, Debug)]
pub struct Hub(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    config: HubConfig,
    classes: Arc<[String]>,
    mailboxes: Mutex<Mailboxes>,
    metrics: HubMetrics,
}

#[derive(Debug, Default)]
struct Mailboxes {
    open: Vec<Arc<Mailbox>>,
    closed: bool,
}

/// A lock that a panicking test thread cannot poison for everybody else: each guarded state is
/// valid between any two statements.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Hub {
    /// A hub whose reports name classes by `classes` (index = class).
    pub fn new(config: HubConfig, classes: Arc<[String]>) -> Self {
        let config = HubConfig { capacity: config.capacity.max(1), max_gaps: config.max_gaps.max(1) };
        Self(Arc::new(Shared { config, classes, mailboxes: Mutex::default(), metrics: HubMetrics::new() }))
    }

    /// The names of classes.
    pub fn classes(&self) -> &Arc<[String]> {
        &self.0.classes
    }

    /// The hub's figures.
    pub fn metrics(&self) -> &HubMetrics {
        &self.0.metrics
    }

    /// Puts a report into the ring of every subscriber that wants its camera. Never waits: a full
    /// ring loses its oldest report instead. Reports of one camera must come from one thread, `seq`
    /// growing by one within an epoch.
    pub fn publish(&self, tracks: Arc<FrameTracks>) {
        let shared = &*self.0;
        shared.metrics.published.inc();
        let mut report = None;
        let mailboxes = lock(&shared.mailboxes);
        for mailbox in mailboxes.open.iter().filter(|m| m.only.wants(&tracks.camera)) {
            let report =
                report.get_or_insert_with(|| Arc::new(Report::new(tracks.clone(), shared.classes.clone())));
            mailbox.put(report.clone(), shared);
        }
    }

    /// A new subscriber. It receives what is published from now on.
    pub fn subscribe(&self, only: Only) -> Subscription {
        let mailbox = Arc::new(Mailbox { only, ring: Mutex::default(), ready: Notify::new() });
        let mut mailboxes = lock(&self.0.mailboxes);
        if mailboxes.closed {
            lock(&mailbox.ring).end = Some(End::Closed);
        } else {
            mailboxes.open.push(mailbox.clone());
            self.0.metrics.subscribers.inc();
        }
        Subscription { hub: self.clone(), mailbox }
    }

    /// Ends every subscription, after what is already in its ring. Later subscriptions end at once.
    pub fn close(&self) {
        let mut mailboxes = lock(&self.0.mailboxes);
        mailboxes.closed = true;
        for mailbox in &mailboxes.open {
            lock(&mailbox.ring).end.get_or_insert(End::Closed);
            mailbox.ready.notify_one();
        }
    }
}

#[derive(Debug)]
struct Mailbox {
    only: Only,
    ring: Mutex<Ring>,
    /// Wakes the one subscriber; `notify_one` before it waits is remembered.
    ready: Notify,
}

#[derive(Debug, Default)]
struct Ring {
    reports: VecDeque<Arc<Report>>,
    /// Holes not yet announced, in the order in which they began.
    gaps: VecDeque<Gap>,
    end: Option<End>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// The hub closed.
    Closed,
    /// The subscriber was too slow to keep account of what it missed.
    GivenUp,
}

impl Mailbox {
    fn put(&self, report: Arc<Report>, hub: &Shared) {
        let mut ring = lock(&self.ring);
        if ring.end.is_some() {
            return;
        }
        // What is dropped is freed after the lock is let go: the subscriber never waits for it.
        let dropped = if ring.reports.len() >= hub.config.capacity { ring.reports.pop_front() } else { None };
        ring.reports.push_back(report);
        let mut abandoned = None;
        if let Some(dropped) = &dropped {
            hub.metrics.dropped_by_lag.inc();
            ring.note_missing(&dropped.tracks);
            if ring.gaps.len() > hub.config.max_gaps {
                hub.metrics.given_up.inc();
                abandoned =
                    Some(std::mem::replace(&mut *ring, Ring { end: Some(End::GivenUp), ..Ring::default() }));
            }
        }
        drop(ring);
        drop(abandoned);
        self.ready.notify_one();
    }
}

impl Ring {
    /// Remembers that `tracks` was dropped: as one more at the end of its camera's pending hole, or
    /// as a new hole.
    fn note_missing(&mut self, tracks: &FrameTracks) {
        let FrameTracks { camera, epoch, seq, .. } = tracks;
        let pending = self.gaps.iter_mut().rev().find(|gap| gap.camera == *camera);
        match pending {
            Some(gap) if gap.epoch == *epoch && gap.last.checked_add(1) == Some(*seq) => gap.last = *seq,
            _ => self.gaps.push_back(Gap { camera: camera.clone(), epoch: *epoch, first: *seq, last: *seq }),
        }
    }

    fn take(&mut self) -> Option<Event> {
        // Gaps first: every dropped report is older than every report still here.
        self.gaps.pop_front().map(Event::Gap).or_else(|| self.reports.pop_front().map(Event::Tracks))
    }
}

/// One subscriber's end of its ring. Dropping it unsubscribes.
#[derive(Debug)]
pub struct Subscription {
    hub: Hub,
    mailbox: Arc<Mailbox>,
}

impl Subscription {
    /// The next report or gap; `None` when the hub closed and all was taken, or when this subscriber
    /// was given up ([`Subscription::given_up`]). Cancel safe.
    pub async fn next(&mut self) -> Option<Event> {
        loop {
            {
                let mut ring = lock(&self.mailbox.ring);
                if let Some(event) = ring.take() {
                    return Some(event);
                }
                if ring.end.is_some() {
                    return None;
                }
            }
            self.mailbox.ready.notified().await;
        }
    }

    /// What is there now, without waiting.
    pub fn try_next(&mut self) -> Option<Event> {
        lock(&self.mailbox.ring).take()
    }

    /// Whether the hub gave this subscriber up: it had more holes pending than
    /// [`HubConfig::max_gaps`].
    pub fn given_up(&self) -> bool {
        lock(&self.mailbox.ring).end == Some(End::GivenUp)
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let mut mailboxes = lock(&self.hub.0.mailboxes);
        if let Some(at) = mailboxes.open.iter().position(|m| Arc::ptr_eq(m, &self.mailbox)) {
            mailboxes.open.swap_remove(at);
            self.hub.0.metrics.subscribers.dec();
        }
    }
}

#[cfg(test)]
#[path = "hub_tests.rs"]
mod tests;
