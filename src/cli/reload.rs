//! Reading the configuration again: on SIGHUP, and when the API is told to.

use std::sync::Arc;

use anyhow::{Context, Result};
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::Mutex;

use super::log;
use super::serve::{Args, Plan};
use crate::api::{Cameras, NewCamera, Operations, Reloaded};
use crate::auth::tls::Certificates;
use crate::config::Config;
use crate::notify::Notifier;
use crate::pipeline::CameraSet;

/// The service's settings and what they were made of.
pub struct Reloader {
    args: Args,
    set: Arc<CameraSet>,
    certificates: Option<Arc<Certificates>>,
    notifier: Arc<Notifier>,
    /// What is in use: one change at a time.
    current: Mutex<Current>,
}

struct Current {
    /// What the process was started with.
    config: Config,
    /// The cameras of the configuration as they are now.
    cameras: Vec<NewCamera>,
}

impl Reloader {
    /// Of a service that runs by `args` with `cameras`.
    ///
    /// # Errors
    /// The configuration was readable a moment ago and is no more.
    pub fn new(
        args: Args,
        cameras: Vec<NewCamera>,
        set: Arc<CameraSet>,
        certificates: Option<Arc<Certificates>>,
        notifier: Arc<Notifier>,
    ) -> Result<Self> {
        let config = args.configuration()?;
        Ok(Self { args, set, certificates, notifier, current: Mutex::new(Current { config, cameras }) })
    }

    async fn again(&self) -> Result<Reloaded> {
        let mut current = self.current.lock().await;
        // All of it is checked before anything is changed.
        let (config, plan) = (self.args.configuration()?, Plan::new(self.args.clone())?);
        let mut done = Reloaded { restart: current.config.differs(&config), ..Reloaded::default() };
        if let Some(certificates) = &self.certificates {
            certificates.read_again().context("the certificate in use stays")?;
            done.certificate = true;
        }
        let of =
            |cameras: &[NewCamera], camera: &NewCamera| cameras.iter().find(|c| c.id == camera.id).cloned();
        for camera in &current.cameras {
            if of(&plan.cameras, camera).as_ref() != Some(camera) {
                // One that was removed by hand is gone already.
                if self.set.stop_configured(&camera.id).await.unwrap_or(true) {
                    done.cameras.push(camera.id.to_string());
                } else {
                    done.failed.push(format!("camera {}: it was changed at run time, which wins", camera.id));
                }
            }
        }
        let mut cameras = vec![];
        for camera in plan.cameras {
            if of(&current.cameras, &camera).as_ref() != Some(&camera) && self.set.get(&camera.id).is_none() {
                let id = camera.id.to_string();
                if let Err(error) = self.set.start_configured(camera.clone()).await {
                    // It is tried again the next time.
                    done.failed.push(format!("camera {id}: {error}"));
                    continue;
                }
                if !done.cameras.contains(&id) {
                    done.cameras.push(id);
                }
            }
            cameras.push(camera);
        }
        current.cameras = cameras;
        let told = self.notifier.configure(plan.notify).await;
        (done.webhooks, done.mqtt) = (told.webhooks, told.mqtt);
        done.failed.extend(told.failed);
        Ok(done)
    }
}

impl Operations for Reloader {
    fn log_level(&self) -> String {
        log::level()
    }

    fn set_log_level(&self, level: &str) -> Result<(), String> {
        log::set_level(level).map_err(|error| error.to_string())
    }

    fn reload(&self) -> BoxFuture<'_, Result<Reloaded, String>> {
        async move {
            match self.again().await {
                Ok(done) => {
                    let Reloaded { cameras, webhooks, mqtt, certificate, restart, failed } = &done;
                    tracing::info!(
                        ?cameras,
                        ?webhooks,
                        mqtt,
                        certificate,
                        ?restart,
                        ?failed,
                        "the configuration was read again"
                    );
                    Ok(done)
                }
                Err(error) => {
                    tracing::error!("the configuration cannot be used, nothing was changed: {error:#}");
                    Err(format!("{error:#}"))
                }
            }
        }
        .boxed()
    }
}
