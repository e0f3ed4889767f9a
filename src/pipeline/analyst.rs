//! One camera's lines, zones and masks in the service: fed by the tracker's thread, changed and read by the API.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use jiff::Timestamp;
use tokio::sync::watch;

use crate::analytics::{Analyst, Counts, Happening, Heat, Mask, Rules, What};
use crate::publish::{EventHub, Masks, event_kind};
use crate::telemetry::Metrics;
use crate::types::{CameraId, FrameTracks};

/// Watches one camera's tracks for as long as the camera runs. Whoever reads it holds it for as long as a copy
/// of its counts takes: the tracker's thread waits for no more than that.
pub struct CameraAnalyst {
    camera: CameraId,
    since: Timestamp,
    analyst: Mutex<Analyst>,
    masks: watch::Sender<Arc<[Mask]>>,
    metrics: Arc<Metrics>,
    events: EventHub,
}

impl CameraAnalyst {
    /// Watches `rules` on `camera`.
    pub fn new(camera: CameraId, rules: Rules, metrics: Arc<Metrics>, events: EventHub) -> Self {
        let since = Timestamp::now();
        let masks = watch::Sender::default();
        let this = Self { camera, since, analyst: Mutex::default(), masks, metrics, events };
        this.set_rules(rules);
        this
    }

    /// Takes the next frame's tracks: counts, measures, tells.
    pub fn take(&self, report: &FrameTracks) {
        let mut analyst = self.analyst();
        let happened = analyst.update(report);
        if happened.is_empty() {
            return;
        }
        // Still under the lock: nobody takes a rule away in between.
        for happening in &happened {
            self.measure(happening);
        }
        self.show_occupancy(&analyst);
        drop(analyst);
        for happening in &happened {
            self.events.publish(report, happening);
        }
    }

    fn show_occupancy(&self, analyst: &Analyst) {
        for (zone, count) in analyst.counts().zones {
            self.metrics.zone(&self.camera, &zone).occupancy.set(i64::from(count.occupancy));
        }
    }

    fn measure(&self, Happening { what, .. }: &Happening) {
        self.metrics.event(&self.camera, event_kind(what));
        match what {
            What::Crossed { line, direction } => self.metrics.crossings(&self.camera, line, *direction).inc(),
            What::Entered { zone } => self.metrics.zone(&self.camera, zone).entries.inc(),
            What::Left { zone, dwell } => {
                let zone = self.metrics.zone(&self.camera, zone);
                zone.exits.inc();
                zone.dwell.observe(*dwell);
            }
            What::Loitering { .. } | What::Crowded { .. } | What::Cleared { .. } => {}
        }
    }

    /// The camera's tracks begin anew.
    pub fn begin_epoch(&self) {
        let mut analyst = self.analyst();
        analyst.begin_epoch();
        self.show_occupancy(&analyst);
    }

    /// What is hidden of the camera's pictures, now and whenever that changes.
    pub fn masks(&self) -> Masks {
        Masks::follow(&self.masks)
    }

    /// Watches and hides by other rules from now on; they have been checked.
    pub fn set_rules(&self, rules: Rules) {
        self.masks.send_replace(rules.masks.as_slice().into());
        self.watch(rules);
    }

    /// The camera goes. What was hidden of its last picture stays hidden.
    pub fn end(&self) {
        self.watch(Rules::default());
    }

    fn watch(&self, rules: Rules) {
        let mut analyst = self.analyst();
        let before = analyst.rules();
        let lines: BTreeSet<_> = rules.lines.iter().map(|l| &l.id).collect();
        let zones: BTreeSet<_> = rules.zones.iter().map(|z| &z.id).collect();
        for line in before.lines.iter().filter(|l| !lines.contains(&l.id)) {
            self.metrics.forget_line(&self.camera, &line.id);
        }
        for zone in before.zones.iter().filter(|z| !zones.contains(&z.id)) {
            self.metrics.forget_zone(&self.camera, &zone.id);
        }
        for line in lines {
            self.metrics.line(&self.camera, line);
        }
        for zone in zones {
            self.metrics.zone(&self.camera, zone);
        }
        analyst.set_rules(rules);
        self.show_occupancy(&analyst);
    }

    /// What is watched and hidden.
    pub fn rules(&self) -> Rules {
        self.analyst().rules().clone()
    }

    /// What was counted.
    pub fn counts(&self) -> Counts {
        self.analyst().counts()
    }

    /// Where people were.
    pub fn heat(&self) -> Heat {
        self.analyst().heat().clone()
    }

    /// Since when it has watched.
    pub fn since(&self) -> Timestamp {
        self.since
    }

    fn analyst(&self) -> MutexGuard<'_, Analyst> {
        self.analyst.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
