//! A webhook's books: what became of its events, and what last went wrong.

use std::sync::{Mutex, MutexGuard, PoisonError};

use jiff::Timestamp;
use prometheus::{IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry};

use crate::notify::queue::Queue;
use crate::outgoing::Sparing;

/// What became of an event, the metric's label `outcome`.
#[derive(Clone, Copy)]
pub(super) enum Outcome {
    /// Answered with 2xx.
    Delivered,
    /// Answered with what another attempt would not change.
    Refused,
    /// Tried for too long.
    GivenUp,
    /// The queue was full, or it was lost before it came there.
    Dropped,
    /// The service stopped.
    Stopped,
}

impl Outcome {
    const ALL: [Outcome; 5] =
        [Outcome::Delivered, Outcome::Refused, Outcome::GivenUp, Outcome::Dropped, Outcome::Stopped];

    fn as_str(self) -> &'static str {
        match self {
            Outcome::Delivered => "delivered",
            Outcome::Refused => "refused",
            Outcome::GivenUp => "given_up",
            Outcome::Dropped => "dropped",
            Outcome::Stopped => "stopped",
        }
    }
}

/// The figures of all webhooks.
pub(super) struct Figures {
    outcomes: IntCounterVec,
    retries: IntCounterVec,
    waiting: IntGaugeVec,
    up: IntGaugeVec,
}

impl Figures {
    /// # Errors
    /// They were registered before.
    pub fn register(registry: &Registry) -> prometheus::Result<Self> {
        let gauge = |name: &str, help: &str| -> prometheus::Result<IntGaugeVec> {
            let vec = IntGaugeVec::new(Opts::new(name, help), &["webhook"])?;
            registry.register(Box::new(vec.clone()))?;
            Ok(vec)
        };
        let counter = |name: &str, help: &str, labels: &[&str]| -> prometheus::Result<IntCounterVec> {
            let vec = IntCounterVec::new(Opts::new(name, help), labels)?;
            registry.register(Box::new(vec.clone()))?;
            Ok(vec)
        };
        Ok(Self {
            outcomes: counter(
                "gakp_webhook_deliveries_total",
                "Events of a webhook, by what became of them.",
                &["webhook", "outcome"],
            )?,
            retries: counter(
                "gakp_webhook_retries_total",
                "Posts that failed and were to be tried again.",
                &["webhook"],
            )?,
            waiting: gauge("gakp_webhook_queue_length", "Events that wait to be posted.")?,
            up: gauge("gakp_webhook_up", "1 unless the last post failed or it cannot be used.")?,
        })
    }

    /// Those of one webhook are shown no more.
    pub fn forget(&self, name: &str) {
        for outcome in Outcome::ALL {
            // An error means that they are not there.
            let _ = self.outcomes.remove_label_values(&[name, outcome.as_str()]);
        }
        let _ = self.retries.remove_label_values(&[name]);
        let _ = self.waiting.remove_label_values(&[name]);
        let _ = self.up.remove_label_values(&[name]);
    }
}

/// One webhook's books.
pub(super) struct Account {
    pub name: String,
    pub queue: Queue,
    outcomes: [IntCounter; 5],
    pub retries: IntCounter,
    up: IntGauge,
    waiting: IntGauge,
    last_error: Mutex<Option<(Timestamp, String)>>,
    losses: Mutex<Sparing>,
    troubles: Mutex<Sparing>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Account {
    pub fn open(name: &str, queue: usize, figures: &Figures) -> Self {
        let account = Self {
            name: name.to_owned(),
            queue: Queue::new(queue),
            outcomes: Outcome::ALL.map(|o| figures.outcomes.with_label_values(&[name, o.as_str()])),
            retries: figures.retries.with_label_values(&[name]),
            up: figures.up.with_label_values(&[name]),
            waiting: figures.waiting.with_label_values(&[name]),
            last_error: Mutex::default(),
            losses: Mutex::default(),
            troubles: Mutex::default(),
        };
        account.up.set(1);
        account
    }

    pub fn count(&self, outcome: Outcome, events: u64) {
        self.outcomes[outcome as usize].inc_by(events);
        self.waiting.set(self.queue.len() as i64);
        if events == 0 || matches!(outcome, Outcome::Delivered) {
            return;
        }
        if let Some(lost) = lock(&self.losses).note(events) {
            let last = self.last_error().map_or(String::new(), |(_, text)| text);
            let (webhook, reason) = (&self.name, outcome.as_str());
            tracing::warn!(%webhook, lost, reason, last_error = last, "a webhook loses events");
        }
    }

    pub fn failed(&self, what: String) {
        if let Some(failures) = lock(&self.troubles).note(1) {
            tracing::warn!(webhook = self.name, failures, error = what, "a webhook fails");
        }
        self.up.set(0);
        *lock(&self.last_error) = Some((Timestamp::now(), what));
    }

    pub fn works(&self) {
        if self.up.get() == 0 {
            tracing::debug!(webhook = self.name, "a webhook works again");
        }
        self.up.set(1);
    }

    /// Events that were delivered, and that were lost for whatever reason.
    pub fn totals(&self) -> (u64, u64) {
        let [delivered, lost @ ..] = self.outcomes.each_ref().map(IntCounter::get);
        (delivered, lost.iter().sum())
    }

    /// What last went wrong, and when; stays after recovery.
    pub fn last_error(&self) -> Option<(Timestamp, String)> {
        lock(&self.last_error).clone()
    }
}
