//! Webhooks: those of the configuration, and those that are added while the service runs.

mod account;
mod courier;
mod spec;
mod status;

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use prometheus::Registry;
use tokio::sync::watch;
use tokio::task::JoinSet;

pub(crate) use spec::Kept;
pub use spec::{WebhookPatch, WebhookSpec};
pub use status::{WebhookSettings, WebhookSource, WebhookStatus, WebhookTrial};

use super::Stop;
use super::config::WebhookPlan;
use crate::outgoing::Reach;
use crate::publish::{EventFilter, EventHub};
use account::{Account, Figures, Outcome};
use spec::WebhookFile;

/// Most webhooks while one is added at run time.
const MAX_WEBHOOKS: usize = 32;

/// Why a webhook cannot be added, changed, removed.
#[derive(Debug, thiserror::Error)]
pub enum WebhookError {
    /// The name is taken.
    #[error("a webhook {0:?} exists; delete it first or choose another name")]
    Exists(String),
    /// There is none of that name.
    #[error("there is no webhook {0:?}; GET /v1/webhooks lists them")]
    Unknown(String),
    /// It is the configuration's.
    #[error(
        "webhook {0:?} is in the configuration: change it there and have it read again (POST /v1/reload or SIGHUP)"
    )]
    Configured(String),
    /// There are as many as may be.
    #[error("there are {0} webhooks, which is the limit; delete one first")]
    LimitReached(usize),
    /// A setting is wrong.
    #[error("webhook {name:?}: {what}")]
    Invalid {
        /// Which.
        name: String,
        /// What is wrong; no secret is quoted.
        what: String,
    },
    /// The file that remembers them cannot be read or written; nothing changed.
    #[error("{0}")]
    Io(String),
}

/// What is remembered of webhooks that were added at run time, and where.
#[derive(Debug, Default)]
pub struct RememberedWebhooks {
    file: Option<WebhookFile>,
    /// Each, and what it comes to or why it cannot be used any more.
    kept: Vec<(Kept, Result<WebhookPlan, String>)>,
}

impl RememberedWebhooks {
    /// What the state folder remembers. One that cannot be used any more stays among them.
    ///
    /// # Errors
    /// The file cannot be read or is damaged.
    pub fn read(folder: &Path) -> Result<Self, WebhookError> {
        let (file, kept) = WebhookFile::open(folder).map_err(WebhookError::Io)?;
        let kept = kept.into_iter().map(|kept| {
            let plan = kept.plan();
            (kept, plan)
        });
        Ok(Self { file: Some(file), kept: kept.collect() })
    }

    /// Whether one of them has this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.kept.iter().any(|(kept, _)| kept.webhook.name == name)
    }

    /// Each one's name, and what it comes to or why it cannot be used any more.
    pub(super) fn plans(&self) -> impl Iterator<Item = (&str, Result<&WebhookPlan, &str>)> {
        self.kept.iter().map(|(kept, plan)| (&*kept.webhook.name, plan.as_ref().map_err(String::as_str)))
    }
}

/// The running webhooks. Cheap to clone; clones are the same.
#[derive(Clone)]
pub struct Webhooks(Arc<Shared>);

struct Shared {
    events: EventHub,
    figures: Figures,
    stop: Stop,
    file: Option<WebhookFile>,
    set: Mutex<Set>,
    /// One change at a time, from what is checked to what is written.
    changes: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Set {
    hooks: Vec<Hook>,
    tasks: JoinSet<()>,
}

struct Hook {
    account: Arc<Account>,
    work: Work,
    /// What is remembered of it; `None` for one of the configuration.
    kept: Option<Kept>,
}

enum Work {
    /// What it goes by; its tasks end when this is dropped.
    Runs(watch::Sender<Arc<WebhookPlan>>),
    /// It is remembered and cannot be used any more.
    Idle { settings: WebhookSettings, why: String },
}

impl Hook {
    fn status(&self) -> WebhookStatus {
        let account = &*self.account;
        let (delivered, failed) = account.totals();
        let last_error = account.last_error();
        WebhookStatus {
            name: account.name.clone(),
            source: if self.kept.is_some() { WebhookSource::Api } else { WebhookSource::Configuration },
            settings: match &self.work {
                Work::Runs(plan) => WebhookSettings::from(&**plan.borrow()),
                Work::Idle { settings, .. } => settings.clone(),
            },
            delivered,
            failed,
            pending: account.queue.len(),
            last_error_time: last_error.as_ref().map(|(at, _)| format!("{at:.3}")),
            last_error: last_error.map(|(_, text)| text),
        }
    }

