//! What happens, told to other systems: webhooks and MQTT.
//!
//! ```text
//! EventHub --listen--> [queue of webhook A] --POST--> A          (one task to collect, one to deliver)
//! EventHub, Hub, Cameras --> [queue of events] [latest of the rest] --MQTT--> broker
//! ```
//!
//! A sink is a listener like any client: it reads what the hubs hand out and what [`Cameras`] tells, and nobody
//! waits for it. Each has a bounded queue of its own. What does not fit, or cannot be delivered in time, is counted
//! and logged. docs/api.md has the formats, docs/operating.md the settings.

mod broker;
mod cloud_event;
mod config;
mod home_assistant;
mod mqtt;
mod onvif;
mod queue;
mod retained;
mod webhook;

use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use prometheus::Registry;
use tokio::sync::{Mutex, watch};
use tokio::time::timeout;

pub use config::{MqttOptions, MqttPlan, NotifyError, WebhookOptions, WebhookPlan};
pub use webhook::{
    RememberedWebhooks, WebhookError, WebhookPatch, WebhookSettings, WebhookSource, WebhookSpec,
    WebhookStatus, WebhookTrial, Webhooks,
};

use crate::api::Cameras;
use crate::publish::{EventHub, Hub};
use broker::Broker;

/// How long what is pending has once the service stops.
const GRACE: Duration = Duration::from_secs(1);

/// What is told to whom, checked.
#[derive(Debug, Default)]
pub struct NotifyPlan {
    /// Each webhook of the configuration.
    pub webhooks: Vec<WebhookPlan>,
    /// Those that were added at run time.
    pub remembered: RememberedWebhooks,
    /// The broker, where there is one.
    pub mqtt: Option<MqttPlan>,
}

impl NotifyPlan {
    /// With the webhooks that were added at run time and are `remembered`.
    ///
    /// # Errors
    /// The configuration has one of the same name.
    pub fn and(self, remembered: RememberedWebhooks) -> Result<Self, WebhookError> {
        if let Some(plan) = self.webhooks.iter().find(|plan| remembered.has(&plan.name)) {
            return Err(WebhookError::Invalid {
                name: plan.name.clone(),
                what: "one of this name was added at run time: give that of the configuration another name"
                    .into(),
            });
        }
        Ok(Self { remembered, ..self })
    }

    /// Tries whether all of them can be reached, at the same time: for each its name, where it is, and what is wrong.
    /// Nothing is posted or published.
    pub async fn knock(&self) -> Vec<(String, String, Result<(), String>)> {
        let configured = self.webhooks.iter().map(|plan| (&*plan.name, Ok(plan)));
        let webhooks = configured.chain(self.remembered.plans()).map(|(name, plan)| async move {
            let (address, found) = match plan {
                Ok(plan) => (plan.address.to_string(), plan.address.knock(plan.tls.as_ref()).await),
                Err(why) => ("webhooks.json".to_owned(), Err(why.to_owned())),
            };
            (format!("webhook {name}"), address, found)
        });
        let broker = self.mqtt.iter().map(|plan| async move {
            ("MQTT".to_owned(), plan.address.to_string(), mqtt::knock(plan).await)
        });
        let (mut found, broker) = tokio::join!(join_all(webhooks), join_all(broker));
        found.extend(broker);
        found
    }
}

/// What became of a configuration that was read again.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Reconfigured {
    /// Webhooks that were started, changed or removed.
    pub webhooks: Vec<String>,
    /// Whether the broker is another, or told otherwise.
    pub mqtt: bool,
    /// What could not be done.
    pub failed: Vec<String>,
}

/// The running sinks.
pub struct Notifier {
    stop: watch::Sender<bool>,
    webhooks: Webhooks,
    broker: Mutex<Broker>,
}

/// Tells a sink that the service stops.
#[derive(Clone)]
struct Stop(watch::Receiver<bool>);

impl Stop {
    /// Resolves once the service stops. Cancel safe.
    async fn stopped(&mut self) {
        // An error means that the notifier itself is gone: that is stopping too.
        let _ = self.0.wait_for(|stopping| *stopping).await;
    }

    fn is_stopping(&self) -> bool {
        *self.0.borrow() || self.0.has_changed().is_err()
    }
}

impl Notifier {
    /// Starts every sink. Their figures appear in `registry`.
    ///
    /// # Errors
    /// The figures were registered before.
    pub async fn start(
        plan: NotifyPlan,
        cameras: &Arc<dyn Cameras>,
        hub: &Hub,
        events: &EventHub,
        registry: &Registry,
    ) -> prometheus::Result<Self> {
        let (stop, stopped) = watch::channel(false);
        let NotifyPlan { webhooks, remembered, mqtt } = plan;
        let webhooks = Webhooks::start(webhooks, remembered, events, registry, Stop(stopped))?;
        let mut broker = Broker::new(cameras, hub, events, registry);
        broker.configure(mqtt).await?;
        Ok(Self { stop, webhooks, broker: Mutex::new(broker) })
    }

    /// The webhooks.
    pub fn webhooks(&self) -> Webhooks {
        self.webhooks.clone()
    }

    /// Goes by what the configuration has now; what was added at run time stays.
    pub async fn configure(&self, plan: NotifyPlan) -> Reconfigured {
        let (webhooks, mut failed) = self.webhooks.configure(plan.webhooks).await;
        let mqtt = self.broker.lock().await.configure(plan.mqtt).await.unwrap_or_else(|error| {
            failed.push(format!("mqtt: {error}"));
            false
        });
        Reconfigured { webhooks, mqtt, failed }
    }

    /// Lets every sink deliver what is pending, for a moment; what is left then is counted and logged.
    pub async fn stop(&self) {
        self.stop.send_replace(true);
        let mut broker = self.broker.lock().await;
        let ended = async { tokio::join!(self.webhooks.ended(), broker.stop()) };
        if timeout(GRACE + Duration::from_millis(500), ended).await.is_err() {
            tracing::warn!("webhooks or MQTT did not end in time");
        }
    }
}
