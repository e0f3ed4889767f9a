//! `gakp serve`: arguments and configuration, checks, start, run, drain.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use tokio::net::TcpListener;
use tokio::sync::oneshot;

use super::models::ModelArgs;
use super::reload::Reloader;
use super::signals::{self, Signals};
use crate::api::{self, ApiConfig, Cameras, NewCamera};
use crate::auth::tls::Certificates;
use crate::auth::{Gate, TokenFile};
use crate::config::{Config, TrackerOptions};
use crate::history::{History, HistoryMetrics, HistorySettings, Pictures};
use crate::infer::Models;
use crate::ingest::memory;
use crate::notify::{Notifier, NotifyPlan, RememberedWebhooks};
use crate::pipeline::{CameraSet, Lanes, MAX_CAMERAS, SetConfig, Store, source_spec};
use crate::publish::{EventHub, Hub, HubConfig};
use crate::telemetry::Metrics;
use crate::traces::{Exporter, TracesPlan};
use crate::track::TrackerConfig;
use crate::types::CameraId;

/// Runs the service: cameras in, tracks out.
///
/// Cameras come from the configuration, from --camera, and at run time from POST /v1/cameras; the
/// latter are remembered in the state folder. SIGTERM drains and ends; a second one ends at once.
// No `Debug`: the cameras may hold passwords.
#[derive(Clone, clap::Args)]
pub struct Args {
    /// Configuration file (TOML).
    #[arg(long, short, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Address of the API and the page [default: 127.0.0.1:8080].
    #[arg(long, env = "GAKP_LISTEN", value_name = "ADDR")]
    listen: Option<SocketAddr>,
    /// A camera, as NAME=URL: rtsp://, rtsps://, http(s)://, a file, v4l2:///dev/video0, test:. Repeatable.
    // Taken apart later: clap's own errors would repeat the value, and with it a password.
    #[arg(long = "camera", value_name = "NAME=URL")]
    cameras: Vec<String>,
    /// Play files given with --camera over and over.
    #[arg(long = "loop")]
    looped: bool,
    /// Where cameras added at run time are remembered [default: $STATE_DIRECTORY, $XDG_STATE_HOME/gakp
    /// or ~/.local/state/gakp].
    #[arg(long, value_name = "DIR")]
    state_dir: Option<PathBuf>,
    /// Certificate chain (PEM): serve HTTPS and WSS.
    #[arg(long, value_name = "FILE")]
    tls_cert: Option<PathBuf>,
    /// Private key of the certificate (PEM).
    #[arg(long, value_name = "FILE")]
    tls_key: Option<PathBuf>,
    /// File with an admin's token of at least 32 characters, for secrets of containers; besides those of `gakp token`.
    #[arg(long, env = "GAKP_ADMIN_TOKEN_FILE", value_name = "FILE")]
    admin_token_file: Option<PathBuf>,
    /// What is remembered of tracks and events: a SQLite file, postgres://USER@HOST/DATABASE or none [default:
    /// history.sqlite in the state folder].
    // An URL may hold a password; it is read from the environment as well, where other users do not see it.
    #[arg(long, env = "GAKP_HISTORY", hide_env_values = true, value_name = "WHERE")]
    history: Option<String>,
    /// Most cameras at a time [default: 64].
    #[arg(long, value_name = "N")]
    max_cameras: Option<usize>,
    /// Tuning file of `gakp tune`: the noise of the Kalman filter.
    #[arg(long, value_name = "FILE")]
    tuning: Option<PathBuf>,
    #[command(flatten)]
    models: ModelArgs,
}

/// How long draining may take, from the first signal on, before the service ends anyway.
const DRAIN: Duration = Duration::from_millis(4500);

/// Runs the service until it is told to end.
///
/// # Errors
/// A setting, a model, the address or the state folder is wrong; no camera was opened then.
pub fn run(args: Args) -> Result<()> {
    memory::arena_a_core();
    let plan = Plan::new(args)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .thread_name("async")
        .worker_threads(2)
        .enable_all()
        .build()
        .context("cannot start the async runtime")?;
    let done = runtime.block_on(serve(plan));
    // What still blocks (a camera that does not answer its TEARDOWN) is left behind.
    runtime.shutdown_timeout(Duration::from_millis(200));
    done
}

/// Everything that can be checked without opening anything.
pub(super) struct Plan {
    /// What it was made of.
    args: Args,
    pub(super) listen: SocketAddr,
    pub(super) cameras: Vec<NewCamera>,
    pub(super) state_dir: PathBuf,
    pub(super) store: (Store, crate::pipeline::Remembered),
    pub(super) gate: Gate,
    certificates: Option<Arc<Certificates>>,
    limit: usize,
    pub(super) history: Option<HistorySettings>,
    /// Whether the history keeps pictures.
    snapshots: bool,
    pub(super) tracker: TrackerOptions,
    pub(super) models: crate::infer::ModelSettings,
    pub(super) notify: NotifyPlan,
    pub(super) traces: Option<TracesPlan>,
}

