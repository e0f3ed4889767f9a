//! What the service measures, as Prometheus metrics, and how it logs.
//!
//! Names follow Prometheus: `gakp_` in front, base units, counters end in `_total`.

use std::sync::Arc;
use std::time::Duration;

use prometheus::{
    Histogram, HistogramOpts, HistogramVec, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry,
};

use crate::analytics::{Direction, RuleId};
use crate::infer::{BatchStats, Observer};
use crate::types::{CameraId, TrackState};

/// Why a frame was not tracked. Every queue's policy ends in one of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DropReason {
    /// A newer frame came before detection was free: the newest wins.
    Overload,
    /// Decoding fell behind the camera: skipped up to the next key frame.
    Undecoded,
    /// The decoder marked the picture as damaged.
    Corrupt,
    /// A model or the tracker failed on it.
    Inference,
    /// Its camera was removed, or the service stopped.
    Stopped,
}

impl DropReason {
    /// All reasons.
    pub const ALL: [DropReason; 5] = [
        DropReason::Overload,
        DropReason::Undecoded,
        DropReason::Corrupt,
        DropReason::Inference,
        DropReason::Stopped,
    ];

    /// The metric's label.
    pub fn as_str(self) -> &'static str {
        match self {
            DropReason::Overload => "overload",
            DropReason::Undecoded => "undecoded",
            DropReason::Corrupt => "corrupt",
            DropReason::Inference => "inference",
            DropReason::Stopped => "stopped",
        }
    }
}

/// The stages whose latency is measured, in the order of the flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Waiting for detection to be free.
    Wait,
    /// Detection: queue, pre-processing, model, decoding.
    Detect,
    /// Embedding, the same.
    Embed,
    /// Link scores, the same.
    Link,
    /// The tracker's own work, predict and update together.
    Track,
}

impl Stage {
    /// The metric's label.
    pub fn as_str(self) -> &'static str {
        match self {
            Stage::Wait => "wait",
            Stage::Detect => "detect",
            Stage::Embed => "embed",
            Stage::Link => "link",
            Stage::Track => "track",
        }
    }
}

/// Every metric of the service.
pub struct Metrics {
    registry: Registry,
    frames_in: IntCounterVec,
    frames_tracked: IntCounterVec,
    frames_dropped: IntCounterVec,
    reconnects: IntCounterVec,
    failures: IntCounterVec,
    up: IntGaugeVec,
    tracks: IntGaugeVec,
    latency: HistogramVec,
    capture_latency: HistogramVec,
    stage: HistogramVec,
    queue: IntGaugeVec,
    batch_size: HistogramVec,
    model_run: HistogramVec,
    model_wait: HistogramVec,
    model_failures: IntCounterVec,
    provider: IntGaugeVec,
    line_crossings: IntCounterVec,
    zone_occupancy: IntGaugeVec,
    zone_entries: IntCounterVec,
    zone_exits: IntCounterVec,
    zone_dwell: HistogramVec,
    events: IntCounterVec,
}

/// One camera's handles, so that the per-frame path looks nothing up.
pub struct CameraMetrics {
    /// Frames that left the decoder (damaged ones too).
    pub frames_in: IntCounter,
    /// Frames that were tracked and published.
    pub tracked: IntCounter,
    /// Frames that were not, by [`DropReason`].
    pub dropped: [IntCounter; 5],
    /// Connections made again after the first.
    pub reconnects: IntCounter,
    /// 1 while frames arrive.
    pub up: IntGauge,
    /// Live tracks by [`TrackState`].
    pub tracks: [IntGauge; 3],
    /// From the decoder to the hub.
    pub latency: Histogram,
    /// From capture to the hub, by the frame's own clock.
    pub capture_latency: Histogram,
}

/// One zone's handles.
pub struct ZoneMetrics {
    /// Tracks in it now.
    pub occupancy: IntGauge,
    /// Tracks that came in.
    pub entries: IntCounter,
    /// Tracks that left or ended in it.
    pub exits: IntCounter,
    /// How long they were there.
    pub dwell: Histogram,
}

const LATENCY_BUCKETS: [f64; 14] =
    [0.001, 0.0025, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2, 0.5, 1.0, 2.5, 10.0];
const STAGE_BUCKETS: [f64; 14] =
    [0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0];

const DWELL_BUCKETS: [f64; 12] = [1.0, 2.5, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0];

