//! Home Assistant's MQTT discovery: an entity for each camera's connection, line and zone, a device for each camera.

use bytes::Bytes;
use serde::Serialize;

use super::retained::{Subject, Topics};

/// Where Home Assistant looks for entities.
#[derive(Clone, Debug)]
pub(super) struct Discovery {
    prefix: String,
}

#[derive(Serialize)]
struct Entity {
    name: String,
    unique_id: String,
    state_topic: String,
    value_template: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    state_class: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    device_class: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    icon: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload_on: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload_off: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    entity_category: Option<&'static str>,
    json_attributes_topic: String,
    availability_topic: String,
    device: Device,
    origin: Origin,
}

#[derive(Serialize)]
struct Device {
    identifiers: [String; 1],
    name: String,
    manufacturer: &'static str,
    model: &'static str,
}

#[derive(Serialize)]
struct Origin {
    name: &'static str,
    sw_version: &'static str,
}

/// The part of an entity that is its own.
struct Kind {
    component: &'static str,
    /// Its place below the camera.
    object: String,
    name: String,
    value_template: &'static str,
    state_class: Option<&'static str>,
    icon: &'static str,
}

impl Discovery {
    pub fn new(prefix: String) -> Self {
        Self { prefix }
    }

    /// Where Home Assistant says that it has started.
    pub fn birth(&self) -> String {
        format!("{}/status", self.prefix)
    }

    /// Whether a topic is one of an entity.
    pub fn owns(&self, topic: &str) -> bool {
        topic.strip_prefix(&self.prefix).is_some_and(|rest| rest.starts_with('/'))
    }

    /// The configuration topics of what a topic is about, and what is retained there.
    pub fn entities(&self, topics: &Topics, subject: Subject) -> Vec<(String, Bytes)> {
        let (Subject::Camera(camera) | Subject::Line(camera, _) | Subject::Zone(camera, _)) = subject;
        let state_topic = topics.of(subject);
        let device = format!("{}/{camera}", topics.prefix());
        kinds(subject)
            .into_iter()
            .map(|kind| {
                let connectivity = kind.component == "binary_sensor";
                let entity = Entity {
                    name: kind.name,
                    unique_id: format!("{device}/{}", kind.object),
                    state_topic: state_topic.clone(),
                    value_template: kind.value_template,
                    state_class: kind.state_class,
                    device_class: connectivity.then_some("connectivity"),
                    icon: (!connectivity).then_some(kind.icon),
                    payload_on: connectivity.then_some("up"),
                    payload_off: connectivity.then_some("down"),
                    entity_category: connectivity.then_some("diagnostic"),
                    json_attributes_topic: state_topic.clone(),
                    availability_topic: topics.status(),
                    device: Device {
                        identifiers: [device.clone()],
                        name: camera.to_owned(),
                        manufacturer: "gakp",
                        model: "Camera",
                    },
                    origin: Origin { name: "gakp", sw_version: env!("CARGO_PKG_VERSION") },
                };
                let (node, object) = (level(&device), level(&kind.object));
                let topic = format!("{}/{}/{node}/{object}/config", self.prefix, kind.component);
                // A struct of texts always serialises.
                (topic, serde_json::to_vec(&entity).unwrap_or_default().into())
            })
            .collect()
    }
}

fn kinds(subject: Subject) -> Vec<Kind> {
    let sensor = |object: String, name, value_template, state_class, icon| Kind {
        component: "sensor",
        object,
        name,
        value_template,
        state_class: Some(state_class),
        icon,
    };
    match subject {
        Subject::Camera(_) => vec![Kind {
            component: "binary_sensor",
            object: "state".into(),
            name: "Connection".into(),
            value_template: "{{ value_json.state }}",
            state_class: None,
            icon: "",
        }],
        Subject::Line(_, line) => {
            let side = |way: &str, value_template, icon| {
                let object = format!("line/{line}/{way}");
                sensor(object, format!("{line} {way}"), value_template, "total_increasing", icon)
            };
            vec![
                side("in", "{{ value_json.in }}", "mdi:location-enter"),
                side("out", "{{ value_json.out }}", "mdi:location-exit"),
            ]
        }
        Subject::Zone(_, zone) => {
            let object = format!("zone/{zone}/occupancy");
            let name = format!("{zone} occupancy");
            vec![sensor(object, name, "{{ value_json.occupancy }}", "measurement", "mdi:account-group")]
        }
    }
}

/// A name as one level of a discovery topic, which takes `A-Z a-z 0-9 _ -` alone. Different names stay different.
fn level(name: &str) -> String {
    let mut level = String::with_capacity(name.len());
    for c in name.chars() {
        match c {
            '_' => level.push_str("__"),
            '.' => level.push_str("_d"),
            '/' => level.push_str("_s"),
            other => level.push(other),
        }
    }
    level
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    #[test]
    fn a_line_is_two_sensors_of_its_cameras_device() {
        let (topics, discovery) = (Topics::new("gakp".into()), Discovery::new("homeassistant".into()));
        let entities = discovery.entities(&topics, Subject::Line("gate.1", "door_a"));
        let (topic, config) = &entities[0];
        assert_eq!(topic, "homeassistant/sensor/gakp_sgate_d1/line_sdoor__a_sin/config");
        let config: Value = serde_json::from_slice(config).unwrap();
        let expected = json!({
            "name": "door_a in",
            "unique_id": "gakp/gate.1/line/door_a/in",
            "state_topic": "gakp/gate.1/line/door_a",
            "value_template": "{{ value_json.in }}",
            "state_class": "total_increasing",
            "icon": "mdi:location-enter",
            "json_attributes_topic": "gakp/gate.1/line/door_a",
            "availability_topic": "gakp/status",
            "device": {"identifiers": ["gakp/gate.1"], "name": "gate.1", "manufacturer": "gakp", "model": "Camera"},
            "origin": {"name": "gakp", "sw_version": env!("CARGO_PKG_VERSION")},
        });
        assert_eq!(config, expected);
        assert!(entities[1].0.ends_with("_sout/config") && entities.len() == 2);
        assert!(entities.iter().all(|(topic, _)| discovery.owns(topic)));
        assert!(!discovery.owns("homeassistants/x") && !discovery.owns("gakp/status"));
    }

    #[test]
    fn different_names_have_different_topics() {
        let names = ["a.b", "a_b", "a_db", "a__b", "a/b", "a_sb", "a-b"];
        let levels: std::collections::BTreeSet<_> = names.iter().map(|name| level(name)).collect();
        assert_eq!(levels.len(), names.len(), "{levels:?}");
    }
}
