//! Traces for OpenTelemetry: what a frame and a request spent their time on, exported over OTLP/HTTP.
//!
//! ```text
//! Ticket, settled --frame--\
//!                           [queue, 2,048] --> Exporter: batches, protobuf --POST /v1/traces--> collector
//! API, answered --request--/
//! ```
//!
//! Whether a frame or a request is traced is decided when it comes in; what is not traced costs one comparison, and
//! without `[traces]` there is nothing at all. Whoever finishes a trace never waits: what the queue has no room for
//! is counted and dropped. The spans are made by the exporter. docs/operating.md has what they say.

mod config;
mod context;
mod export;
mod frame;
mod message;
mod request;

use std::sync::Arc;
use std::time::Instant;

use axum::http::{HeaderMap, Method};
use prometheus::IntCounter;
use tokio::sync::mpsc;

pub use config::{TracesError, TracesOptions, TracesPlan};
pub use export::Exporter;
pub use frame::{FrameTrace, Outcome, Step};
pub use request::RequestTrace;

use crate::types::{CameraId, Epoch};
use context::{Context, Sampler};

/// Where finished traces go. Clones are the same.
#[derive(Clone)]
pub struct Traces(Arc<Inbox>);

struct Inbox {
    queue: mpsc::Sender<Finished>,
    sampler: Sampler,
    dropped: IntCounter,
}

/// A trace that waits to be exported.
enum Finished {
    Frame(Box<FrameTrace>),
    Request(Box<RequestTrace>),
}

impl Traces {
    /// The trace of a frame that came in at `began`, if it is to be traced. A picture that was never decoded has no
    /// index.
    pub fn frame(
        &self,
        camera: &CameraId,
        epoch: Epoch,
        index: Option<u64>,
        began: Instant,
    ) -> Option<Box<FrameTrace>> {
        let context = self.0.sampler.root()?;
        Some(Box::new(FrameTrace::new(self.clone(), context, (camera.clone(), epoch, index), began)))
    }

    /// The trace of a request that comes in now, if it is to be traced. Who asks decides, if their `traceparent` says.
    pub fn request(&self, method: &Method, route: &str, headers: &HeaderMap) -> Option<Box<RequestTrace>> {
        let context = match Context::of_caller(headers) {
            Some(context) => context.sampled.then_some(context)?,
            None => self.0.sampler.root()?,
        };
        Some(Box::new(RequestTrace::new(self.clone(), context, method, route)))
    }

    fn hand(&self, finished: Finished) {
        if self.0.queue.try_send(finished).is_err() {
            self.0.dropped.inc();
        }
    }
}
