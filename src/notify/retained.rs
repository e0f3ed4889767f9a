//! What the broker keeps for whoever comes later: the newest counts and states, and Home Assistant's entities.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use serde::Serialize;

use super::home_assistant::Discovery;
use crate::analytics::{LineCount, ZoneCount};
use crate::api::{CameraState, CameraStatus, Cameras};
use crate::types::{CameraId, is_name};

/// Topics that the broker may claim to keep: more than a service has, and a bound to what a broker can make us remember.
const MOST_TOPICS: usize = 50_000;

/// What is retained under a topic now.
pub(super) type Retained = BTreeMap<String, Bytes>;

/// The names of topics.
#[derive(Clone, Debug)]
pub(super) struct Topics {
    prefix: String,
}

#[derive(Serialize)]
struct LineMessage {
    r#in: u64,
    out: u64,
}

#[derive(Serialize)]
struct ZoneMessage {
    occupancy: u32,
    entries: u64,
    exits: u64,
    crowded: bool,
}

#[derive(Serialize)]
struct StateMessage<'a> {
    state: &'static str,
    camera_state: CameraState,
    reason: Option<&'a str>,
    kind: Option<&'a str>,
}

impl Topics {
    pub fn new(prefix: String) -> Self {
        Self { prefix }
    }

    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Whether the service is there.
    pub fn status(&self) -> String {
        format!("{}/status", self.prefix)
    }

    /// Where a state or counts are told.
    pub fn of(&self, subject: Subject) -> String {
        match subject {
            Subject::Camera(camera) => format!("{}/{camera}/state", self.prefix),
            Subject::Line(camera, line) => format!("{}/{camera}/line/{line}", self.prefix),
            Subject::Zone(camera, zone) => format!("{}/{camera}/zone/{zone}", self.prefix),
        }
    }

    pub fn event(&self, camera: &CameraId) -> String {
        format!("{}/{camera}/event", self.prefix)
    }

    pub fn tracks(&self, camera: &CameraId) -> String {
        format!("{}/{camera}/tracks", self.prefix)
    }

    pub fn onvif(&self, camera: &CameraId) -> String {
        format!("{}/onvif-mj/VideoAnalytics/{camera}/gakp", self.prefix)
    }

    /// What finds everything that an earlier run may have left retained.
    pub fn leftovers(&self) -> [String; 3] {
        ["state", "line/+", "zone/+"].map(|rest| format!("{}/+/{rest}", self.prefix))
    }

    /// What a topic of [`Topics::leftovers`] is about.
    pub fn subject<'a>(&self, topic: &'a str) -> Option<Subject<'a>> {
        let rest = topic.strip_prefix(&self.prefix)?.strip_prefix('/')?;
        let levels: Vec<_> = rest.split('/').collect();
        match levels[..] {
            [camera, "state"] if is_name(camera) => Some(Subject::Camera(camera)),
            [camera, "line", line] if is_name(camera) && is_name(line) => Some(Subject::Line(camera, line)),
            [camera, "zone", zone] if is_name(camera) && is_name(zone) => Some(Subject::Zone(camera, zone)),
            _ => None,
        }
    }
}

/// What a retained topic is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Subject<'a> {
    /// A camera's state.
    Camera(&'a str),
    /// A camera's line.
    Line(&'a str, &'a str),
    /// A camera's zone.
    Zone(&'a str, &'a str),
}

fn json(message: &impl Serialize) -> Bytes {
    // Structs of numbers and texts always serialise.
    serde_json::to_vec(message).unwrap_or_default().into()
}

