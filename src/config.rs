//! Settings: the TOML file, merged with the command line, checked before anything is opened.
//!
//! Unknown keys are errors. What the file leaves out has the default that the core gives it.

mod tracker;

use std::fmt;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;

pub use crate::infer::ModelConfig;
pub use tracker::TrackerOptions;

use crate::api::NewCamera;
use crate::history::{HistorySettings, Place};
use crate::notify::{MqttOptions, NotifyError, NotifyPlan, RememberedWebhooks, WebhookOptions};
use crate::traces::{TracesError, TracesOptions, TracesPlan};
use crate::track::TrackerConfig;

/// The whole file.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Address of the API and the page.
    pub listen: Option<SocketAddr>,
    /// Where cameras that were added at run time are remembered.
    pub state_dir: Option<PathBuf>,
    /// Certificate chain, PEM; relative to the working folder.
    pub tls_cert: Option<PathBuf>,
    /// Its private key, PEM.
    pub tls_key: Option<PathBuf>,
    /// File with an admin's token.
    pub admin_token_file: Option<PathBuf>,
    /// Most cameras at a time.
    pub max_cameras: Option<usize>,
    /// What is remembered of tracks and events.
    pub history: HistoryConfig,
    /// Models and where they run.
    pub models: ModelConfig,
    /// The tracker's settings.
    pub tracker: TrackerOptions,
    /// Cameras.
    #[serde(rename = "camera")]
    pub cameras: Vec<NewCamera>,
    /// Where events are posted.
    #[serde(rename = "webhook")]
    pub webhooks: Vec<WebhookOptions>,
    /// The broker that is told what happens.
    pub mqtt: Option<MqttOptions>,
    /// Where traces are exported to.
    pub traces: Option<TracesOptions>,
    /// Where it was read from: files that it names are looked for there.
    #[serde(skip)]
    folder: PathBuf,
}

/// `[history]`.
#[derive(Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HistoryConfig {
    /// A SQLite file, `postgres://USER@HOST/DATABASE`, or `none`.
    pub database: Option<String>,
    /// Days that tracks and events are kept; 0 for ever.
    pub keep_days: Option<f64>,
    /// Whether the best picture of each track is kept.
    pub snapshots: bool,
    /// Megabytes that they may take; 0 without end.
    pub max_mb: Option<u32>,
}

impl fmt::Debug for HistoryConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The URL may hold a password.
        f.debug_struct("HistoryConfig").field("keep_days", &self.keep_days).finish_non_exhaustive()
    }
}

impl HistoryConfig {
    /// What to do; `None` when no history is kept. What is left out is that of [`HistorySettings::in_folder`].
    ///
    /// # Errors
    /// A number is out of its range.
    pub fn settings(&self, folder: &Path) -> Result<Option<HistorySettings>> {
        let mut settings = HistorySettings::in_folder(folder);
        match self.database.as_deref() {
            None => {}
            Some("none") => return Ok(None),
            Some(url) if url.starts_with("postgres://") || url.starts_with("postgresql://") => {
                settings.place = Place::Postgres(url.into());
            }
            Some(url) if url.contains("://") => {
                bail!(
                    "`[history] database` is a file, postgres://USER@HOST/DATABASE or none: its URL is of another kind"
                )
            }
            Some(file) => settings.place = Place::Sqlite(file.into()),
        }
        if let Some(days) = self.keep_days {
            ensure!(
                (0.0..=36_500.0).contains(&days),
                "`[history] keep_days` is {days}: must be from 0 to 36500"
            );
            settings.keep = (days > 0.0).then(|| Duration::from_secs_f64(days * 86_400.0));
        }
        if let Some(megabytes) = self.max_mb {
            settings.max_bytes = (megabytes > 0).then(|| i64::from(megabytes) * 1_000_000);
        }
        Ok(Some(settings))
    }
}

