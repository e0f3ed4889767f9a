//! What is told of a webhook.

use serde::Serialize;

use super::spec::WebhookSpec;
use crate::notify::config::{WEBHOOK_GIVE_UP_AFTER_S, WEBHOOK_QUEUE, WEBHOOK_TIMEOUT_S, WebhookPlan};
use crate::outgoing::{Address, HTTP};

/// Who said that there is a webhook.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum WebhookSource {
    /// The configuration: changed there, and read again.
    Configuration,
    /// The API.
    Api,
}

/// A webhook and how it fares.
#[derive(Clone, Debug, Serialize)]
pub struct WebhookStatus {
    /// Its name.
    pub name: String,
    /// Who said that there is one.
    pub source: WebhookSource,
    /// What it goes by.
    #[serde(flatten)]
    pub settings: WebhookSettings,
    /// Events that were delivered.
    pub delivered: u64,
    /// Events that were lost, for whatever reason: those pending at the end as well, and what came too fast to be read,
    /// wanted or not.
    pub failed: u64,
    /// Events that wait.
    pub pending: usize,
    /// What last went wrong; stays after recovery.
    pub last_error: Option<String>,
    /// When that was, RFC 3339.
    pub last_error_time: Option<String>,
}

/// What a webhook goes by, without its secrets.
#[derive(Clone, Debug, Serialize)]
pub struct WebhookSettings {
    /// Where it posts to: scheme, host and port.
    pub url: String,
    /// Whether posts are signed.
    pub signed: bool,
    /// Only events of these cameras; of all where there are none.
    pub cameras: Vec<String>,
    /// Only events of these types; of all where there are none.
    pub types: Vec<String>,
    /// How long a post may take, seconds.
    pub timeout_s: f64,
    /// How long an event is tried, seconds.
    pub give_up_after_s: f64,
    /// Most events that wait.
    pub queue: usize,
}

impl From<&WebhookPlan> for WebhookSettings {
    fn from(plan: &WebhookPlan) -> Self {
        Self {
            url: plan.address.to_string(),
            signed: plan.key.is_some(),
            cameras: plan.filter.cameras.iter().map(ToString::to_string).collect(),
            types: plan.filter.kinds.iter().map(ToString::to_string).collect(),
            timeout_s: plan.timeout.as_secs_f64(),
            give_up_after_s: plan.give_up.as_secs_f64(),
            queue: plan.queue,
        }
    }
}

/// As it was asked for, of one that may not be usable.
impl From<&WebhookSpec> for WebhookSettings {
    fn from(spec: &WebhookSpec) -> Self {
        let address = Address::parse(spec.url.text(), &HTTP);
        Self {
            url: address.map_or(String::new(), |address| address.to_string()),
            signed: spec.secret.is_some(),
            cameras: spec.cameras.clone(),
            types: spec.types.clone(),
            timeout_s: spec.timeout_s.unwrap_or(WEBHOOK_TIMEOUT_S),
            give_up_after_s: spec.give_up_after_s.unwrap_or(WEBHOOK_GIVE_UP_AFTER_S),
            queue: spec.queue.unwrap_or(WEBHOOK_QUEUE),
        }
    }
}

/// What came of a post that only tried whether the receiver takes posts.
#[derive(Clone, Debug, Serialize)]
pub struct WebhookTrial {
    /// Whether it was answered with 2xx.
    pub delivered: bool,
    /// Its answer's status, where it was delivered.
    pub status: Option<u16>,
    /// What went wrong.
    pub error: Option<String>,
    /// How long it took, milliseconds.
    pub took_ms: f64,
}
