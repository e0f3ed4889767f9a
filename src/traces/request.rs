//! A request's trace: one span, by OpenTelemetry's conventions for HTTP servers.

use std::time::Instant;

use axum::http::{Method, StatusCode};
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;

use super::context::Context;
use super::message::{Moment, int, root, text};
use super::{Finished, Traces};

const METHODS: [&str; 7] = ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"];

/// What the conventions call any other method.
const OTHER: &str = "_OTHER";

/// A request that is traced. It knows the route's pattern, neither path nor query: those may hold secrets.
pub struct RequestTrace {
    traces: Traces,
    context: Context,
    method: &'static str,
    route: String,
    began: Instant,
    ended: Option<(Moment, StatusCode)>,
}

impl RequestTrace {
    pub(super) fn new(traces: Traces, context: Context, method: &Method, route: &str) -> Self {
        // What clients make up is not repeated.
        let method = METHODS.into_iter().find(|known| *known == method.as_str()).unwrap_or(OTHER);
        Self { traces, context, method, route: route.into(), began: Instant::now(), ended: None }
    }

    /// It is answered; what streams has begun.
    pub fn finish(mut self: Box<Self>, status: StatusCode) {
        self.ended = Some((Moment::now(), status));
        let traces = self.traces.clone();
        traces.hand(Finished::Request(self));
    }

    /// Appends its span.
    pub(super) fn spans(&self, spans: &mut Vec<Span>) {
        let Some((end, status)) = self.ended else { return };
        let method = if self.method == OTHER { "HTTP" } else { self.method };
        let mut attributes = vec![
            text("http.request.method", self.method),
            text("http.route", &self.route),
            int("http.response.status_code", u64::from(status.as_u16())),
        ];
        let failed = status.is_server_error();
        if failed {
            attributes.push(text("error.type", status.as_str()));
        }
        let span = Span {
            name: format!("{method} {}", self.route),
            attributes,
            ..root(self.context, SpanKind::Server, failed.then(String::new))
        };
        spans.push(end.over(self.began, end.at(), span));
    }
}
