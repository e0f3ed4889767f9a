//! What happened at lines and in zones, to whoever listens: numbered, encoded once, kept for a while.
//!
//! A listener that reads too slowly loses the oldest events and is told how many; nobody waits for it.

use std::collections::{BTreeSet, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use jiff::Timestamp;
use serde::Serialize;
use tokio::sync::broadcast;

use super::json::{CaptureTs, encode, round};
use super::report::class_name;
use crate::analytics::{Happening, What};
use crate::types::{CameraId, Epoch, FrameTracks};

/// Events that a listener may lag behind.
const LAG: usize = 1024;
/// Events that are kept for those who ask later.
const KEPT: usize = 1000;

/// What can happen, by its name on the wire.
pub const EVENT_KINDS: [&str; 6] =
    ["line.crossed", "zone.entered", "zone.left", "zone.loitering", "zone.crowded", "zone.cleared"];

/// Something that happened, as it is told.
#[derive(Debug)]
pub struct NumberedEvent {
    /// Unique, also across restarts.
    pub id: String,
    /// One of [`EVENT_KINDS`].
    pub kind: &'static str,
    /// Where.
    pub camera: CameraId,
    /// Generation of the camera's track ids.
    pub epoch: Epoch,
    /// When the frame was captured, nanoseconds since 1970.
    pub unix_ns: i64,
    /// What, and who.
    pub happening: Happening,
    /// The JSON message (docs/api.md).
    pub json: Bytes,
}

/// What a listener receives.
#[derive(Clone, Debug)]
pub enum Heard {
    /// The next event.
    Event(Arc<NumberedEvent>),
    /// So many were lost because it read too slowly; events of all cameras and kinds count.
    Missed(u64),
}

/// Which events somebody wants. Empty sets mean all.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EventFilter {
    /// Of these cameras.
    pub cameras: BTreeSet<CameraId>,
    /// Of these kinds.
    pub kinds: BTreeSet<&'static str>,
}

impl EventFilter {
    /// Whether it is one of those.
    pub fn wants(&self, event: &NumberedEvent) -> bool {
        (self.cameras.is_empty() || self.cameras.contains(&event.camera))
            && (self.kinds.is_empty() || self.kinds.contains(event.kind))
    }
}

/// Hands every event to every listener. Cheap to clone; clones are the same.
#[derive(Clone, Debug)]
pub struct EventHub(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    classes: Arc<[String]>,
    listeners: broadcast::Sender<Arc<NumberedEvent>>,
    recent: Mutex<VecDeque<Arc<NumberedEvent>>>,
    /// Milliseconds since 1970 when the service began: the first part of every id. A service that crashes at once and is
    /// started again does so within a second.
    run: i64,
    next: AtomicU64,
}

#[derive(Serialize)]
struct Message<'a> {
    id: &'a str,
    #[serde(rename = "type")]
    kind: &'static str,
    camera: &'a str,
    epoch: u64,
    frame: u64,
    time: CaptureTs,
    clock: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    track: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    class: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    line: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    direction: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    zone: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dwell_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    occupancy: Option<u32>,
    place: [f64; 2],
}

/// The name of what happened on the wire.
pub fn event_kind(what: &What) -> &'static str {
    match what {
        What::Crossed { .. } => EVENT_KINDS[0],
        What::Entered { .. } => EVENT_KINDS[1],
        What::Left { .. } => EVENT_KINDS[2],
        What::Loitering { .. } => EVENT_KINDS[3],
        What::Crowded { .. } => EVENT_KINDS[4],
        What::Cleared { .. } => EVENT_KINDS[5],
    }
}

impl EventHub {
    /// A hub whose events name classes by `classes` (index = class).
    pub fn new(classes: Arc<[String]>) -> Self {
        Self(Arc::new(Shared {
            classes,
            listeners: broadcast::channel(LAG).0,
            recent: Mutex::default(),
            run: Timestamp::now().as_millisecond(),
            next: 1.into(),
        }))
    }

    /// Tells what happened in a frame. Never waits.
    pub fn publish(&self, report: &FrameTracks, happening: &Happening) {
        let shared = &*self.0;
        let id = format!("{}-{}", shared.run, shared.next.fetch_add(1, Ordering::Relaxed));
        let kind = event_kind(&happening.what);
        let json = message(&id, kind, report, happening, &shared.classes);
        let event = Arc::new(NumberedEvent {
            id,
            kind,
            camera: report.camera.clone(),
            epoch: report.epoch,
            unix_ns: report.capture.unix_ns,
            happening: happening.clone(),
            json,
        });
        let mut recent = self.recent_events();
        if recent.len() == KEPT {
            recent.pop_front();
        }
        recent.push_back(event.clone());
        drop(recent);
        // Nobody listening is fine.
        let _ = shared.listeners.send(event);
    }

    /// A listener to what happens from now on.
    pub fn listen(&self, filter: EventFilter) -> EventListener {
        EventListener { filter, events: self.0.listeners.subscribe() }
    }

    /// The newest events, the newest first; at most `limit`, and no more than 1,000 are kept.
    pub fn recent(&self, filter: &EventFilter, limit: usize) -> Vec<Arc<NumberedEvent>> {
        self.recent_events().iter().rev().filter(|event| filter.wants(event)).take(limit).cloned().collect()
    }

