//! `[[webhook]]` and `[mqtt]` of the configuration, and what they come to once checked.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;
use tokio_rustls::TlsConnector;

use crate::outgoing::{Address, HTTP, Login, Scheme, Secret, trust};
use crate::publish::{EVENT_KINDS, EventFilter};
use crate::types::{CameraId, is_name};

const MQTT: [Scheme; 2] =
    [Scheme { name: "mqtt", tls: false, port: 1883 }, Scheme { name: "mqtts", tls: true, port: 8883 }];

/// How long a post of a webhook may take unless it says otherwise, seconds.
pub(super) const WEBHOOK_TIMEOUT_S: f64 = 10.0;
/// How long an event is tried unless its webhook says otherwise, seconds.
pub(super) const WEBHOOK_GIVE_UP_AFTER_S: f64 = 3600.0;
/// Most events that wait for a webhook unless it says otherwise.
pub(super) const WEBHOOK_QUEUE: usize = 1000;
/// What stands before the base64 of a webhook's secret.
const SECRET_PREFIX: &str = "whsec_";

/// `[[webhook]]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WebhookOptions {
    /// What it is called in logs and metrics; `webhook-1` and so on by default.
    pub name: Option<String>,
    /// Where events are posted; may hold a login or a token.
    pub url: Secret,
    /// `whsec_` and the base64 of 24 to 64 bytes: posts are signed with it.
    pub secret: Option<Secret>,
    /// A file with the secret.
    pub secret_file: Option<PathBuf>,
    /// Only events of these cameras.
    #[serde(default)]
    pub cameras: Vec<String>,
    /// Only events of these types.
    #[serde(default)]
    pub types: Vec<String>,
    /// How long a post may take, seconds.
    pub timeout_s: Option<f64>,
    /// How long an event is tried, seconds.
    pub give_up_after_s: Option<f64>,
    /// Most events that wait.
    pub queue: Option<usize>,
    /// Certificates to trust instead of the system's, PEM.
    pub ca_file: Option<PathBuf>,
}

/// `[mqtt]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MqttOptions {
    /// `mqtt://host:port` or `mqtts://host:port`.
    pub url: Secret,
    /// User.
    pub user: Option<String>,
    /// Password.
    pub password: Option<Secret>,
    /// A file with the password.
    pub password_file: Option<PathBuf>,
    /// What every topic begins with.
    pub topic: Option<String>,
    /// What Home Assistant's discovery topics begin with; empty: no discovery.
    pub discovery: Option<String>,
    /// How often counts and states are sent at most, a topic and second.
    pub max_rate: Option<f64>,
    /// Whether tracks are sent.
    #[serde(default)]
    pub tracks: bool,
    /// How often tracks and ONVIF frames are sent at most, a camera and second.
    pub tracks_rate: Option<f64>,
    /// Whether ONVIF's frames are sent.
    #[serde(default)]
    pub onvif: bool,
    /// Certificates to trust instead of the system's, PEM.
    pub ca_file: Option<PathBuf>,
}

/// What is wrong with `[[webhook]]` or `[mqtt]`; never quotes a secret.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {what}")]
pub struct NotifyError {
    place: String,
    what: String,
}

/// A webhook, checked.
#[derive(Clone)]
pub struct WebhookPlan {
    pub(super) name: String,
    /// Whether the name was given; otherwise it is its place among the others.
    pub(super) named: bool,
    pub(super) address: Address,
    pub(super) key: Option<ring::hmac::Key>,
    pub(super) filter: EventFilter,
    pub(super) timeout: Duration,
    pub(super) give_up: Duration,
    pub(super) queue: usize,
    pub(super) tls: Option<TlsConnector>,
    /// What `key` and `tls` were made of.
    made_of: (Option<Secret>, Option<Vec<u8>>),
}

impl WebhookPlan {
    /// Whether it comes to the same as another of its name.
    pub(super) fn is_like(&self, other: &Self) -> bool {
        (&self.address, &self.filter, &self.made_of) == (&other.address, &other.filter, &other.made_of)
            && (self.timeout, self.give_up, self.queue) == (other.timeout, other.give_up, other.queue)
    }
}