fn line_message(count: &LineCount) -> Bytes {
    json(&LineMessage { r#in: count.inwards, out: count.outwards })
}

fn zone_message(count: &ZoneCount) -> Bytes {
    let ZoneCount { occupancy, entries, exits, crowded, .. } = *count;
    json(&ZoneMessage { occupancy, entries, exits, crowded })
}

fn state_message(camera: &CameraStatus) -> Bytes {
    let live = camera.state == CameraState::Live;
    // A reason stays after recovery; it is none for being up.
    let reason = |text: &'_ Option<String>| if live { None } else { text.clone() };
    let (reason, kind) = (reason(&camera.last_error), reason(&camera.last_error_kind));
    json(&StateMessage {
        state: if live { "up" } else { "down" },
        camera_state: camera.state,
        reason: reason.as_deref(),
        kind: kind.as_deref(),
    })
}

/// Tells what is to be retained now.
pub(super) struct Snapshots {
    cameras: Arc<dyn Cameras>,
    topics: Topics,
    discovery: Option<Discovery>,
    /// Home Assistant's entities, by the topic that they are about: they do not change.
    entities: BTreeMap<String, Vec<(String, Bytes)>>,
}

impl Snapshots {
    pub fn new(cameras: Arc<dyn Cameras>, topics: Topics, discovery: Option<Discovery>) -> Self {
        Self { cameras, topics, discovery, entities: BTreeMap::new() }
    }

    /// Everything that is to be retained now.
    pub fn take(&mut self) -> Retained {
        let mut retained = Retained::new();
        for camera in self.cameras.list() {
            let id = camera.id.as_str();
            self.add(&mut retained, Subject::Camera(id), state_message(&camera));
            let Some(findings) = self.cameras.findings(&camera.id) else { continue };
            for (line, count) in &findings.counts.lines {
                self.add(&mut retained, Subject::Line(id, line.as_str()), line_message(count));
            }
            for (zone, count) in &findings.counts.zones {
                self.add(&mut retained, Subject::Zone(id, zone.as_str()), zone_message(count));
            }
        }
        self.entities.retain(|topic, _| retained.contains_key(topic));
        retained
    }

    fn add(&mut self, retained: &mut Retained, subject: Subject, message: Bytes) {
        let topic = self.topics.of(subject);
        if let Some(discovery) = &self.discovery {
            let entities = self
                .entities
                .entry(topic.clone())
                .or_insert_with(|| discovery.entities(&self.topics, subject));
            retained.extend(entities.iter().cloned());
        }
        retained.insert(topic, message);
    }
}

/// What the broker is believed to keep.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    sent: BTreeMap<String, Sent>,
}

#[derive(Debug)]
struct Sent {
    /// Not known where the connection was lost meanwhile.
    message: Option<Bytes>,
    at: Instant,
}

impl Ledger {
    /// Nothing is sure any more: everything is sent again, and what is gone is taken back again.
    pub fn doubt(&mut self) {
        self.sent.values_mut().for_each(|sent| sent.message = None);
    }

    /// That the broker may keep something there.
    pub fn suspect(&mut self, topic: String, every: Duration) {
        if self.sent.len() >= MOST_TOPICS {
            return;
        }
        let at = Instant::now().checked_sub(every).unwrap_or_else(Instant::now);
        self.sent.entry(topic).or_insert(Sent { message: None, at });
    }

    /// What is to be sent so that the broker keeps `now`: an empty message takes a topic back. What waits longest
    /// is first; what was sent less than `every` ago waits.
    pub fn due(&self, now: &Retained, every: Duration) -> Vec<(String, Bytes)> {
        let mut due: Vec<(Option<Instant>, &String, Bytes)> = vec![];
        for topic in self.sent.keys().filter(|topic| !now.contains_key(*topic)) {
            due.push((None, topic, Bytes::new()));
        }
        for (topic, message) in now {
            match self.sent.get(topic) {
                Some(sent) if sent.message.as_ref() == Some(message) => {}
                Some(sent) if sent.message.is_some() && sent.at.elapsed() < every => {}
                Some(sent) => due.push((Some(sent.at), topic, message.clone())),
                None => due.push((None, topic, message.clone())),
            }
        }
        due.sort_by_key(|(at, ..)| *at);
        due.into_iter().map(|(_, topic, message)| (topic.clone(), message)).collect()
    }

    /// That a message of [`Ledger::due`] is on its way.
    pub fn sent(&mut self, topic: String, message: Bytes) {
        if message.is_empty() {
            self.sent.remove(&topic);
        } else {
            self.sent.insert(topic, Sent { message: Some(message), at: Instant::now() });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EVERY: Duration = Duration::from_secs(3600);

    fn retained(of: &[(&str, &str)]) -> Retained {
        of.iter().map(|(topic, text)| ((*topic).to_owned(), Bytes::from((*text).to_owned()))).collect()
    }

    fn send(ledger: &mut Ledger, now: &Retained, every: Duration) -> Vec<(String, String)> {
        let due = ledger.due(now, every);
        due.iter().for_each(|(topic, message)| ledger.sent(topic.clone(), message.clone()));
        due.into_iter().map(|(t, m)| (t, String::from_utf8(m.to_vec()).unwrap())).collect()
    }

    #[test]
    fn what_changed_is_sent_at_its_rate_and_what_is_gone_is_taken_back() {
        let mut ledger = Ledger::default();
        let first = retained(&[("a", "1"), ("b", "1")]);
        assert_eq!(send(&mut ledger, &first, EVERY).len(), 2);
        assert_eq!(send(&mut ledger, &first, EVERY), []);
        let later = retained(&[("a", "2"), ("b", "1")]);
        assert_eq!(send(&mut ledger, &later, EVERY), [], "too soon");
        assert_eq!(send(&mut ledger, &later, Duration::ZERO), [("a".into(), "2".into())]);
        let fewer = retained(&[("a", "2")]);
        assert_eq!(send(&mut ledger, &fewer, EVERY), [("b".into(), String::new())], "at once");
        ledger.doubt();
        assert_eq!(send(&mut ledger, &fewer, EVERY), [("a".into(), "2".into())], "all of it, at once");
        ledger.suspect("c".into(), EVERY);
        assert_eq!(send(&mut ledger, &fewer, EVERY), [("c".into(), String::new())]);
    }

    #[test]
    fn topics_tell_what_they_are_about() {
        let topics = Topics::new("site/gakp".into());
        for subject in [Subject::Camera("a"), Subject::Line("a", "b"), Subject::Zone("a", "b")] {
            assert_eq!(topics.subject(&topics.of(subject)), Some(subject));
        }
        for topic in
            ["site/gakp/status", "site/gakp/a/b/c", "gakp/a/state", "site/gakp//state", "site/gakp/a b/state"]
        {
            assert_eq!(topics.subject(topic), None, "{topic}");
        }
    }
}