impl Args {
    /// The configuration that they name; an empty one where they name none.
    ///
    /// # Errors
    /// As [`Config::read`].
    pub(super) fn configuration(&self) -> Result<Config> {
        Ok(self.config.as_deref().map(Config::read).transpose()?.unwrap_or_default())
    }
}

impl Plan {
    /// Reads and checks all settings.
    ///
    /// # Errors
    /// The first that is wrong.
    pub(super) fn new(args: Args) -> Result<Self> {
        let (given, mut config) = (args.clone(), args.configuration()?);
        let mut notify = config.take_notify()?;
        let traces = config.take_traces()?;
        let tracker = config.tracker.tuned(args.tuning)?;
        let mut cameras = config.cameras;
        for text in &args.cameras {
            let camera = camera(text, args.looped)?;
            if cameras.iter().any(|c| c.id == camera.id) {
                bail!("two cameras are named {:?}: names must differ", camera.id.as_str());
            }
            cameras.push(camera);
        }
        for camera in &cameras {
            source_spec(camera)
                .and_then(|spec| spec.check())
                .with_context(|| format!("camera {:?}", camera.id.as_str()))?;
            camera.rules().with_context(|| format!("camera {:?}", camera.id.as_str()))?;
        }
        let limit = args.max_cameras.or(config.max_cameras).unwrap_or(64);
        if limit == 0 || limit > MAX_CAMERAS {
            bail!("max_cameras is {limit}: must be from 1 to {MAX_CAMERAS}");
        }
        if cameras.len() > limit {
            bail!("{} cameras are configured, but max_cameras is {limit}", cameras.len());
        }
        let state_dir = args.state_dir.or(config.state_dir).or_else(default_state_dir).context(
            "no state folder: neither STATE_DIRECTORY nor XDG_STATE_HOME nor HOME is set; give --state-dir",
        )?;
        let listen = args.listen.or(config.listen).unwrap_or(SocketAddr::from(([127, 0, 0, 1], 8080)));
        let local = listen.ip().is_loopback();
        let store = Store::open(&state_dir)?;
        notify = notify.and(RememberedWebhooks::read(&state_dir)?)?;
        let mut kept = config.history;
        kept.database = args.history.or(kept.database);
        let mut gate = Gate::new(TokenFile::path(&state_dir), local)?;
        if let Some(file) = args.admin_token_file.or(config.admin_token_file) {
            gate.admit_admin(&file)?;
        }
        if !local && !gate.has_tokens() {
            bail!(
                "{listen} can be reached from the network, and there is no token yet: everybody could see and change \
                 everything. Make one with `gakp token create NAME --role admin --state-dir {}`, or listen on 127.0.0.1",
                state_dir.display()
            );
        }
        let certificates = match (args.tls_cert.or(config.tls_cert), args.tls_key.or(config.tls_key)) {
            (Some(cert), Some(key)) => Some(Certificates::read(&cert, &key)?),
            (None, None) => None,
            _ => bail!("--tls-cert and --tls-key belong together: one of them is missing"),
        };
        Ok(Self {
            args: given,
            listen,
            gate,
            certificates,
            cameras,
            store,
            limit,
            history: kept.settings(&state_dir)?,
            state_dir,
            snapshots: kept.snapshots,
            tracker,
            models: crate::config::ModelConfig::from(args.models).or(config.models).settings()?,
            notify,
            traces,
        })
    }
}

async fn serve(plan: Plan) -> Result<()> {
    let mut signals = Signals::listen()?;
    let (stop, stopped) = oneshot::channel();
    let mut service = std::pin::pin!(async {
        let Service { listener, config, set, history, notifier, exporter } = start(plan).await?;
        let hub = config.hub.clone();
        let served = api::serve(listener, config, async {
            // An error means that nobody can ask for the end any more: that is the end too.
            let _ = stopped.await;
        })
        .await;
        hub.close();
        notifier.stop().await;
        set.shutdown().await;
        if let Some(history) = history {
            history.stop().await;
        }
        // Last: what ends before it has its say.
        if let Some(exporter) = exporter {
            exporter.stop().await;
        }
        served.context("the HTTP server failed")
    });
    tokio::select! {
        ended = &mut service => return ended,
        () = signals.next() => tracing::info!("draining"),
    }
    // While it still starts, this ends it as soon as it has started.
    let _ = stop.send(());
    tokio::select! {
        drained = tokio::time::timeout(DRAIN, &mut service) => match drained {
            Ok(ended) => return ended,
            Err(_) => tracing::warn!("draining took too long; ending anyway"),
        },
        () = signals.next() => tracing::warn!("told twice; ending at once"),
    }
    Ok(())
}

