//! The exporter: takes finished traces from the queue, makes spans of them, posts them in batches.

use std::time::Duration;

use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use bytes::Bytes;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceResponse;
use prometheus::{IntCounter, Registry};
use prost::Message;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use super::config::TracesPlan;
use super::context::Sampler;
use super::{Finished, Inbox, Traces, message};
use crate::outgoing::{Poster, Sparing, backoff};

/// Traces that wait to be exported.
const QUEUE: usize = 2048;
/// Most traces of a post: some 200 kB.
const BATCH: usize = 256;
/// How long a trace waits for others at most.
const DELAY: Duration = Duration::from_secs(1);
/// How long a post may take.
const TIMEOUT: Duration = Duration::from_secs(10);
/// How often a batch is tried. Newer ones come, and are worth more.
const ATTEMPTS: u32 = 5;
const LONGEST_WAIT: Duration = Duration::from_secs(30);
/// How long the last traces have once the service stops.
const GRACE: Duration = Duration::from_secs(1);

/// The running exporter.
pub struct Exporter {
    stop: watch::Sender<bool>,
    task: JoinHandle<()>,
}

impl Exporter {
    /// Starts it, and what it is told by. Its figures appear in `registry`. Needs a tokio runtime.
    ///
    /// # Errors
    /// The figures were registered before.
    pub fn start(plan: TracesPlan, registry: &Registry) -> prometheus::Result<(Self, Traces)> {
        let counter = |name: &str, help: &str| -> prometheus::Result<IntCounter> {
            let counter = IntCounter::new(name, help)?;
            registry.register(Box::new(counter.clone()))?;
            Ok(counter)
        };
        let exported = counter("gakp_traces_exported_total", "Traces that the collector took.")?;
        let dropped = counter(
            "gakp_traces_dropped_total",
            "Traces that were lost: the queue was full, or the collector did not take them.",
        )?;
        let failures = counter("gakp_traces_failures_total", "Posts of traces that failed.")?;
        tracing::info!(collector = %plan.address, sample = plan.sample, "traces are exported");
        let (sender, queue) = mpsc::channel(QUEUE);
        let (stop, stopped) = watch::channel(false);
        let inbox = Inbox { queue: sender, sampler: Sampler::new(plan.sample), dropped: dropped.clone() };
        let mut headers = plan.headers;
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/x-protobuf"));
        let worker = Worker {
            poster: Poster::new(plan.address, plan.tls),
            headers,
            service_name: plan.service_name,
            stop: stopped,
            in_hand: 0,
            exported,
            dropped,
            failures,
            losses_told: 0,
            losses: Sparing::default(),
            troubles: Sparing::default(),
        };
        let task = tokio::spawn(worker.run(queue));
        Ok((Self { stop, task }, Traces(inbox.into())))
    }

    /// Exports what waits, for a moment; what is left then is counted. Nothing is to be finished any more.
    pub async fn stop(self) {
        self.stop.send_replace(true);
        if self.task.await.is_err() {
            tracing::error!("the exporter of traces panicked");
        }
    }
}

struct Worker {
    poster: Poster,
    headers: HeaderMap,
    service_name: String,
    stop: watch::Receiver<bool>,
    /// Traces of the batch that is being posted.
    in_hand: u64,
    exported: IntCounter,
    dropped: IntCounter,
    failures: IntCounter,
    /// Of `dropped`, those that the log was told of or that wait to be.
    losses_told: u64,
    losses: Sparing,
    troubles: Sparing,
}

/// What came of one post.
enum Attempt {
    Taken,
    Refused(String),
    Failed(String, Option<Duration>),
}

impl Worker {
    async fn run(mut self, mut queue: mpsc::Receiver<Finished>) {
        let mut stop = self.stop.clone();
        let over = async {
            // An error means that the exporter's handle is gone: that is stopping, too.
            let _ = stop.wait_for(|stopping| *stopping).await;
            sleep(GRACE).await;
        };
        tokio::select! {
            () = self.work(&mut queue) => {}
            () = over => {}
        }
        queue.close();
        let mut left = self.in_hand;
        while queue.try_recv().is_ok() {
            left += 1;
        }
        self.dropped.inc_by(left);
        self.tell_losses();
    }

