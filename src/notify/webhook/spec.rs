//! Webhooks that are added while the service runs: what is asked for, and the file that remembers it.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Deserializer, Serialize};

use crate::notify::config::{WebhookOptions, WebhookPlan};
use crate::outgoing::{Reach, Secret, reveal, reveal_some};
use crate::private;
use crate::types::is_name;

/// Most events that wait for a webhook that was added at run time.
const MAX_QUEUE: usize = 10_000;

/// The body of `POST /v1/webhooks`. Unknown fields are refused. Serialized with its secrets: for the state folder alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WebhookSpec {
    /// What it is called in the API, logs and metrics.
    pub name: String,
    /// Where events are posted; may hold a login or a token.
    #[serde(serialize_with = "reveal")]
    pub url: Secret,
    /// `whsec_` and the base64 of 24 to 64 bytes: posts are signed with it.
    #[serde(default, serialize_with = "reveal_some", skip_serializing_if = "Option::is_none")]
    pub secret: Option<Secret>,
    /// Only events of these cameras; of all where there are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<String>,
    /// Only events of these types; of all where there are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub types: Vec<String>,
    /// How long a post may take, seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout_s: Option<f64>,
    /// How long an event is tried, seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub give_up_after_s: Option<f64>,
    /// Most events that wait.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub queue: Option<usize>,
}

impl WebhookSpec {
    /// Checks it.
    ///
    /// # Errors
    /// What is wrong, in words; no secret is quoted.
    pub(crate) fn plan(&self, reach: Reach) -> Result<WebhookPlan, String> {
        if let Some(queue) = self.queue.filter(|queue| *queue > MAX_QUEUE) {
            return Err(format!("queue = {queue}: must be from 1 to {MAX_QUEUE}"));
        }
        let options = WebhookOptions {
            name: Some(self.name.clone()),
            url: self.url.clone(),
            secret: self.secret.clone(),
            secret_file: None,
            cameras: self.cameras.clone(),
            types: self.types.clone(),
            timeout_s: self.timeout_s,
            give_up_after_s: self.give_up_after_s,
            queue: self.queue,
            ca_file: None,
        };
        let mut plan = options.check(self.name.clone(), Path::new(""))?;
        plan.address.reach = reach;
        Ok(plan)
    }
}

/// The body of `PATCH /v1/webhooks/{name}`: what is to change; `null` goes back to the default. Unknown fields are
/// refused.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WebhookPatch {
    /// Another URL.
    #[serde(default, deserialize_with = "given")]
    pub url: Option<Secret>,
    /// Another secret, or none.
    #[serde(default, deserialize_with = "given")]
    pub secret: Option<Option<Secret>>,
    /// Other cameras.
    #[serde(default, deserialize_with = "given")]
    pub cameras: Option<Vec<String>>,
    /// Other types.
    #[serde(default, deserialize_with = "given")]
    pub types: Option<Vec<String>>,
    /// How long a post may take, seconds.
    #[serde(default, deserialize_with = "given")]
    pub timeout_s: Option<Option<f64>>,
    /// How long an event is tried, seconds.
    #[serde(default, deserialize_with = "given")]
    pub give_up_after_s: Option<Option<f64>>,
    /// Most events that wait.
    #[serde(default, deserialize_with = "given")]
    pub queue: Option<Option<usize>>,
}

/// Tells `null` from absent.
fn given<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

impl WebhookPatch {
    /// `spec` with the changes.
    pub fn apply(self, spec: &WebhookSpec) -> WebhookSpec {
        WebhookSpec {
            name: spec.name.clone(),
            url: self.url.unwrap_or_else(|| spec.url.clone()),
            secret: self.secret.unwrap_or_else(|| spec.secret.clone()),
            cameras: self.cameras.unwrap_or_else(|| spec.cameras.clone()),
            types: self.types.unwrap_or_else(|| spec.types.clone()),
            timeout_s: self.timeout_s.unwrap_or(spec.timeout_s),
            give_up_after_s: self.give_up_after_s.unwrap_or(spec.give_up_after_s),
            queue: self.queue.unwrap_or(spec.queue),
        }
    }
}

/// A webhook as the file has it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Kept {
    /// Whether it may lead to this machine: an admin named its URL.
    pub anywhere: bool,
    pub webhook: WebhookSpec,
}

impl Kept {
    pub fn plan(&self) -> Result<WebhookPlan, String> {
        self.webhook.plan(if self.anywhere { Reach::Anywhere } else { Reach::Network })
    }
}

/// A file `webhooks.json` in the state folder. It holds secrets, so only its owner may read it.
#[derive(Clone, Debug)]
pub(crate) struct WebhookFile(PathBuf);