    fn plan(&self) -> Option<Arc<WebhookPlan>> {
        match &self.work {
            Work::Runs(plan) => Some(plan.borrow().clone()),
            Work::Idle { .. } => None,
        }
    }
}

impl Shared {
    fn set(&self) -> MutexGuard<'_, Set> {
        self.set.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts a webhook, in the place of one of its name: a task to collect its events and one to deliver them.
    fn open(&self, set: &mut Set, plan: WebhookPlan, kept: Option<Kept>) {
        // Those that have ended.
        while set.tasks.try_join_next().is_some() {}
        let account = Arc::new(Account::open(&plan.name, plan.queue, &self.figures));
        tracing::info!(webhook = plan.name, url = %plan.address, "events are posted");
        let (plan, plans) = watch::channel(Arc::new(plan));
        // What it wants may change: it hears all.
        let listener = self.events.listen(EventFilter::default());
        set.tasks.spawn(courier::collect(account.clone(), listener, plans.clone(), self.stop.clone()));
        set.tasks.spawn(courier::deliver(account.clone(), plans, self.stop.clone()));
        set.put(Hook { account, work: Work::Runs(plan), kept });
    }

    /// Keeps a webhook that cannot be used any more, until it is changed, removed, or can be used again.
    fn shelve(&self, set: &mut Set, kept: Kept, why: String) {
        let settings = WebhookSettings::from(&kept.webhook);
        let account = Arc::new(Account::open(&kept.webhook.name, settings.queue, &self.figures));
        account.failed(format!("it cannot be used any more, and is told nothing: {why}"));
        set.put(Hook { account, work: Work::Idle { settings, why }, kept: Some(kept) });
    }

    /// Has a webhook go by another plan. What waits stays.
    fn change(&self, set: &mut Set, plan: WebhookPlan, kept: Option<Kept>) {
        let hook = set.hooks.iter_mut().find(|hook| hook.account.name == plan.name);
        let Some(Hook { account, work: Work::Runs(current), kept: before }) = hook else {
            return self.open(set, plan, kept);
        };
        let dropped = account.queue.resize(plan.queue);
        account.count(Outcome::Dropped, dropped);
        current.send_replace(Arc::new(plan));
        *before = kept;
    }

    /// Ends a webhook. What waits for it is lost, and counted as long as anybody can see it.
    fn close(&self, set: &mut Set, name: &str) {
        set.hooks.retain(|hook| hook.account.name != name);
        self.figures.forget(name);
        tracing::info!(webhook = name, "events are posted no more");
    }

    /// Writes what is to be remembered, off the async threads.
    async fn save(&self, kept: Vec<Kept>) -> Result<(), WebhookError> {
        let Some(file) = self.file.clone() else { return Ok(()) };
        let saved = tokio::task::spawn_blocking(move || file.save(kept)).await;
        saved.map_err(|error| WebhookError::Io(error.to_string()))?.map_err(WebhookError::Io)
    }
}

impl Set {
    /// Adds it, or puts it in the place of one of its name.
    fn put(&mut self, hook: Hook) {
        match self.hooks.iter_mut().find(|other| other.account.name == hook.account.name) {
            Some(place) => *place = hook,
            None => self.hooks.push(hook),
        }
    }

    fn find(&self, name: &str) -> Option<&Hook> {
        self.hooks.iter().find(|hook| hook.account.name == name)
    }

