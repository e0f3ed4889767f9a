//! The MQTT sink while the service runs: started, replaced and ended as the configuration has it.

use std::sync::Arc;

use prometheus::Registry;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::Stop;
use super::config::MqttPlan;
use super::mqtt::{self, Figures, Remains};
use crate::api::Cameras;
use crate::publish::{EventHub, Hub};

/// The broker that is told what happens, where there is one.
pub(super) struct Broker {
    cameras: Arc<dyn Cameras>,
    hub: Hub,
    events: EventHub,
    registry: Registry,
    /// While there is a broker.
    figures: Option<Figures>,
    running: Option<Running>,
}

struct Running {
    plan: MqttPlan,
    stop: watch::Sender<bool>,
    task: JoinHandle<Remains>,
}

impl Running {
    /// Lets the sink send what is pending, for a moment; what it leaves.
    async fn end(self) -> Option<Remains> {
        self.stop.send_replace(true);
        let ended = self.task.await;
        ended.inspect_err(|_| tracing::error!("the MQTT sink had failed; what waited for it is lost")).ok()
    }
}

impl Broker {
    pub fn new(cameras: &Arc<dyn Cameras>, hub: &Hub, events: &EventHub, registry: &Registry) -> Self {
        let (cameras, hub, events, registry) =
            (cameras.clone(), hub.clone(), events.clone(), registry.clone());
        Self { cameras, hub, events, registry, figures: None, running: None }
    }

    /// Goes by `plan` from now on; whether that is something else. What waits for a broker that is replaced, and what
    /// happens meanwhile, goes to the next; without a next it is lost, and counted. There are figures only while there
    /// is a broker.
    ///
    /// # Errors
    /// The figures were registered by somebody else.
    pub async fn configure(&mut self, plan: Option<MqttPlan>) -> prometheus::Result<bool> {
        let same = match (&self.running, &plan) {
            (Some(running), Some(plan)) => running.plan.is_like(plan),
            (None, None) => true,
            _ => false,
        };
        if same {
            return Ok(false);
        }
        let remains = self.end().await;
        match plan {
            Some(plan) => {
                let figures = match self.figures.take() {
                    Some(figures) => figures,
                    None => Figures::register(&self.registry)?,
                };
                self.figures = Some(figures.clone());
                self.start(plan, figures, remains.unwrap_or_else(|| Remains::none(&self.events)));
            }
            None => {
                if let Some(figures) = self.figures.take() {
                    if let Some(remains) = remains {
                        remains.give_up(&figures, "there is no broker any more");
                    }
                    figures.unregister(&self.registry);
                }
            }
        }
        Ok(true)
    }

    async fn end(&mut self) -> Option<Remains> {
        match self.running.take() {
            Some(running) => running.end().await,
            None => None,
        }
    }

    fn start(&mut self, plan: MqttPlan, figures: Figures, remains: Remains) {
        let (stop, stopped) = watch::channel(false);
        let sink = mqtt::sink(plan.clone(), self.cameras.clone(), &self.hub, remains, figures, Stop(stopped));
        self.running = Some(Running { plan, stop, task: tokio::spawn(sink) });
    }

    /// Ends the sink; what is left then is lost, and counted.
    pub async fn stop(&mut self) {
        if let (Some(remains), Some(figures)) = (self.end().await, &self.figures) {
            remains.give_up(figures, "the service stops");
        }
    }
}
