//! `gakp track`: offline tracking of a video, a URL or a MOTChallenge sequence.

mod progress;
mod sequence;
mod video;

pub(super) use video::track as track_video;

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use super::models::ModelArgs;
use crate::config::{Config, ModelConfig, TrackerOptions};
use crate::infer::ModelSettings;

/// Tracks a video, a URL or a MOTChallenge sequence, and writes MOTChallenge rows.
///
/// A folder is taken as a MOTChallenge sequence: its det/det.txt holds the detections and no video is
/// needed. Anything else is what `gakp serve` takes as a camera, played as fast as it goes.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Video file, URL, or MOTChallenge sequence folder. Several folders: --out is then a folder.
    #[arg(required = true, value_name = "INPUT")]
    inputs: Vec<String>,
    /// File to write rows to (frame,id,x,y,w,h,confidence,-1,-1,-1); `-` is standard output. For
    /// several inputs a folder, one file SEQ.txt each.
    #[arg(long, short, value_name = "FILE")]
    out: PathBuf,
    /// Also write the video with boxes, ids and trails drawn in.
    #[arg(long, value_name = "OUT.mp4")]
    video: Option<PathBuf>,
    /// Stop after this many frames (needed for a live camera; otherwise Ctrl-C ends it).
    #[arg(long, value_name = "N")]
    frames: Option<u64>,
    /// Of a MOTChallenge sequence, track frames after L/2 + 1, renumbered from 1.
    #[arg(long)]
    second_half: bool,
    /// Of a MOTChallenge sequence, use the appearance vectors in det/det_features.npy (a row a row of
    /// det.txt).
    #[arg(long)]
    features: bool,
    /// Configuration file: its [models] and [tracker] hold here too.
    #[arg(long, short, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Tuning file of `gakp tune`: the noise of the Kalman filter.
    #[arg(long, value_name = "FILE")]
    tuning: Option<PathBuf>,
    #[command(flatten)]
    models: ModelArgs,
}

/// What every kind of input needs.
pub(super) struct Job {
    pub tracker: TrackerOptions,
    pub models: ModelSettings,
    pub frames: Option<u64>,
    pub second_half: bool,
    pub features: bool,
    pub video: Option<PathBuf>,
}

/// Runs the command.
///
/// # Errors
/// An input, a model or a setting is wrong, or the output cannot be written.
pub fn run(args: Args) -> Result<()> {
    let config = args.config.as_deref().map(Config::read).transpose()?.unwrap_or_default();
    let job = Job {
        tracker: config.tracker.tuned(args.tuning)?,
        models: ModelConfig::from(args.models).or(config.models).settings()?,
        frames: args.frames,
        second_half: args.second_half,
        features: args.features,
        video: args.video,
    };
    let folders = args.inputs.iter().filter(|input| Path::new(input).is_dir()).count();
    if folders > 0 && folders < args.inputs.len() {
        bail!("inputs are sequence folders and videos mixed: give one kind");
    }
    if folders > 0 && job.video.is_some() {
        bail!("--video needs a video: a MOTChallenge sequence folder has detections only");
    }
    match args.inputs.as_slice() {
        [input] if folders == 0 => {
            if job.second_half {
                bail!("--second-half is for MOTChallenge sequence folders");
            }
            if job.features {
                bail!("--features is for MOTChallenge sequence folders: a video's come from --reid");
            }
            let mut out = Output::create(&args.out)?;
            video::track(input, &job, &mut out).map(|_| ())
        }
        [folder] => {
            let mut out = Output::create(&args.out)?;
            sequence::track(Path::new(folder), &job, &mut out)
        }
        _ if folders == 0 => bail!("several inputs must be MOTChallenge sequence folders"),
        inputs => {
            std::fs::create_dir_all(&args.out)
                .with_context(|| format!("cannot make the folder {}", args.out.display()))?;
            sequence::track_all(inputs, &args.out, &job)
        }
    }
}

/// Where rows go. A file is not touched before there is something to write: a mistake in the input
/// must not cost the rows of an earlier run.
pub(super) struct Output {
    name: String,
    path: PathBuf,
    file: Option<Box<dyn Write>>,
}

impl Output {
    pub fn create(path: &Path) -> Result<Self> {
        let (name, path) = (path.display().to_string(), path.to_path_buf());
        if name == "-" {
            let file: Box<dyn Write> = Box::new(std::io::stdout().lock());
            return Ok(Self { name: "standard output".into(), path, file: Some(file) });
        }
        // What opening it would find out later is told now.
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        if path.is_dir() {
            bail!("cannot write {name}: it is a folder");
        }
        if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
            bail!("cannot write {name}: there is no folder {}", folder.display());
        }
        Ok(Self { name, path, file: None })
    }

    fn write(&mut self, rows: &[crate::mot::Row]) -> Result<()> {
        let text = crate::mot::write_results(rows);
        self.open()?.write_all(text.as_bytes()).with_context(|| format!("cannot write {}", self.name))
    }

    /// The end of a run that went well; the file is there even if it has no rows.
    fn finish(&mut self) -> Result<()> {
        self.open()?.flush().with_context(|| format!("cannot write {}", self.name))
    }

    fn open(&mut self) -> Result<&mut dyn Write> {
        let file = match self.file.take() {
            Some(file) => file,
            None => {
                let file = std::fs::File::create(&self.path);
                Box::new(std::io::BufWriter::new(
                    file.with_context(|| format!("cannot write {}", self.name))?,
                ))
            }
        };
        Ok(self.file.insert(file))
    }
}