impl Metrics {
    /// Registers every metric, and the process's own, in a new registry.
    pub fn new() -> prometheus::Result<Arc<Self>> {
        let registry = Registry::new();
        registry.register(Box::new(prometheus::process_collector::ProcessCollector::for_self()))?;
        let counter = |name: &str, help: &str, labels: &[&str]| -> prometheus::Result<IntCounterVec> {
            let vec = IntCounterVec::new(Opts::new(name, help), labels)?;
            registry.register(Box::new(vec.clone()))?;
            Ok(vec)
        };
        let gauge = |name: &str, help: &str, labels: &[&str]| -> prometheus::Result<IntGaugeVec> {
            let vec = IntGaugeVec::new(Opts::new(name, help), labels)?;
            registry.register(Box::new(vec.clone()))?;
            Ok(vec)
        };
        let histogram =
            |name: &str, help: &str, labels: &[&str], buckets: &[f64]| -> prometheus::Result<HistogramVec> {
                let opts = HistogramOpts::new(name, help).buckets(buckets.to_vec());
                let vec = HistogramVec::new(opts, labels)?;
                registry.register(Box::new(vec.clone()))?;
                Ok(vec)
            };
        let metrics = Self {
            frames_in: counter("gakp_frames_in_total", "Frames that left the decoder.", &["camera"])?,
            frames_tracked: counter(
                "gakp_frames_tracked_total",
                "Frames tracked and published.",
                &["camera"],
            )?,
            frames_dropped: counter(
                "gakp_frames_dropped_total",
                "Frames that were not tracked, by reason.",
                &["camera", "reason"],
            )?,
            reconnects: counter("gakp_camera_reconnects_total", "Connections after the first.", &["camera"])?,
            failures: counter(
                "gakp_camera_failures_total",
                "Connections refused or lost, by kind.",
                &["camera", "kind"],
            )?,
            up: gauge("gakp_camera_up", "1 while the camera's frames arrive.", &["camera"])?,
            tracks: gauge("gakp_tracks", "Live tracks by state.", &["camera", "state"])?,
            latency: histogram(
                "gakp_decode_to_publish_seconds",
                "From the decoded frame to its published tracks.",
                &["camera"],
                &LATENCY_BUCKETS,
            )?,
            capture_latency: histogram(
                "gakp_capture_to_publish_seconds",
                "From capture, by the clock that the frame names, to its published tracks.",
                &["camera"],
                &LATENCY_BUCKETS,
            )?,
            stage: histogram(
                "gakp_stage_seconds",
                "Time of a frame in a stage.",
                &["stage"],
                &STAGE_BUCKETS,
            )?,
            queue: gauge("gakp_queue_depth", "Entries waiting in a queue.", &["queue"])?,
            batch_size: histogram(
                "gakp_batch_size",
                "Items that a model took at once.",
                &["model"],
                &[1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0],
            )?,
            model_run: histogram(
                "gakp_model_run_seconds",
                "A batch in a model, pre- and post-processing included.",
                &["model"],
                &STAGE_BUCKETS,
            )?,
            model_wait: histogram(
                "gakp_model_wait_seconds",
                "A job waiting for its model.",
                &["model"],
                &STAGE_BUCKETS,
            )?,
            model_failures: counter("gakp_model_failures_total", "Batches that failed.", &["model"])?,
            provider: gauge(
                "gakp_execution_provider",
                "1 for the execution provider in use.",
                &["provider"],
            )?,
            line_crossings: counter(
                "gakp_line_crossings_total",
                "Tracks that crossed a line, by direction.",
                &["camera", "line", "direction"],
            )?,
            zone_occupancy: gauge("gakp_zone_occupancy", "Tracks in a zone now.", &["camera", "zone"])?,
            zone_entries: counter(
                "gakp_zone_entries_total",
                "Tracks that came into a zone.",
                &["camera", "zone"],
            )?,
            zone_exits: counter(
                "gakp_zone_exits_total",
                "Tracks that left a zone or ended in it.",
                &["camera", "zone"],
            )?,
            zone_dwell: histogram(
                "gakp_zone_dwell_seconds",
                "How long those who left a zone were in it.",
                &["camera", "zone"],
                &DWELL_BUCKETS,
            )?,
            events: counter(
                "gakp_events_total",
                "What happened at lines and in zones, by kind.",
                &["camera", "kind"],
            )?,
            registry,
        };
        Ok(Arc::new(metrics))
    }

    /// The registry that `/metrics` shows.
    pub fn registry(&self) -> &Registry {
        &self.registry
    }

    /// The handles of one camera. Its series appear at once, at zero.
    pub fn camera(&self, id: &CameraId) -> Arc<CameraMetrics> {
        let id = id.as_str();
        let label = [id];
        Arc::new(CameraMetrics {
            frames_in: self.frames_in.with_label_values(&label),
            tracked: self.frames_tracked.with_label_values(&label),
            dropped: DropReason::ALL.map(|r| self.frames_dropped.with_label_values(&[id, r.as_str()])),
            reconnects: self.reconnects.with_label_values(&label),
            up: self.up.with_label_values(&label),
            tracks: TrackState::ALL.map(|s| self.tracks.with_label_values(&[id, s.as_str()])),
            latency: self.latency.with_label_values(&label),
            capture_latency: self.capture_latency.with_label_values(&label),
        })
    }

