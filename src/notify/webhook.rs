//! Webhooks: each event posted in order, tried again while it makes sense, and counted when it is lost.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::http::header::InvalidHeaderValue;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use futures::FutureExt;
use jiff::Timestamp;
use prometheus::{IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry};
use serde::Serialize;
use tokio::task::JoinSet;
use tokio::time::{sleep, sleep_until, timeout};

use super::cloud_event::{MEDIA_TYPE, body, signature};
use super::config::WebhookPlan;
use super::queue::{Queue, Waiting};
use super::{GRACE, Stop};
use crate::outgoing::{Poster, Sparing, backoff};
use crate::publish::{EventHub, EventListener, Heard};

/// Longest wait between two attempts that the receiver did not ask for.
const LONGEST_WAIT: Duration = Duration::from_secs(60);

/// What became of an event, the metric's label `outcome`.
#[derive(Clone, Copy)]
enum Outcome {
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

/// How a webhook fares.
#[derive(Clone, Debug, Serialize)]
pub struct WebhookStatus {
    /// Its name.
    pub name: String,
    /// Where it posts to: scheme, host and port.
    pub url: String,
    /// Whether posts are signed.
    pub signed: bool,
    /// Events that were delivered.
    pub delivered: u64,
    /// Events that were lost, for whatever reason.
    pub failed: u64,
    /// Events that wait.
    pub pending: usize,
    /// What last went wrong; stays after recovery.
    pub last_error: Option<String>,
    /// When that was, RFC 3339.
    pub last_error_time: Option<String>,
}

/// A running webhook, to ask how it fares. Clones are the same.
#[derive(Clone)]
pub struct WebhookHandle(Arc<Account>);

/// One webhook's books.
struct Account {
    name: String,
    url: String,
    signed: bool,
    queue: Queue,
    outcomes: [IntCounter; 5],
    retries: IntCounter,
    up: IntGauge,
    waiting: IntGauge,
    last_error: Mutex<Option<(Timestamp, String)>>,
    losses: Mutex<Sparing>,
    troubles: Mutex<Sparing>,
}

impl WebhookHandle {
    /// How it fares now.
    pub fn status(&self) -> WebhookStatus {
        let account = &*self.0;
        let [delivered, lost @ ..] = account.outcomes.each_ref().map(IntCounter::get);
        let last_error = lock(&account.last_error).clone();
        WebhookStatus {
            name: account.name.clone(),
            url: account.url.clone(),
            signed: account.signed,
            delivered,
            failed: lost.iter().sum(),
            pending: account.queue.len(),
            last_error_time: last_error.as_ref().map(|(at, _)| format!("{at:.3}")),
            last_error: last_error.map(|(_, text)| text),
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Account {
    fn count(&self, outcome: Outcome, events: u64) {
        self.outcomes[outcome as usize].inc_by(events);
        self.waiting.set(self.queue.len() as i64);
        if events == 0 || matches!(outcome, Outcome::Delivered) {
            return;
        }
        if let Some(lost) = lock(&self.losses).note(events) {
            let last = lock(&self.last_error).clone().map_or(String::new(), |(_, text)| text);
            let (webhook, reason) = (&self.name, outcome.as_str());
            tracing::warn!(%webhook, lost, reason, last_error = last, "a webhook loses events");
        }
    }

    fn failed(&self, what: String) {
        if let Some(failures) = lock(&self.troubles).note(1) {
            tracing::warn!(webhook = self.name, failures, error = what, "a webhook fails");
        }
        self.up.set(0);
        *lock(&self.last_error) = Some((Timestamp::now(), what));
    }

    fn works(&self) {
        if self.up.get() == 0 {
            tracing::debug!(webhook = self.name, "a webhook works again");
        }
        self.up.set(1);
    }
}

/// Starts all webhooks: a task each to collect events and to deliver them.
pub(super) fn start(
    plans: Vec<WebhookPlan>,
    events: &EventHub,
    registry: &Registry,
    stop: &Stop,
    tasks: &mut JoinSet<()>,
) -> prometheus::Result<Vec<WebhookHandle>> {
    if plans.is_empty() {
        return Ok(vec![]);
    }
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
    let outcomes = counter(
        "gakp_webhook_deliveries_total",
        "Events of a webhook, by what became of them.",
        &["webhook", "outcome"],
    )?;
    let retries =
        counter("gakp_webhook_retries_total", "Posts that failed and were to be tried again.", &["webhook"])?;
    let waiting = gauge("gakp_webhook_queue_length", "Events that wait to be posted.")?;
    let up = gauge("gakp_webhook_up", "1 unless the last post failed.")?;
    let mut handles = vec![];
    for plan in plans {
        let name = plan.name.as_str();
        let account = Arc::new(Account {
            name: name.to_owned(),
            url: plan.address.to_string(),
            signed: plan.key.is_some(),
            queue: Queue::new(plan.queue),
            outcomes: Outcome::ALL.map(|o| outcomes.with_label_values(&[name, o.as_str()])),
            retries: retries.with_label_values(&[name]),
            up: up.with_label_values(&[name]),
            waiting: waiting.with_label_values(&[name]),
            last_error: Mutex::default(),
            losses: Mutex::default(),
            troubles: Mutex::default(),
        });
        account.up.set(1);
        tracing::info!(webhook = name, url = account.url, "events are posted");
        handles.push(WebhookHandle(account.clone()));
        let listener = events.listen(plan.filter.clone());
        tasks.spawn(collect(account.clone(), listener, stop.clone()));
        tasks.spawn(deliver(plan, account, stop.clone()));
    }
    Ok(handles)
}

/// Takes what the hub tells into the queue.
async fn collect(account: Arc<Account>, mut listener: EventListener, mut stop: Stop) {
    loop {
        let heard = tokio::select! {
            heard = listener.next() => heard,
            // What was told before the end still counts.
            () = stop.stopped() => match listener.next().now_or_never() {
                Some(heard) => heard,
                None => break,
            },
        };
        match heard {
            Some(Heard::Event(event)) => {
                let dropped = account.queue.push(event);
                account.count(Outcome::Dropped, u64::from(dropped));
            }
            // Of all kinds and cameras: some of them perhaps were not for this webhook.
            Some(Heard::Missed(missed)) => account.count(Outcome::Dropped, missed),
            None => break,
        }
    }
    account.queue.close();
}

async fn deliver(plan: WebhookPlan, account: Arc<Account>, stop: Stop) {
    let mut ending = stop.clone();
    let over = async {
        ending.stopped().await;
        sleep(GRACE).await;
    };
    let worker = Worker {
        poster: Poster::new(plan.address.clone(), plan.tls.clone()),
        plan,
        account: account.clone(),
        stop,
        failures: 0,
    };
    tokio::select! {
        () = worker.run() => {}
        () = over => {}
    }
    let left = account.queue.clear();
    account.count(Outcome::Stopped, left);
}

struct Worker {
    poster: Poster,
    plan: WebhookPlan,
    account: Arc<Account>,
    stop: Stop,
    /// Failures in a row.
    failures: u32,
}

/// What came of one attempt.
enum Attempt {
    Delivered,
    Refused(String),
    Failed(String, Option<Duration>),
}

impl Worker {
    /// Until the queue is closed and empty, or an attempt fails while the service stops.
    async fn run(mut self) {
        while let Some(Waiting { event, .. }) = self.account.queue.next().await {
            let attempt = match Message::new(&event, &self.plan) {
                Ok(message) => self.attempt(message).await,
                Err(error) => Attempt::Refused(error.to_string()),
            };
            let wait = match attempt {
                Attempt::Delivered => {
                    self.settled(Outcome::Delivered);
                    self.account.works();
                    continue;
                }
                Attempt::Refused(what) => {
                    self.account.failed(what);
                    self.settled(Outcome::Refused);
                    continue;
                }
                Attempt::Failed(what, retry_after) => {
                    self.failures = self.failures.saturating_add(1);
                    self.account.failed(what);
                    self.account.retries.inc();
                    let wait = backoff(self.failures, LONGEST_WAIT);
                    // Who asks for longer than an event is kept would lose all of them.
                    wait.max(retry_after.unwrap_or_default().min(self.plan.give_up))
                }
            };
            if self.stop.is_stopping() {
                return;
            }
            self.expire();
            let until = Instant::now() + wait;
            tokio::select! {
                () = sleep_until(until.into()) => {}
                // One last attempt.
                () = self.stop.stopped() => {}
            }
            self.expire();
        }
    }

    fn settled(&mut self, outcome: Outcome) {
        self.failures = 0;
        self.account.queue.done();
        self.account.count(outcome, 1);
    }

    fn expire(&self) {
        let given_up = self.account.queue.expire(self.plan.give_up);
        self.account.count(Outcome::GivenUp, given_up);
    }

    async fn attempt(&mut self, message: Message) -> Attempt {
        let posted = timeout(self.plan.timeout, self.poster.post(&message.headers, message.body)).await;
        let answer = match posted {
            Ok(Ok(answer)) => answer,
            Ok(Err(error)) => return Attempt::Failed(error.to_string(), None),
            Err(_) => return Attempt::Failed(format!("no answer within {:?}", self.plan.timeout), None),
        };
        let status = answer.status;
        let what = format!("answered {status}");
        if status.is_success() {
            Attempt::Delivered
        } else if status.is_server_error()
            || [StatusCode::REQUEST_TIMEOUT, StatusCode::TOO_MANY_REQUESTS].contains(&status)
        {
            Attempt::Failed(what, answer.retry_after)
        } else if status.is_redirection() {
            Attempt::Refused(format!("{what}; redirects are not followed: configure the new URL"))
        } else {
            Attempt::Refused(what)
        }
    }
}

/// A post: made anew for each attempt, for its time stamp is part of what is signed.
struct Message {
    headers: HeaderMap,
    body: bytes::Bytes,
}

#[derive(Debug, thiserror::Error)]
enum MessageError {
    #[error("the event cannot be written: {0}")]
    Body(#[from] serde_json::Error),
    #[error("the event's headers cannot be written: {0}")]
    Header(#[from] InvalidHeaderValue),
}

impl Message {
    fn new(event: &crate::publish::NumberedEvent, plan: &WebhookPlan) -> Result<Self, MessageError> {
        let body = body(event)?;
        let now = Timestamp::now().as_second();
        let mut headers = HeaderMap::new();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
        headers.insert(HeaderName::from_static("webhook-id"), HeaderValue::from_str(&event.id)?);
        headers.insert(HeaderName::from_static("webhook-timestamp"), HeaderValue::from(now));
        if let Some(key) = &plan.key {
            let signature = HeaderValue::from_str(&signature(key, &event.id, now, &body))?;
            headers.insert(HeaderName::from_static("webhook-signature"), signature);
        }
        Ok(Self { headers, body })
    }
}