/// What the file holds.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Contents {
    webhooks: Vec<Kept>,
}

impl Contents {
    /// Each is known by its name, so that has to be one.
    fn parse(text: &str) -> Result<Self, String> {
        let contents: Self = serde_json::from_str(text).map_err(|error| error.to_string())?;
        let mut names = BTreeSet::new();
        for Kept { webhook: WebhookSpec { name, .. }, .. } in &contents.webhooks {
            if !is_name(name) {
                return Err(format!("the name {name:?} is not usable"));
            }
            if !names.insert(name) {
                return Err(format!("the name {name:?} is there twice"));
            }
        }
        Ok(contents)
    }
}

impl WebhookFile {
    /// Reads what the folder remembers; one that is not there yet remembers nothing.
    ///
    /// # Errors
    /// It cannot be read, or is not what was written; in words.
    pub fn open(folder: &Path) -> Result<(Self, Vec<Kept>), String> {
        let file = Self(folder.join("webhooks.json"));
        let contents: Contents = match fs::read_to_string(&file.0) {
            Ok(text) => Contents::parse(&text).map_err(|reason| {
                let path = file.0.display();
                format!(
                    "{path} is damaged ({reason}): mend it or move it away; the webhooks in it are lost otherwise"
                )
            })?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => Contents::default(),
            Err(reason) => return Err(format!("cannot read {}: {reason}", file.0.display())),
        };
        Ok((file, contents.webhooks))
    }

    /// Writes all of them; a crash leaves either the old or the new.
    ///
    /// # Errors
    /// It cannot be written; the old one is as it was.
    pub fn save(&self, webhooks: Vec<Kept>) -> Result<(), String> {
        private::write_json(&self.0, &Contents { webhooks })
            .map_err(|reason| format!("cannot write {}: {reason}", self.0.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(json: &str) -> Result<WebhookSpec, String> {
        serde_json::from_str(json).map_err(|error| error.to_string())
    }

    #[test]
    fn what_is_saved_comes_back_and_damage_is_told_without_secrets() {
        let folder = tempfile::tempdir().unwrap();
        let (file, none) = WebhookFile::open(folder.path()).unwrap();
        assert_eq!(none, []);
        let webhook = spec(r#"{"name": "alarm", "url": "https://u:hunter2@h/T0KEN", "queue": 7}"#).unwrap();
        let kept = vec![Kept { anywhere: false, webhook }];
        file.save(kept.clone()).unwrap();
        assert_eq!(WebhookFile::open(folder.path()).unwrap().1, kept);
        assert!(!format!("{kept:?}").contains("hunter2"));
        assert_eq!(kept[0].plan().unwrap().address.reach, Reach::Network);
        let hook = |name: &str, url: &str| {
            format!(r#"{{"anywhere": true, "webhook": {{"name": "{name}", "url": {url}}}}}"#)
        };
        let twice = format!("{0}, {0}", hook("a", r#""http://u:hunter2@h""#));
        for (webhooks, says) in [
            (hook("a", "4711"), "must be a text"),
            (hook("a/b", r#""http://h""#), "\"a/b\" is not usable"),
            (twice, "\"a\" is there twice"),
        ] {
            fs::write(folder.path().join("webhooks.json"), format!(r#"{{"webhooks": [{webhooks}]}}"#))
                .unwrap();
            let error = WebhookFile::open(folder.path()).unwrap_err();
            assert!(error.contains("damaged") && error.contains(says), "{error}");
            assert!(!error.contains("4711") && !error.contains("hunter2"), "{error}");
        }
    }

    #[test]
    fn a_patch_changes_what_it_names() {
        let before = spec(
            r#"{"name": "a", "url": "http://h", "secret": "whsec_x", "types": ["line.crossed"], "queue": 7}"#,
        );
        let before = before.unwrap();
        let patch = |json: &str| serde_json::from_str::<WebhookPatch>(json).unwrap().apply(&before);
        assert_eq!(patch("{}"), before);
        assert_eq!(
            patch(r#"{"secret": null, "queue": null}"#),
            WebhookSpec { secret: None, queue: None, ..before.clone() }
        );
        let changed = patch(r#"{"url": "http://i", "types": [], "timeout_s": 2}"#);
        let expected =
            WebhookSpec { url: "http://i".into(), types: vec![], timeout_s: Some(2.0), ..before.clone() };
        assert_eq!(changed, expected);
        for wrong in [r#"{"url": null}"#, r#"{"types": null}"#, r#"{"name": "b"}"#] {
            assert!(serde_json::from_str::<WebhookPatch>(wrong).is_err(), "{wrong}");
        }
    }
}
