//! The history's figures.

use prometheus::{IntCounter, IntGauge, Registry};

/// The history's figures; clones are the same.
#[derive(Clone, Debug)]
pub struct HistoryMetrics {
    /// Rows written.
    pub written: IntCounter,
    /// Rows lost: the database was away for too long, or refused them.
    pub dropped: IntCounter,
    /// Reports of tracks that were not recorded because the collector lagged.
    pub missed_reports: IntCounter,
    /// Events likewise.
    pub missed_events: IntCounter,
    /// Writes that failed; they are tried again.
    pub failures: IntCounter,
    /// Rows that wait.
    pub pending: IntGauge,
    /// Bytes that rows take.
    pub bytes: IntGauge,
    /// Whether the last write went well.
    pub up: IntGauge,
}

impl HistoryMetrics {
    /// Registers them.
    ///
    /// # Errors
    /// A name is taken: they were registered before.
    pub fn new(registry: &Registry) -> prometheus::Result<Self> {
        let counter = |name: &str, help: &str| -> prometheus::Result<IntCounter> {
            let counter = IntCounter::new(name, help)?;
            registry.register(Box::new(counter.clone()))?;
            Ok(counter)
        };
        let gauge = |name: &str, help: &str| -> prometheus::Result<IntGauge> {
            let gauge = IntGauge::new(name, help)?;
            registry.register(Box::new(gauge.clone()))?;
            Ok(gauge)
        };
        Ok(Self {
            written: counter("gakp_history_rows_written_total", "Rows written to the history.")?,
            dropped: counter(
                "gakp_history_rows_dropped_total",
                "Rows of the history lost: its database was away for too long, or refused them.",
            )?,
            missed_reports: counter(
                "gakp_history_reports_missed_total",
                "Reports of tracks that the history did not record because it lagged.",
            )?,
            missed_events: counter(
                "gakp_history_events_missed_total",
                "Events that the history did not record because it lagged.",
            )?,
            failures: counter(
                "gakp_history_failures_total",
                "Writes of the history that failed and were tried again.",
            )?,
            pending: gauge("gakp_history_pending_rows", "Rows that wait for the history's database.")?,
            bytes: gauge("gakp_history_bytes", "Bytes that the history's rows take.")?,
            up: gauge("gakp_history_up", "Whether the last write of the history went well.")?,
        })
    }
}