    /// Counts a refused or lost connection. `kind` is from a closed set: no input makes a label.
    pub fn camera_failed(&self, id: &CameraId, kind: &str) {
        self.failures.with_label_values(&[id.as_str(), kind]).inc();
    }

    /// A paused camera is neither up nor down.
    pub fn pause_camera(&self, id: &CameraId) {
        let _ = self.up.remove_label_values(&[id.as_str()]);
    }

    /// Takes a removed camera's series away.
    pub fn forget_camera(&self, id: &CameraId) {
        let id = id.as_str();
        let by_camera = std::collections::HashMap::from([("camera", id)]);
        // A series that never appeared is not there to remove: both outcomes are fine.
        for vec in [&self.frames_in, &self.frames_tracked, &self.reconnects] {
            let _ = vec.remove(&by_camera);
        }
        let _ = self.up.remove(&by_camera);
        let _ = self.latency.remove(&by_camera);
        let _ = self.capture_latency.remove(&by_camera);
        for reason in DropReason::ALL {
            let _ = self.frames_dropped.remove_label_values(&[id, reason.as_str()]);
        }
        for state in TrackState::ALL {
            let _ = self.tracks.remove_label_values(&[id, state.as_str()]);
        }
        for kind in crate::publish::EVENT_KINDS {
            let _ = self.events.remove_label_values(&[id, kind]);
        }
        for kind in crate::ingest::Failure::LABELS {
            let _ = self.failures.remove_label_values(&[id, kind]);
        }
    }

    /// Lets a line's series appear, at zero.
    pub fn line(&self, camera: &CameraId, line: &RuleId) {
        for direction in [Direction::In, Direction::Out] {
            self.crossings(camera, line, direction);
        }
    }

    /// Crossings of a line in one direction.
    pub fn crossings(&self, camera: &CameraId, line: &RuleId, direction: Direction) -> IntCounter {
        self.line_crossings.with_label_values(&[camera.as_str(), line.as_str(), direction.as_str()])
    }

    /// Takes a removed line's series away.
    pub fn forget_line(&self, camera: &CameraId, line: &RuleId) {
        for direction in [Direction::In, Direction::Out] {
            let labels = [camera.as_str(), line.as_str(), direction.as_str()];
            let _ = self.line_crossings.remove_label_values(&labels);
        }
    }

    /// The handles of a zone. Its series appear at once, at zero.
    pub fn zone(&self, camera: &CameraId, zone: &RuleId) -> ZoneMetrics {
        let labels = [camera.as_str(), zone.as_str()];
        ZoneMetrics {
            occupancy: self.zone_occupancy.with_label_values(&labels),
            entries: self.zone_entries.with_label_values(&labels),
            exits: self.zone_exits.with_label_values(&labels),
            dwell: self.zone_dwell.with_label_values(&labels),
        }
    }

    /// Takes a removed zone's series away.
    pub fn forget_zone(&self, camera: &CameraId, zone: &RuleId) {
        let labels = [camera.as_str(), zone.as_str()];
        let _ = self.zone_occupancy.remove_label_values(&labels);
        let _ = self.zone_entries.remove_label_values(&labels);
        let _ = self.zone_exits.remove_label_values(&labels);
        let _ = self.zone_dwell.remove_label_values(&labels);
    }

    /// Counts something that happened; `kind` is one of [`crate::publish::EVENT_KINDS`].
    pub fn event(&self, camera: &CameraId, kind: &str) {
        self.events.with_label_values(&[camera.as_str(), kind]).inc();
    }

    /// The time of one frame in one stage.
    pub fn stage(&self, stage: Stage) -> Histogram {
        self.stage.with_label_values(&[stage.as_str()])
    }

    /// The depth of a named queue.
    pub fn queue(&self, name: &str) -> IntGauge {
        self.queue.with_label_values(&[name])
    }

    /// States which provider runs the models.
    pub fn provider(&self, provider: &str) {
        self.provider.with_label_values(&[provider]).set(1);
    }
}

impl Observer for Metrics {
    fn batch(&self, stats: &BatchStats<'_>) {
        self.batch_size.with_label_values(&[stats.model]).observe(stats.items as f64);
        self.model_run.with_label_values(&[stats.model]).observe(stats.run.as_secs_f64());
        let wait = self.model_wait.with_label_values(&[stats.model]);
        stats.waits.iter().map(Duration::as_secs_f64).for_each(|s| wait.observe(s));
        if stats.failed {
            self.model_failures.with_label_values(&[stats.model]).inc();
        }
    }
}