    /// Those that cannot be used any more.
    fn shelved(&self) -> Vec<Kept> {
        let idle = self.hooks.iter().filter(|hook| matches!(hook.work, Work::Idle { .. }));
        idle.filter_map(|hook| hook.kept.clone()).collect()
    }

    /// What is to be remembered.
    fn kept(&self) -> Vec<Kept> {
        self.hooks.iter().filter_map(|hook| hook.kept.clone()).collect()
    }
}

impl Webhooks {
    /// Starts those of the configuration, then those that are remembered.
    ///
    /// # Errors
    /// The figures were registered before.
    pub(super) fn start(
        plans: Vec<WebhookPlan>,
        remembered: RememberedWebhooks,
        events: &EventHub,
        registry: &Registry,
        stop: Stop,
    ) -> prometheus::Result<Self> {
        let figures = Figures::register(registry)?;
        let RememberedWebhooks { file, kept } = remembered;
        let (events, set, changes) = (events.clone(), Mutex::default(), tokio::sync::Mutex::default());
        let shared = Shared { events, figures, stop, file, set, changes };
        let mut set = shared.set();
        for plan in plans {
            shared.open(&mut set, plan, None);
        }
        for (kept, plan) in kept {
            match plan {
                Ok(plan) => shared.open(&mut set, plan, Some(kept)),
                Err(why) => shared.shelve(&mut set, kept, why),
            }
        }
        drop(set);
        Ok(Self(Arc::new(shared)))
    }

    /// All of them: those of the configuration first.
    pub fn list(&self) -> Vec<WebhookStatus> {
        let set = self.0.set();
        let of = |configured: bool| set.hooks.iter().filter(move |hook| hook.kept.is_none() == configured);
        of(true).chain(of(false)).map(Hook::status).collect()
    }

    /// One of them.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn get(&self, name: &str) -> Result<WebhookStatus, WebhookError> {
        let set = self.0.set();
        set.find(name).map(Hook::status).ok_or_else(|| WebhookError::Unknown(name.to_owned()))
    }

    /// Adds one and remembers it.
    ///
    /// # Errors
    /// A setting is wrong, the name is taken, there are too many, or it cannot be remembered.
    pub(crate) async fn add(&self, spec: WebhookSpec, reach: Reach) -> Result<WebhookStatus, WebhookError> {
        let shared = &*self.0;
        let name = spec.name.clone();
        let plan = spec.plan(reach).map_err(|what| WebhookError::Invalid { name: name.clone(), what })?;
        let kept = Kept { anywhere: reach == Reach::Anywhere, webhook: spec };
        let _one = shared.changes.lock().await;
        let all = {
            let set = shared.set();
            if set.find(&name).is_some() {
                return Err(WebhookError::Exists(name));
            }
            if set.hooks.len() >= MAX_WEBHOOKS {
                return Err(WebhookError::LimitReached(MAX_WEBHOOKS));
            }
            set.kept().into_iter().chain([kept.clone()]).collect()
        };
        shared.save(all).await?;
        shared.open(&mut shared.set(), plan, Some(kept));
        self.get(&name)
    }

    /// Changes one that was added. What waits for it stays, and is posted by the new settings.
    ///
    /// # Errors
    /// There is none of that name, it is the configuration's, a setting is wrong, or it cannot be remembered.
    pub(crate) async fn change(
        &self,
        name: &str,
        patch: WebhookPatch,
        reach: Reach,
    ) -> Result<WebhookStatus, WebhookError> {
        let shared = &*self.0;
        let _one = shared.changes.lock().await;
        let before = self.added(name)?;
        // Who names a URL answers for it.
        let anywhere = if patch.url.is_some() { reach == Reach::Anywhere } else { before.anywhere };
        let kept = Kept { anywhere, webhook: patch.apply(&before.webhook) };
        let plan = kept.plan().map_err(|what| WebhookError::Invalid { name: name.to_owned(), what })?;
        let mut all = shared.set().kept();
        for other in all.iter_mut().filter(|other| other.webhook.name == name) {
            *other = kept.clone();
        }
        shared.save(all).await?;
        shared.change(&mut shared.set(), plan, Some(kept));
        self.get(name)
    }

