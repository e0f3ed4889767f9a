//! A webhook's way: events collected into its queue, posted in order, tried again while it makes sense.

use std::future::pending;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::http::header::InvalidHeaderValue;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use bytes::Bytes;
use jiff::Timestamp;
use tokio::sync::watch;
use tokio::time::{sleep, sleep_until, timeout};

use super::account::{Account, Outcome};
use crate::notify::cloud_event::{MEDIA_TYPE, body, signature, trial};
use crate::notify::config::WebhookPlan;
use crate::notify::queue::Waiting;
use crate::notify::{GRACE, Stop};
use crate::outgoing::{Address, Poster, backoff};
use crate::publish::{EventListener, Heard};

/// Longest wait between two attempts that the receiver did not ask for.
const LONGEST_WAIT: Duration = Duration::from_secs(60);
/// Longest that a trial waits for its answer.
const TRIAL_TIMEOUT: Duration = Duration::from_secs(10);

/// What a webhook goes by now. It is closed when the webhook is removed.
pub(super) type Plans = watch::Receiver<Arc<WebhookPlan>>;

/// Resolves once the webhook is removed. Cancel safe.
async fn removed(mut plans: Plans) {
    while plans.changed().await.is_ok() {}
}

/// Resolves once posts go elsewhere. Cancel safe.
async fn elsewhere(mut plans: Plans, here: &Address) {
    if plans.wait_for(|plan| plan.address != *here).await.is_err() {
        // It is removed, which is noticed in another place.
        pending().await
    }
}

/// Takes what the hub tells into the queue.
pub(super) async fn collect(
    account: Arc<Account>,
    mut listener: EventListener,
    plans: Plans,
    mut stop: Stop,
) {
    let mut removed = std::pin::pin!(removed(plans.clone()));
    loop {
        let heard = tokio::select! {
            heard = listener.next() => heard,
            // What was told before the end still counts.
            () = stop.stopped() => listener.try_next(),
            () = &mut removed => break,
        };
        match heard {
            Some(Heard::Event(event)) if plans.borrow().filter.wants(&event) => {
                let dropped = account.queue.push(event);
                account.count(Outcome::Dropped, u64::from(dropped));
            }
            Some(Heard::Event(_)) => {}
            // Of all kinds and cameras: some of them perhaps were not for this webhook.
            Some(Heard::Missed(missed)) => account.count(Outcome::Dropped, missed),
            None => break,
        }
    }
    account.queue.close();
}

/// Posts what is in the queue, until the service stops or the webhook is removed.
pub(super) async fn deliver(account: Arc<Account>, mut plans: Plans, stop: Stop) {
    let mut ending = stop.clone();
    let over = async {
        ending.stopped().await;
        sleep(GRACE).await;
    };
    let removed = removed(plans.clone());
    let plan = plans.borrow_and_update().clone();
    let poster = Poster::new(plan.address.clone(), plan.tls.clone());
    let worker = Worker { poster, plan, plans, account: account.clone(), stop, failures: 0 };
    tokio::select! {
        biased;
        () = removed => {}
        () = worker.run() => {}
        () = over => {}
    }
    let left = account.queue.clear();
    account.count(Outcome::Stopped, left);
}

struct Worker {
    poster: Poster,
    plan: Arc<WebhookPlan>,
    plans: Plans,
    account: Arc<Account>,
    stop: Stop,
    /// Failures in a row.
    failures: u32,
}

/// What came of one attempt.
enum Attempt {
    Delivered(StatusCode),
    Refused(String),
    Failed(String, Option<Duration>),
}

impl Worker {
    /// Until the queue is closed and empty, or an attempt fails while the service stops.
    async fn run(mut self) {
        while let Some(Waiting { event, .. }) = self.account.queue.next().await {
            self.take_up();
            let message = body(&event).map_err(MessageError::from);
            let attempt = match message.and_then(|body| Message::new(&event.id, body, &self.plan)) {
                Ok(message) => tokio::select! {
                    biased;
                    attempt = attempt(&mut self.poster, message, self.plan.timeout) => attempt,
                    // Where it goes now it is posted at once.
                    () = elsewhere(self.plans.clone(), &self.plan.address) => continue,
                },
                Err(error) => Attempt::Refused(error.to_string()),
            };
            let wait = match attempt {
                Attempt::Delivered(_) => {
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
                // What is still being collected is among what is left.
                self.account.queue.closed().await;
                return;
            }
            if self.take_up() {
                continue;
            }
            self.expire();
            let until = Instant::now() + wait;
            tokio::select! {
                () = sleep_until(until.into()) => {}
                // One last attempt.
                () = self.stop.stopped() => {}
                // Perhaps the new settings work.
                Ok(()) = self.plans.changed() => self.plans.mark_changed(),
            }
            self.take_up();
            self.expire();
        }
    }

    /// Goes by the newest plan; whether it is another.
    fn take_up(&mut self) -> bool {
        let changed = self.plans.has_changed().unwrap_or(false);
        if changed {
            self.plan = self.plans.borrow_and_update().clone();
            self.poster = Poster::new(self.plan.address.clone(), self.plan.tls.clone());
            self.failures = 0;
        }
        changed
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
}

async fn attempt(poster: &mut Poster, message: Message, patience: Duration) -> Attempt {
    let answer = match timeout(patience, poster.post(&message.headers, message.body)).await {
        Ok(Ok(answer)) => answer,
        Ok(Err(error)) => return Attempt::Failed(error.to_string(), None),
        Err(_) => return Attempt::Failed(format!("no answer within {patience:?}"), None),
    };
    let status = answer.status;
    let what = format!("answered {status}");
    if status.is_success() {
        Attempt::Delivered(status)
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

/// Posts something that is no event, once, past the queue; the answer's status.
///
/// # Errors
/// What went wrong, in words.
pub(super) async fn try_once(plan: &WebhookPlan) -> Result<StatusCode, String> {
    let id = format!("test-{:016x}", fastrand::u64(..));
    let body = trial(&id, &plan.name, &format!("{:.9}", Timestamp::now()));
    let message = body.map_err(MessageError::from).and_then(|body| Message::new(&id, body, plan));
    let message = message.map_err(|error| error.to_string())?;
    let mut poster = Poster::new(plan.address.clone(), plan.tls.clone());
    match attempt(&mut poster, message, plan.timeout.min(TRIAL_TIMEOUT)).await {
        Attempt::Delivered(status) => Ok(status),
        Attempt::Refused(what) | Attempt::Failed(what, _) => Err(what),
    }
}

/// A post: made anew for each attempt, for its time stamp is part of what is signed.
struct Message {
    headers: HeaderMap,
    body: Bytes,
}

#[derive(Debug, thiserror::Error)]
enum MessageError {
    #[error("the event cannot be written: {0}")]
    Body(#[from] serde_json::Error),
    #[error("the event's headers cannot be written: {0}")]
    Header(#[from] InvalidHeaderValue),
}

impl Message {
    fn new(id: &str, body: Bytes, plan: &WebhookPlan) -> Result<Self, MessageError> {
        let now = Timestamp::now().as_second();
        let mut headers = HeaderMap::new();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
        headers.insert(HeaderName::from_static("webhook-id"), HeaderValue::from_str(id)?);
        headers.insert(HeaderName::from_static("webhook-timestamp"), HeaderValue::from(now));
        if let Some(key) = &plan.key {
            let signature = HeaderValue::from_str(&signature(key, id, now, &body))?;
            headers.insert(HeaderName::from_static("webhook-signature"), signature);
        }
        Ok(Self { headers, body })
    }
}
