//! OTLP's messages: spans and what they consist of.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::common::v1::{AnyValue, InstrumentationScope, KeyValue};
use opentelemetry_proto::tonic::resource::v1::Resource;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use opentelemetry_proto::tonic::trace::v1::status::StatusCode;
use opentelemetry_proto::tonic::trace::v1::{ResourceSpans, ScopeSpans, Span, SpanFlags, Status};

use super::context::{Context, span_id};

/// W3C's flag of a trace that is recorded.
const SAMPLED: u32 = 1;

/// A moment by both clocks: what happened before it is told by the steady one, so that no step of the wall clock
/// comes between the spans of a trace.
#[derive(Clone, Copy)]
pub(super) struct Moment {
    steady: Instant,
    wall: SystemTime,
}

impl Moment {
    pub fn now() -> Self {
        Self { steady: Instant::now(), wall: SystemTime::now() }
    }

    pub fn at(&self) -> Instant {
        self.steady
    }

    /// `span` from `began` to `ended`, both before this moment.
    pub fn over(&self, began: Instant, ended: Instant, span: Span) -> Span {
        let unix = |instant: Instant| {
            let wall = self.wall.duration_since(UNIX_EPOCH).unwrap_or_default();
            wall.saturating_sub(self.steady.saturating_duration_since(instant)).as_nanos() as u64
        };
        Span { start_time_unix_nano: unix(began), end_time_unix_nano: unix(ended), ..span }
    }
}

/// The first span of a trace here; `error` says what failed.
pub(super) fn root(context: Context, kind: SpanKind, error: Option<String>) -> Span {
    let remote = context.parent.map_or(0, |_| SpanFlags::ContextIsRemoteMask as u32);
    Span {
        trace_id: context.trace.to_be_bytes().into(),
        span_id: span_id().to_be_bytes().into(),
        parent_span_id: context.parent.map_or(vec![], |parent| parent.to_be_bytes().into()),
        flags: SAMPLED | SpanFlags::ContextHasIsRemoteMask as u32 | remote,
        kind: kind as i32,
        status: error.map(|message| Status { message, code: StatusCode::Error as i32 }),
        ..Span::default()
    }
}

/// A span within `parent`.
pub(super) fn child(parent: &Span, name: &str) -> Span {
    Span {
        trace_id: parent.trace_id.clone(),
        span_id: span_id().to_be_bytes().into(),
        parent_span_id: parent.span_id.clone(),
        flags: SAMPLED | SpanFlags::ContextHasIsRemoteMask as u32,
        kind: SpanKind::Internal as i32,
        name: name.into(),
        ..Span::default()
    }
}

pub(super) fn text(key: &str, value: &str) -> KeyValue {
    attribute(key, Value::StringValue(value.into()))
}

pub(super) fn int(key: &str, value: u64) -> KeyValue {
    attribute(key, Value::IntValue(i64::try_from(value).unwrap_or(i64::MAX)))
}

fn attribute(key: &str, value: Value) -> KeyValue {
    KeyValue { key: key.into(), value: Some(AnyValue { value: Some(value) }), ..KeyValue::default() }
}

/// What a post consists of.
pub(super) fn request(service: &str, spans: Vec<Span>) -> ExportTraceServiceRequest {
    let version = env!("CARGO_PKG_VERSION");
    let attributes = vec![text("service.name", service), text("service.version", version)];
    let scope = InstrumentationScope { name: "gakp".into(), version: version.into(), ..Default::default() };
    let resource = Resource { attributes, ..Resource::default() };
    let scope_spans = vec![ScopeSpans { scope: Some(scope), spans, ..ScopeSpans::default() }];
    let resource = ResourceSpans { resource: Some(resource), scope_spans, ..ResourceSpans::default() };
    ExportTraceServiceRequest { resource_spans: vec![resource] }
}