    /// Removes one that was added, and what waits for it.
    ///
    /// # Errors
    /// There is none of that name, it is the configuration's, or the change cannot be remembered.
    pub async fn remove(&self, name: &str) -> Result<(), WebhookError> {
        let shared = &*self.0;
        let _one = shared.changes.lock().await;
        self.added(name)?;
        let mut all = shared.set().kept();
        all.retain(|kept| kept.webhook.name != name);
        shared.save(all).await?;
        shared.close(&mut shared.set(), name);
        Ok(())
    }

    fn added(&self, name: &str) -> Result<Kept, WebhookError> {
        let set = self.0.set();
        let hook = set.find(name).ok_or_else(|| WebhookError::Unknown(name.to_owned()))?;
        hook.kept.clone().ok_or_else(|| WebhookError::Configured(name.to_owned()))
    }

    /// Posts something that is no event, once and past what waits.
    ///
    /// # Errors
    /// There is none of that name.
    pub async fn try_once(&self, name: &str) -> Result<WebhookTrial, WebhookError> {
        let plan = {
            let set = self.0.set();
            let hook = set.find(name).ok_or_else(|| WebhookError::Unknown(name.to_owned()))?;
            match &hook.work {
                Work::Runs(plan) => Ok(plan.borrow().clone()),
                Work::Idle { why, .. } => Err(why.clone()),
            }
        };
        let begun = Instant::now();
        let posted = match plan {
            Ok(plan) => courier::try_once(&plan).await,
            Err(why) => Err(why),
        };
        let took_ms = (begun.elapsed().as_secs_f64() * 1e5).round() / 100.0;
        let (status, error) = match posted {
            Ok(status) => (Some(status.as_u16()), None),
            Err(error) => (None, Some(error)),
        };
        Ok(WebhookTrial { delivered: status.is_some(), status, error, took_ms })
    }

    /// Takes over what the configuration has now, and tries those again that could not be used; the names of those that
    /// were started, changed or removed, and what could not be done.
    pub async fn configure(&self, plans: Vec<WebhookPlan>) -> (Vec<String>, Vec<String>) {
        let shared = &*self.0;
        let _one = shared.changes.lock().await;
        let mut set = shared.set();
        let (mut changed, mut failed) = (vec![], vec![]);
        let gone: Vec<_> = set
            .hooks
            .iter()
            .filter(|hook| hook.kept.is_none() && plans.iter().all(|plan| plan.name != hook.account.name))
            .map(|hook| hook.account.name.clone())
            .collect();
        for name in gone {
            shared.close(&mut set, &name);
            changed.push(name);
        }
        for plan in plans {
            let name = plan.name.clone();
            match set.find(&name) {
                Some(hook) if hook.kept.is_some() => {
                    failed.push(format!(
                        "webhook {name}: one of this name was added at run time; delete that one first"
                    ));
                }
                Some(hook) if hook.plan().is_some_and(|before| before.is_like(&plan)) => {}
                // Its name is its place, where another stands now: what waits was for the one before.
                Some(hook)
                    if !plan.named && hook.plan().is_some_and(|before| before.address != plan.address) =>
                {
                    shared.close(&mut set, &name);
                    shared.open(&mut set, plan, None);
                    changed.push(name);
                }
                _ => {
                    shared.change(&mut set, plan, None);
                    changed.push(name);
                }
            }
        }
        // Perhaps what was missing is there by now.
        for kept in set.shelved() {
            if let Ok(plan) = kept.plan() {
                changed.push(plan.name.clone());
                shared.open(&mut set, plan, Some(kept));
            }
        }
        (changed, failed)
    }

    /// Resolves once all have delivered what they could.
    pub(super) async fn ended(&self) {
        let mut tasks = std::mem::take(&mut self.0.set().tasks);
        while tasks.join_next().await.is_some() {}
    }
}