    /// Until the service stops and the queue is empty.
    async fn work(&mut self, queue: &mut mpsc::Receiver<Finished>) {
        let mut batch = Vec::with_capacity(BATCH);
        loop {
            self.fill(queue, &mut batch).await;
            self.in_hand = batch.len() as u64;
            if batch.is_empty() {
                return;
            }
            self.deliver(encode(&self.service_name, &batch)).await;
            batch.clear();
            self.in_hand = 0;
            self.tell_losses();
        }
    }

    /// Waits for traces, and a moment longer for more of them; once the service stops, takes what is there.
    async fn fill(&mut self, queue: &mut mpsc::Receiver<Finished>, batch: &mut Vec<Finished>) {
        let mut until = None;
        while batch.len() < BATCH {
            let room = BATCH - batch.len();
            let moment = async {
                match until {
                    Some(until) => sleep_until(until).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                received = queue.recv_many(batch, room) => match received {
                    // Nobody can finish a trace any more.
                    0 => return,
                    _ => until = until.or(Some(Instant::now() + DELAY)),
                },
                () = moment => return,
                _ = self.stop.wait_for(|stopping| *stopping) => return,
            }
        }
    }

    /// Posts a batch until it is taken or there is no sense in going on.
    async fn deliver(&mut self, body: Bytes) {
        for attempt in 1..=ATTEMPTS {
            let (what, retry_after) = match self.post(body.clone()).await {
                Attempt::Taken => {
                    self.exported.inc_by(self.in_hand);
                    return;
                }
                Attempt::Refused(what) => {
                    self.failed(what);
                    break;
                }
                Attempt::Failed(what, retry_after) => (what, retry_after),
            };
            self.failed(what);
            // Once the service stops, a collector that is away is not waited for.
            if attempt == ATTEMPTS || *self.stop.borrow() {
                break;
            }
            let wait = backoff(attempt, LONGEST_WAIT).max(retry_after.unwrap_or_default().min(LONGEST_WAIT));
            tokio::select! {
                () = sleep(wait) => {}
                // One last attempt.
                _ = self.stop.wait_for(|stopping| *stopping) => {}
            }
        }
        self.dropped.inc_by(self.in_hand);
    }

    async fn post(&mut self, body: Bytes) -> Attempt {
        let answer = match timeout(TIMEOUT, self.poster.post(&self.headers, body)).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(error)) => return Attempt::Failed(error.to_string(), None),
            Err(_) => return Attempt::Failed(format!("no answer within {TIMEOUT:?}"), None),
        };
        let what = format!("answered {}", answer.status);
        match answer.status {
            status if status.is_success() => {
                let said = ExportTraceServiceResponse::decode(answer.body).unwrap_or_default();
                if let Some(partly) = said.partial_success.filter(|said| said.rejected_spans > 0) {
                    self.failed(format!("{what}, but refused {} spans", partly.rejected_spans));
                }
                Attempt::Taken
            }
            // Those that OTLP names.
            StatusCode::TOO_MANY_REQUESTS
            | StatusCode::BAD_GATEWAY
            | StatusCode::SERVICE_UNAVAILABLE
            | StatusCode::GATEWAY_TIMEOUT => Attempt::Failed(what, answer.retry_after),
            _ => Attempt::Refused(what),
        }
    }

    fn failed(&mut self, what: String) {
        self.failures.inc();
        if let Some(failures) = self.troubles.note(1) {
            tracing::warn!(failures, error = what, "traces cannot be exported");
        }
    }

    fn tell_losses(&mut self) {
        let dropped = self.dropped.get();
        let lost = dropped - std::mem::replace(&mut self.losses_told, dropped);
        if lost > 0
            && let Some(lost) = self.losses.note(lost)
        {
            tracing::warn!(lost, "traces are lost");
        }
    }
}

fn encode(service_name: &str, batch: &[Finished]) -> Bytes {
    let mut spans = vec![];
    for finished in batch {
        match finished {
            Finished::Frame(frame) => frame.spans(&mut spans),
            Finished::Request(request) => request.spans(&mut spans),
        }
    }
    message::request(service_name, spans).encode_to_vec().into()
}
