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

use prometheus::Registry;
use tokio::sync::watch;
use tokio::task::JoinSet;

pub use config::{MqttOptions, MqttPlan, NotifyError, WebhookOptions, WebhookPlan};
pub use webhook::{WebhookHandle, WebhookStatus};

use crate::api::Cameras;
use crate::publish::{EventHub, Hub};

/// How long what is pending has once the service stops.
const GRACE: Duration = Duration::from_secs(1);

/// What is told to whom, checked.
#[derive(Debug, Default)]
pub struct NotifyPlan {
    /// Each webhook.
    pub webhooks: Vec<WebhookPlan>,
    /// The broker, where there is one.
    pub mqtt: Option<MqttPlan>,
}

/// The running sinks.
pub struct Notifier {
    stop: watch::Sender<bool>,
    tasks: JoinSet<()>,
    webhooks: Vec<WebhookHandle>,
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
    pub fn start(
        plan: NotifyPlan,
        cameras: &Arc<dyn Cameras>,
        hub: &Hub,
        events: &EventHub,
        registry: &Registry,
    ) -> prometheus::Result<Self> {
        let (stop, stopped) = watch::channel(false);
        let mut tasks = JoinSet::new();
        let webhooks = webhook::start(plan.webhooks, events, registry, &Stop(stopped.clone()), &mut tasks)?;
        if let Some(plan) = plan.mqtt {
            tasks.spawn(mqtt::sink(plan, cameras.clone(), hub, events, registry, Stop(stopped))?);
        }
        Ok(Self { stop, tasks, webhooks })
    }

    /// The webhooks and how they fare.
    pub fn webhooks(&self) -> Vec<WebhookHandle> {
        self.webhooks.clone()
    }

    /// Lets every sink deliver what is pending, for a moment; what is left then is counted and logged.
    pub async fn stop(mut self) {
        self.stop.send_replace(true);
        let ended = async { while self.tasks.join_next().await.is_some() {} };
        if tokio::time::timeout(GRACE + Duration::from_millis(500), ended).await.is_err() {
            tracing::warn!("webhooks or MQTT did not end in time");
        }
    }
}
