//! A frame's trace: when each step began and ended, and what became of the frame.

use std::time::Instant;

use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;

use super::context::Context;
use super::message::{Moment, child, int, root, text};
use super::{Finished, Traces};
use crate::telemetry::DropReason;
use crate::types::{CameraId, Epoch};

/// The steps of a frame, in the order of the flow. The tracker's work is measured as one stage
/// ([`crate::telemetry::Stage::Track`]), but has two parts, and the link scores come in between.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Waiting for detection to be free.
    Wait,
    /// Detection: queue, pre-processing, model, decoding.
    Detect,
    /// Embedding, the same.
    Embed,
    /// Tracks are moved to the frame's time.
    Predict,
    /// Link scores: queue, model.
    Link,
    /// Matching, births, ends.
    Update,
    /// To the hub, the lines and zones.
    Publish,
}

impl Step {
    const ALL: [Step; 7] =
        [Step::Wait, Step::Detect, Step::Embed, Step::Predict, Step::Link, Step::Update, Step::Publish];

    /// The span's name.
    pub fn as_str(self) -> &'static str {
        match self {
            Step::Wait => "wait",
            Step::Detect => "detect",
            Step::Embed => "embed",
            Step::Predict => "predict",
            Step::Link => "link",
            Step::Update => "update",
            Step::Publish => "publish",
        }
    }
}

/// What became of a frame; as in the account.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Tracked and published.
    Tracked,
    /// Dropped.
    Dropped(DropReason),
}

impl Outcome {
    fn as_str(self) -> &'static str {
        match self {
            Outcome::Tracked => "tracked",
            Outcome::Dropped(reason) => reason.as_str(),
        }
    }

    /// Whether something is broken; that there are too many frames is no error.
    fn is_error(self) -> bool {
        matches!(self, Outcome::Dropped(DropReason::Inference | DropReason::Corrupt))
    }
}

/// A frame that is traced.
pub struct FrameTrace {
    traces: Traces,
    context: Context,
    camera: CameraId,
    epoch: Epoch,
    index: Option<u64>,
    began: Instant,
    steps: [Option<(Instant, Instant)>; Step::ALL.len()],
    ended: Option<(Moment, Outcome)>,
}

impl FrameTrace {
    pub(super) fn new(
        traces: Traces,
        context: Context,
        (camera, epoch, index): (CameraId, Epoch, Option<u64>),
        began: Instant,
    ) -> Self {
        let steps = [None; Step::ALL.len()];
        Self { traces, context, camera, epoch, index, began, steps, ended: None }
    }

    /// A step that began at `began` has just ended.
    pub fn step(&mut self, step: Step, began: Instant) {
        self.steps[step as usize] = Some((began, Instant::now()));
    }

    /// The frame's account is settled.
    pub fn finish(mut self: Box<Self>, outcome: Outcome) {
        self.ended = Some((Moment::now(), outcome));
        let traces = self.traces.clone();
        traces.hand(Finished::Frame(self));
    }

    /// Appends its spans, the root first.
    pub(super) fn spans(&self, spans: &mut Vec<Span>) {
        let Some((end, outcome)) = self.ended else { return };
        let mut attributes = vec![
            text("gakp.camera", self.camera.as_str()),
            int("gakp.epoch", self.epoch.0),
            text("gakp.outcome", outcome.as_str()),
        ];
        attributes.extend(self.index.map(|index| int("gakp.frame", index)));
        let error = outcome.is_error().then(|| format!("dropped: {}", outcome.as_str()));
        let span = Span { name: "frame".into(), attributes, ..root(self.context, SpanKind::Internal, error) };
        let span = end.over(self.began, end.at(), span);
        let steps = Step::ALL.iter().zip(&self.steps);
        let children = steps.filter_map(|(step, time)| {
            let (began, ended) = (*time)?;
            Some(end.over(began, ended, child(&span, step.as_str())))
        });
        let children: Vec<_> = children.collect();
        spans.push(span);
        spans.extend(children);
    }
}