/// What runs once everything was checked.
struct Service {
    listener: TcpListener,
    config: ApiConfig,
    set: Arc<CameraSet>,
    history: Option<History>,
    notifier: Arc<Notifier>,
    exporter: Option<Exporter>,
}

/// Loads the models, takes the port, starts the cameras: in this order, so that a mistake leaves
/// nothing half-started.
async fn start(plan: Plan) -> Result<Service> {
    let metrics = Metrics::new().context("cannot set up the metrics")?;
    // Loading models takes seconds on a GPU and blocks.
    let (settings, observer) = (plan.tracker.without_idle(&plan.models)?, metrics.clone());
    let models = tokio::task::spawn_blocking(move || Models::load(&settings, observer)).await??;
    metrics.provider(models.report.provider);
    let tracker = plan.tracker.apply(models.calibrate(TrackerConfig::default()))?;
    models.check_suits(tracker.association.method)?;
    let hub = Hub::new(HubConfig::default(), models.detector.classes().into());
    hub.metrics().register(metrics.registry())?;
    let events = EventHub::new(hub.classes().clone());
    let exporter = plan.traces.map(|plan| Exporter::start(plan, metrics.registry())).transpose()?;
    let (exporter, traces) = exporter.unzip();
    let lanes = Lanes::start(models, metrics.clone())?.traced(traces.clone());
    let listener = TcpListener::bind(plan.listen)
        .await
        .with_context(|| format!("cannot listen on {}: choose another address with --listen", plan.listen))?;
    let address = listener.local_addr()?;
    plan.store.0.make_folder()?;
    let set = CameraSet::new(SetConfig {
        lanes,
        hub: hub.clone(),
        events: events.clone(),
        metrics: metrics.clone(),
        tracker,
        store: Some(plan.store),
        limit: plan.limit,
    });
    let history = match plan.history {
        Some(mut settings) => {
            settings.pictures = plan.snapshots.then(|| newest_pictures(set.clone()));
            let figures = HistoryMetrics::new(metrics.registry())?;
            Some(History::start(settings, &hub, &events, figures).await?)
        }
        None => None,
    };
    let tls = plan.certificates.as_ref().map(|certificates| certificates.server()).transpose()?;
    let configured = plan.cameras.clone();
    for camera in plan.cameras {
        let id = camera.id.clone();
        set.start_configured(camera).await.with_context(|| format!("camera {:?}", id.as_str()))?;
    }
    set.start_remembered().await;
    let scheme = if tls.is_some() { "https" } else { "http" };
    tracing::info!("the page is at {scheme}://{address}/");
    let cameras: Arc<dyn api::Cameras> = set.clone();
    let notifier = Notifier::start(plan.notify, &cameras, &hub, &events, metrics.registry()).await?;
    let notifier = Arc::new(notifier);
    let reloader = Reloader::new(plan.args, configured, set.clone(), plan.certificates, notifier.clone())?;
    let reloader = Arc::new(reloader);
    tokio::spawn(signals::on_hangup(reloader.clone())?);
    let config = ApiConfig {
        cameras,
        hub,
        events,
        history: history.as_ref().map(|history| history.database().clone()),
        webhooks: notifier.webhooks(),
        registry: metrics.registry().clone(),
        // Models are warm before the port is bound: who can ask finds the service ready.
        readiness: Arc::new(Vec::new),
        gate: Arc::new(plan.gate),
        operations: Some(reloader),
        traces,
        tls,
    };
    Ok(Service { listener, config, set, history, notifier, exporter })
}

/// The newest picture of each camera.
fn newest_pictures(set: Arc<CameraSet>) -> Pictures {
    Arc::new(move || {
        let ids = set.list().into_iter().map(|status| status.id);
        ids.filter_map(|id| set.video(&id)?.borrow().clone()).collect()
    })
}

/// The value of --camera; errors repeat nothing of the URL.
fn camera(text: &str, looped: bool) -> Result<NewCamera> {
    let (id, url) = text
        .split_once('=')
        // The first `=` of a URL alone is within it, maybe behind its password.
        .filter(|(id, _)| !id.contains("://"))
        .context("--camera needs NAME=URL, such as gate=rtsp://10.0.0.2/stream1: the name is missing")?;
    let id = CameraId::new(id).context("--camera NAME=URL: wrong name")?;
    Ok(NewCamera {
        id,
        url: url.into(),
        transport: None,
        looped,
        paused: false,
        lines: vec![],
        zones: vec![],
        masks: vec![],
    })
}

pub(super) fn default_state_dir() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    set("STATE_DIRECTORY")
        .or_else(|| set("XDG_STATE_HOME").map(|dir| dir.join("gakp")))
        .or_else(|| set("HOME").map(|dir| dir.join(".local/state/gakp")))
}