impl fmt::Debug for WebhookPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "WebhookPlan({} to {})", self.name, self.address)
    }
}

/// The broker and what it is told, checked.
#[derive(Clone)]
pub struct MqttPlan {
    pub(super) address: Address,
    pub(super) login: Option<Login>,
    pub(super) topic: String,
    pub(super) discovery: Option<String>,
    pub(super) every: Duration,
    pub(super) tracks: bool,
    pub(super) onvif: bool,
    pub(super) tracks_every: Duration,
    pub(super) tls: Option<TlsConnector>,
    /// What `tls` was made of.
    trusted: Option<Vec<u8>>,
}

impl MqttPlan {
    /// Whether it comes to the same as another.
    pub(super) fn is_like(&self, other: &Self) -> bool {
        (&self.address, &self.login, &self.topic, &self.discovery, &self.trusted)
            == (&other.address, &other.login, &other.topic, &other.discovery, &other.trusted)
            && (self.every, self.tracks_every) == (other.every, other.tracks_every)
            && (self.tracks, self.onvif) == (other.tracks, other.onvif)
    }
}

impl fmt::Debug for MqttPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "MqttPlan({} to {})", self.topic, self.address)
    }
}

/// The first line of a file that holds a secret.
fn read_secret(key: &str, file: &Path) -> Result<String, String> {
    let text = fs::read_to_string(file);
    let text = text.map_err(|e| format!("cannot read {key} {}: {e}", file.display()))?;
    let line = text.lines().next().unwrap_or_default().trim().to_owned();
    if line.is_empty() { Err(format!("{key} {} is empty", file.display())) } else { Ok(line) }
}

/// The secret itself or that of the file.
fn secret_of(key: &str, given: Option<Secret>, file: Option<&Path>) -> Result<Option<String>, String> {
    match (given, file) {
        (Some(_), Some(_)) => Err(format!("{key} and {key}_file are both given: one is enough")),
        (Some(secret), None) => Ok(Some(secret.text().to_owned())),
        (None, Some(file)) => read_secret(&format!("{key}_file"), file).map(Some),
        (None, None) => Ok(None),
    }
}

fn seconds(key: &str, value: Option<f64>, default: f64, most: f64) -> Result<Duration, String> {
    let value = value.unwrap_or(default);
    if value > 0.0 && value <= most {
        Ok(Duration::from_secs_f64(value))
    } else {
        Err(format!("{key} = {value}: must be more than 0 and at most {most}"))
    }
}

/// The time between two messages at a rate.
fn interval(key: &str, rate: Option<f64>, default: f64) -> Result<Duration, String> {
    let rate = rate.unwrap_or(default);
    if (0.01..=30.0).contains(&rate) {
        Ok(Duration::from_secs_f64(1.0 / rate))
    } else {
        Err(format!("{key} = {rate}: must be from 0.01 to 30 a second"))
    }
}

/// The bytes of a webhook's secret.
fn signing_key(text: &str) -> Result<ring::hmac::Key, String> {
    let bytes = text.strip_prefix(SECRET_PREFIX).and_then(|text| STANDARD.decode(text).ok());
    match bytes {
        Some(bytes) if (24..=64).contains(&bytes.len()) => {
            Ok(ring::hmac::Key::new(ring::hmac::HMAC_SHA256, &bytes))
        }
        _ => Err("its secret must be whsec_ and the base64 of 24 to 64 bytes: \
                  echo whsec_$(openssl rand -base64 32)"
            .into()),
    }
}

/// A prefix of topics: levels of `A-Z a-z 0-9 . _ -`.
fn prefix(key: &str, text: String) -> Result<String, String> {
    if text.len() <= 128 && text.split('/').all(is_name) {
        Ok(text)
    } else {
        Err(format!(
            "{key} = {text:?}: must be names of A-Z a-z 0-9 . _ - with / between them, the first sign of each a \
             letter or digit"
        ))
    }
}