impl Config {
    /// What differs from `other` besides cameras and who is told what happens: none of it can change while the service
    /// runs.
    pub fn differs(&self, other: &Config) -> Vec<String> {
        let Config {
            listen,
            state_dir,
            tls_cert,
            tls_key,
            admin_token_file,
            max_cameras,
            history,
            models,
            tracker,
            traces,
            webhooks: _,
            mqtt: _,
            cameras: _,
            folder: _,
        } = self;
        let settings = [
            ("listen", *listen == other.listen),
            ("state_dir", *state_dir == other.state_dir),
            ("tls_cert", *tls_cert == other.tls_cert),
            ("tls_key", *tls_key == other.tls_key),
            ("admin_token_file", *admin_token_file == other.admin_token_file),
            ("max_cameras", *max_cameras == other.max_cameras),
            ("history", *history == other.history),
            ("models", *models == other.models),
            ("tracker", *tracker == other.tracker),
            ("traces", *traces == other.traces),
        ];
        settings.into_iter().filter(|(_, same)| !same).map(|(name, _)| name.to_owned()).collect()
    }

    /// Reads a file.
    ///
    /// # Errors
    /// The file cannot be read, is no TOML, or has an unknown key or a wrong value; the message names
    /// the line.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the configuration {}", path.display()))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        Self::parse_in(&text, folder).with_context(|| format!("in the configuration {}", path.display()))
    }

    /// Reads a text.
    ///
    /// # Errors
    /// As [`Config::read`].
    pub fn parse(text: &str) -> Result<Self> {
        Self::parse_in(text, Path::new(""))
    }

    /// Files that `text` names are looked for in `folder`.
    fn parse_in(text: &str, folder: &Path) -> Result<Self> {
        let mut config: Config = toml::from_str(text).map_err(|error| {
            // The snippet that TOML's error quotes may hold a camera's password.
            let line =
                error.span().map_or(0, |span| text[..span.start.min(text.len())].matches('\n').count() + 1);
            anyhow::anyhow!("line {line}: {}", error.message())
        })?;
        config.folder = folder.to_owned();
        config.tracker.tuning = config.tracker.tuning.map(|file| folder.join(file));
        config.tracker.apply(TrackerConfig::default())?;
        let mut names: Vec<_> = config.cameras.iter().map(|c| c.id.as_str()).collect();
        names.sort_unstable();
        if let Some(twice) = names.windows(2).find(|w| w[0] == w[1]) {
            bail!("two cameras are named {:?}: names must differ", twice[0]);
        }
        Ok(config)
    }

    /// Takes out who is told what happens, checked; reads the files that hold their secrets.
    ///
    /// # Errors
    /// A setting of a webhook or of MQTT is wrong, or its file cannot be read.
    pub fn take_notify(&mut self) -> Result<NotifyPlan, NotifyError> {
        Ok(NotifyPlan {
            webhooks: WebhookOptions::check_all(std::mem::take(&mut self.webhooks), &self.folder)?,
            remembered: RememberedWebhooks::default(),
            mqtt: self.mqtt.take().map(|mqtt| mqtt.check(&self.folder)).transpose()?,
        })
    }

    /// Takes out which traces are exported where, checked; `None` when none are. Reads the files that hold secrets,
    /// and OpenTelemetry's variables of the environment.
    ///
    /// # Errors
    /// A setting is wrong, or its file cannot be read.
    pub fn take_traces(&mut self) -> Result<Option<TracesPlan>, TracesError> {
        TracesOptions::check(self.traces.take(), &self.folder, |name| std::env::var(name).ok())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::{Association, PairScore};

    #[test]
    fn history_is_kept_where_it_is_said() {
        let settings = |text: &str| Config::parse(text).unwrap().history.settings(Path::new("/state"));
        let kept = settings("").unwrap().unwrap();
        assert_eq!(kept.place, Place::Sqlite("/state/history.sqlite".into()));
        assert!(kept.keep == Some(Duration::from_secs(30 * 86_400)) && kept.max_bytes == Some(2_000_000_000));
        let kept = settings("[history]\ndatabase = \"/x.db\"\nkeep_days = 0\nmax_mb = 0").unwrap().unwrap();
        assert!(
            kept.place == Place::Sqlite("/x.db".into()) && kept.keep.is_none() && kept.max_bytes.is_none()
        );
        let kept = settings("[history]\ndatabase = \"postgres://u:s3cret@h/d\"").unwrap().unwrap();
        assert_eq!(kept.place, Place::Postgres("postgres://u:s3cret@h/d".into()));
        assert!(settings("[history]\ndatabase = \"none\"").unwrap().is_none());
        for wrong in ["database = \"mysql://u:s3cret@h/d\"", "keep_days = -1", "keep_days = nan"] {
            let Err(error) = settings(&format!("[history]\n{wrong}")) else { panic!("{wrong} is taken") };
            assert!(!error.to_string().contains("s3cret"), "{error}");
        }
        let config = Config::parse("[history]\ndatabase = \"postgres://u:s3cret@h/d\"").unwrap();
        assert!(!format!("{config:?}").contains("s3cret"), "{config:?}");
    }

    #[test]
    fn a_whole_file() {
        let config = Config::parse(
            r#"
            listen = "127.0.0.1:8080"
            [models]
            provider = "cpu"
            detector_size = [416, 352]
            [tracker]
            lost_s = 3.0
            coast_s = 2.5
            cost = "log-link"
            association = "huang"
            [[camera]]
            id = "gate"
            url = "rtsp://user:secret@10.0.0.2/stream1"
            transport = "tcp"
            [[camera]]
            id = "loop"
            url = "clip.mp4"
            loop = true
            [[camera.lines]]
            id = "door"
            points = [[0.5, 1], [0.5, 0]]
            [[camera.zones]]
            id = "floor"
            points = [[0, 0], [1, 0], [1, 1]]
            loiter_s = 30
            "#,
        )
        .unwrap();
        assert_eq!(config.cameras.len(), 2);
        assert_eq!(config.models.detector_size, Some((416, 352)));
        let rules = config.cameras[1].rules().unwrap();
        assert_eq!((rules.lines[0].points[0].y, rules.zones[0].loiter), (1.0, Some(30.0)));
        let tracker = config.tracker.apply(TrackerConfig::default()).unwrap();
        assert_eq!((tracker.life.lost, tracker.life.coast), (3.0, 2.5));
        assert_eq!(tracker.association.score, PairScore::LogLink);
        assert_eq!(tracker.association.method, Association::Huang);
    }

    #[test]
    fn mistakes_are_named() {
        for (text, expected) in [
            ("liste = 1", "unknown field `liste`"),
            ("[models]\nthread = 2", "line 2: unknown field `thread`"),
            ("[[camera]]\nid = \"a b\"\nurl = \"x\"", "not usable"),
            (
                "[[camera]]\nid = \"a\"\nurl = \"x\"\n[[camera]]\nid = \"a\"\nurl = \"y\"",
                "two cameras are named \"a\"",
            ),
            ("[tracker]\nhigh_score = 7", "tracker.high_score = 7: must be from 0 to 1"),
            ("[tracker]\ncost = \"x\"", "must be \"blend\" or \"log-link\""),
            ("[tracker]\nassociation = \"gru\"", "tracker.association: \"gru\" is no association: use iou, "),
            ("[tracker]\nlost_s = nan", "tracker.lost_s"),
            ("listen = \"here\"", "invalid socket address"),
        ] {
            let message = format!("{:#}", Config::parse(text).unwrap_err());
            assert!(message.contains(expected), "{text:?} gave {message:?}");
        }
    }

    #[test]
    fn a_tuning_is_found_beside_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("gakp.toml");
        std::fs::write(&file, "[tracker]\ntuning = \"tuned.toml\"\nlambda_c = 0.7\n").unwrap();
        let missing = format!("{:#}", Config::read(&file).unwrap_err());
        assert!(missing.contains("tracker.tuning") && missing.contains("tuned.toml"), "{missing}");

        let tuned = folder.path().join("tuned.toml");
        std::fs::write(&tuned, "[filter]\ncentre_walk = 0.25\n").unwrap();
        let config = Config::read(&file).unwrap();
        let filter = config.tracker.apply(TrackerConfig::default()).unwrap().filter;
        assert_eq!((filter.centre_walk, filter.adaptation.lambda), (0.25, 0.7));

        std::fs::write(&tuned, "[filter]\ncentre_walks = 0.25\n").unwrap();
        let wrong = format!("{:#}", Config::read(&file).unwrap_err());
        assert!(wrong.contains("tuned.toml") && wrong.contains("centre_walks"), "{wrong}");
    }

    #[test]
    fn a_mistake_does_not_quote_passwords() {
        let text = "[[camera]]\nid = \"a\"\nurl = \"rtsp://u:hunter2@h/s\"\ntransprot = \"tcp\"";
        let message = format!("{:#}", Config::parse(text).unwrap_err());
        assert!(message.contains("transprot") && !message.contains("hunter2"), "{message}");
    }
}