    fn recent_events(&self) -> MutexGuard<'_, VecDeque<Arc<NumberedEvent>>> {
        self.0.recent.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// One listener's end.
pub struct EventListener {
    filter: EventFilter,
    events: broadcast::Receiver<Arc<NumberedEvent>>,
}

impl EventListener {
    /// The next event that it wants; `None` when the hub is gone. Cancel safe.
    pub async fn next(&mut self) -> Option<Heard> {
        loop {
            match self.events.recv().await {
                Ok(event) if self.filter.wants(&event) => return Some(Heard::Event(event)),
                Ok(_) => {}
                Err(broadcast::error::RecvError::Lagged(missed)) => return Some(Heard::Missed(missed)),
                Err(broadcast::error::RecvError::Closed) => return None,
            }
        }
    }

    /// The next event that it wants, if there is one by now. Unlike [`EventListener::next`] it is no part of the
    /// cooperation between tasks, which ends a loop over what is there after a hundred.
    pub fn try_next(&mut self) -> Option<Heard> {
        loop {
            match self.events.try_recv() {
                Ok(event) if self.filter.wants(&event) => return Some(Heard::Event(event)),
                Ok(_) => {}
                Err(broadcast::error::TryRecvError::Lagged(missed)) => return Some(Heard::Missed(missed)),
                Err(broadcast::error::TryRecvError::Empty | broadcast::error::TryRecvError::Closed) => {
                    return None;
                }
            }
        }
    }
}

fn message(
    id: &str,
    kind: &'static str,
    report: &FrameTracks,
    happening: &Happening,
    classes: &[String],
) -> Bytes {
    let Happening { track, place, what } = happening;
    let class = track.map(|(_, class)| class_name(classes, class));
    let mut message = Message {
        id,
        kind,
        camera: report.camera.as_str(),
        epoch: report.epoch.0,
        frame: report.frame,
        time: CaptureTs(report.capture.unix_ns),
        clock: report.capture.clock.as_str(),
        track: track.map(|(id, _)| id.0),
        class: class.as_deref(),
        line: None,
        direction: None,
        zone: None,
        dwell_s: None,
        occupancy: None,
        place: [place.x, place.y].map(|v| round(v, 10_000.0)),
    };
    let dwell = |seconds: f64| Some(round(seconds, 1000.0));
    match what {
        What::Crossed { line, direction } => {
            (message.line, message.direction) = (Some(line.as_str()), Some(direction.as_str()));
        }
        What::Entered { zone } => message.zone = Some(zone.as_str()),
        What::Left { zone, dwell: s } | What::Loitering { zone, dwell: s } => {
            (message.zone, message.dwell_s) = (Some(zone.as_str()), dwell(*s));
        }
        What::Crowded { zone, occupancy } | What::Cleared { zone, occupancy } => {
            (message.zone, message.occupancy) = (Some(zone.as_str()), Some(*occupancy));
        }
    }
    encode(&message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::analytics::{Direction, Point, RuleId};
    use crate::publish::report::tests::example;
    use crate::types::{ClassId, TrackId};

    fn crossing() -> Happening {
        Happening {
            track: Some((TrackId(3), ClassId(0))),
            place: Point { x: 0.512_345, y: 1.0 },
            what: What::Crossed { line: RuleId::new("door").unwrap(), direction: Direction::In },
        }
    }

    #[test]
    fn an_event_is_exactly_this() {
        let (report, classes) = example();
        let expected = concat!(
            r#"{"id":"1-1","type":"line.crossed","camera":"gate","epoch":2,"frame":9,"#,
            r#""time":"2026-01-02T03:04:05.000000006Z","clock":"rtcp","track":3,"class":"person","#,
            r#""line":"door","direction":"in","place":[0.5123,1.0]}"#,
        );
        let json = message("1-1", "line.crossed", &report, &crossing(), &classes);
        assert_eq!(std::str::from_utf8(&json).unwrap(), expected);
    }

    #[test]
    fn two_runs_of_the_same_second_number_their_events_differently() {
        let (report, classes) = example();
        let ids: Vec<_> = (0..2)
            .map(|_| {
                std::thread::sleep(std::time::Duration::from_millis(2));
                let hub = EventHub::new(classes.clone().into());
                hub.publish(&report, &crossing());
                hub.recent(&EventFilter::default(), 1)[0].id.clone()
            })
            .collect();
        assert_ne!(ids[0], ids[1]);
    }

    #[tokio::test]
    async fn a_listener_hears_what_it_wants_and_what_it_missed() {
        let (report, classes) = example();
        let hub = EventHub::new(classes.into());
        let mut all = hub.listen(EventFilter::default());
        let kinds = ["zone.left"].into();
        let mut none = hub.listen(EventFilter { kinds, ..EventFilter::default() });
        for _ in 0..LAG + 5 {
            hub.publish(&report, &crossing());
        }
        assert!(matches!(all.next().await, Some(Heard::Missed(5))));
        let Some(Heard::Event(event)) = all.next().await else { panic!("an event") };
        assert!(event.id.ends_with("-6"), "{}", event.id);
        let recent = hub.recent(&EventFilter::default(), 2);
        assert!(recent.len() == 2 && recent[0].id.ends_with(&format!("-{}", LAG + 5)));
        assert_eq!(hub.recent(&EventFilter::default(), usize::MAX).len(), KEPT);
        drop(hub);
        assert!(matches!(none.next().await, Some(Heard::Missed(_))));
        assert!(none.next().await.is_none());
    }
}