impl WebhookOptions {
    /// Checks all of them, reads what files hold secrets.
    ///
    /// # Errors
    /// [`NotifyError`] names the webhook and the setting.
    pub fn check_all(options: Vec<Self>, folder: &Path) -> Result<Vec<WebhookPlan>, NotifyError> {
        let mut plans: Vec<WebhookPlan> = vec![];
        for (index, options) in options.into_iter().enumerate() {
            let name = options.name.clone().unwrap_or_else(|| format!("webhook-{}", index + 1));
            let place = format!("webhook {name:?}");
            let plan = if plans.iter().any(|plan| plan.name == name) {
                Err("another webhook has this name: names must differ".to_owned())
            } else {
                options.check(name, folder)
            };
            plans.push(plan.map_err(|what| NotifyError { place, what })?);
        }
        Ok(plans)
    }

    /// Checks it. The error says what is wrong and quotes no secret.
    pub(super) fn check(self, name: String, folder: &Path) -> Result<WebhookPlan, String> {
        if !is_name(&name) {
            return Err("its name is not usable: use 1 to 64 of A-Z a-z 0-9 . _ -".into());
        }
        let address = Address::parse(self.url.text(), &HTTP).map_err(|e| format!("its url {e}"))?;
        let file = self.secret_file.map(|file| folder.join(file));
        let secret = secret_of("secret", self.secret, file.as_deref())?;
        let key = secret.as_deref().map(signing_key).transpose()?;
        let mut filter = EventFilter::default();
        for camera in &self.cameras {
            filter.cameras.insert(CameraId::new(camera).map_err(|e| e.to_string())?);
        }
        for given in &self.types {
            let kind = EVENT_KINDS.into_iter().find(|kind| kind == given);
            filter
                .kinds
                .insert(kind.ok_or_else(|| format!("type {given:?} is none of {}", EVENT_KINDS.join(", ")))?);
        }
        let queue = self.queue.unwrap_or(WEBHOOK_QUEUE);
        if !(1..=100_000).contains(&queue) {
            return Err(format!("queue = {queue}: must be from 1 to 100000"));
        }
        let ca_file = self.ca_file.map(|file| folder.join(file));
        Ok(WebhookPlan {
            name,
            named: self.name.is_some(),
            made_of: (
                secret.as_deref().map(Secret::from),
                ca_file.as_deref().and_then(|file| fs::read(file).ok()),
            ),
            tls: address.tls.then(|| trust(ca_file.as_deref())).transpose()?,
            address,
            key,
            filter,
            timeout: seconds("timeout_s", self.timeout_s, WEBHOOK_TIMEOUT_S, 300.0)?,
            give_up: seconds(
                "give_up_after_s",
                self.give_up_after_s,
                WEBHOOK_GIVE_UP_AFTER_S,
                7.0 * 86400.0,
            )?,
            queue,
        })
    }
}

impl MqttOptions {
    /// Checks it, reads the file that holds the password.
    ///
    /// # Errors
    /// [`NotifyError`] names the setting.
    pub fn check(self, folder: &Path) -> Result<MqttPlan, NotifyError> {
        self.checked(folder).map_err(|what| NotifyError { place: "mqtt".into(), what })
    }

    fn checked(self, folder: &Path) -> Result<MqttPlan, String> {
        let mut address = Address::parse(self.url.text(), &MQTT).map_err(|e| format!("its url {e}"))?;
        if !address.path.trim_matches('/').is_empty() {
            return Err("its url has a path: write the prefix of the topics as topic = \"...\"".into());
        }
        let file = self.password_file.map(|file| folder.join(file));
        let password = secret_of("password", self.password, file.as_deref())?;
        let login = match (self.user, password) {
            (Some(user), password) => Some(Login { user, password: password.unwrap_or_default() }),
            (None, Some(_)) => return Err("there is a password but no user".into()),
            (None, None) => address.login.take(),
        };
        let discovery = self.discovery.unwrap_or_else(|| "homeassistant".into());
        let ca_file = self.ca_file.map(|file| folder.join(file));
        Ok(MqttPlan {
            trusted: ca_file.as_deref().and_then(|file| fs::read(file).ok()),
            tls: address.tls.then(|| trust(ca_file.as_deref())).transpose()?,
            address,
            login,
            topic: prefix("topic", self.topic.unwrap_or_else(|| "gakp".into()))?,
            discovery: if discovery.is_empty() { None } else { Some(prefix("discovery", discovery)?) },
            every: interval("max_rate", self.max_rate, 1.0)?,
            tracks: self.tracks,
            onvif: self.onvif,
            tracks_every: interval("tracks_rate", self.tracks_rate, 5.0)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn webhook(text: &str) -> Result<WebhookPlan, String> {
        let options = toml::from_str(text).map_err(|e: toml::de::Error| e.message().to_owned())?;
        let plans = WebhookOptions::check_all(vec![options], Path::new("")).map_err(|e| e.to_string())?;
        Ok(plans.into_iter().next().unwrap())
    }

    fn mqtt(text: &str) -> Result<MqttPlan, String> {
        let options: MqttOptions =
            toml::from_str(text).map_err(|e: toml::de::Error| e.message().to_owned())?;
        options.check(Path::new("")).map_err(|e| e.to_string())
    }

    #[test]
    fn what_is_left_out_has_a_default() {
        let plan = webhook("url = \"http://h/x\"").unwrap();
        assert_eq!((plan.name.as_str(), plan.queue, plan.key.is_none()), ("webhook-1", 1000, true));
        let plan = mqtt("url = \"mqtt://h\"").unwrap();
        assert_eq!((plan.topic.as_str(), plan.discovery.as_deref()), ("gakp", Some("homeassistant")));
        assert_eq!((plan.address.port, plan.every, plan.tracks), (1883, Duration::from_secs(1), false));
        assert_eq!(mqtt("url = \"mqtt://h\"\ndiscovery = \"\"").unwrap().discovery, None);
    }

    #[test]
    fn mistakes_are_named_and_no_secret_is_quoted() {
        for (text, expected) in [
            ("url = \"ftp://u:hunter2@h/\"", "http:// or https://"),
            ("url = 4711", "must be a text in quotes"),
            ("url = \"http://h\"\nsecret = \"hunter2\"", "openssl rand"),
            ("url = \"http://h\"\nsecret = \"whsec_aHVudGVyMg==\"", "24 to 64 bytes"),
            ("url = \"http://h\"\nsecret_file = \"/no/such\"", "secret_file /no/such"),
            ("url = \"http://h\"\ntypes = [\"line.crosed\"]", "is none of line.crossed"),
            ("url = \"http://h\"\ncameras = [\"a b\"]", "not usable"),
            ("url = \"http://h\"\ntimeout_s = 0", "timeout_s"),
            ("url = \"http://h\"\nqueue = 0", "queue = 0"),
            ("url = \"http://h\"\nname = \"a/b\"", "name"),
        ] {
            let error = webhook(text).unwrap_err();
            assert!(error.contains(expected) && !error.contains("hunter2"), "{text}: {error}");
            assert!(!error.contains("4711"), "{error}");
        }
        for (text, expected) in [
            ("url = \"http://h\"", "mqtt:// or mqtts://"),
            ("url = \"mqtt://h/topic\"", "path"),
            ("url = \"mqtt://h\"\npassword = 4711", "must be a text in quotes"),
            ("url = \"mqtt://h\"\npassword = \"hunter2\"", "no user"),
            (
                "url = \"mqtt://h\"\nuser = \"u\"\npassword = \"hunter2\"\npassword_file = \"f\"",
                "one is enough",
            ),
            ("url = \"mqtt://h\"\ntopic = \"a/#\"", "topic"),
            ("url = \"mqtt://h\"\nmax_rate = 0", "max_rate"),
        ] {
            let error = mqtt(text).unwrap_err();
            assert!(error.contains(expected) && !error.contains("hunter2"), "{text}: {error}");
            assert!(!error.contains("4711"), "{error}");
        }
    }
}
