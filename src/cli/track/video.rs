//! Videos and URLs: through the service's own stages, every frame in order.

use std::path::Path;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail};
use tokio::sync::mpsc;

use super::super::signals::Signals;
use super::{Job, Output, progress};
use crate::infer::Models;
use crate::ingest::{Pacing, Pixels, SourceSpec, VideoWriter};
use crate::mot::report_rows;
use crate::pipeline::{Camera, CameraPlan, CameraState, Collector, Lanes, Policy};
use crate::publish::{Picture, Rgb, RgbConverter, Trails, annotate};
use crate::telemetry::Metrics;
use crate::track::TrackerConfig;
use crate::types::{CameraId, Epoch};

/// Tracked frames that may wait to be written.
const UNWRITTEN: usize = 4;

/// How much was tracked, and how long it took from opening the source to the last frame.
pub struct Tracked {
    /// Frames.
    pub frames: u64,
    /// Seconds; loading models is not in it.
    pub seconds: f64,
}

/// Tracks `input` to its end, to `job.frames`, or until Ctrl-C.
pub fn track(input: &str, job: &Job, out: &mut Output) -> Result<Tracked> {
    let mut spec = SourceSpec::parse(input)?;
    spec.pacing = Pacing::AsFastAsPossible;
    spec.check()?;
    let metrics = Metrics::new()?;
    let models = Models::load(&job.tracker.without_idle(&job.models)?, metrics.clone())?;
    let tracker = job.tracker.apply(models.calibrate(TrackerConfig::default()))?;
    models.check_suits(tracker.association.method)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .thread_name("async")
        .worker_threads(1)
        .enable_all()
        .build()?;
    let tracked = runtime.block_on(run(spec, models, tracker, metrics, job, out))?;
    out.finish()?;
    Ok(tracked)
}

async fn run(
    spec: SourceSpec,
    models: Models,
    tracker: TrackerConfig,
    metrics: std::sync::Arc<Metrics>,
    job: &Job,
    out: &mut Output,
) -> Result<Tracked> {
    let lanes = Lanes::start(models, metrics)?;
    let name = spec.url.redacted().to_string();
    let live = spec.retries();
    let (collector, mut tracked) = mpsc::channel(UNWRITTEN);
    let plan = CameraPlan {
        id: CameraId::new("input")?,
        epoch: Epoch(SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())),
        spec,
        tracker,
        outlet: Box::new(Collector(collector)),
        policy: if live { Policy::NewestWins } else { Policy::Wait },
    };
    let camera = Camera::start(&lanes, plan).await?;
    let short =
        Path::new(&name).file_name().map_or_else(|| name.clone(), |n| n.to_string_lossy().into_owned());
    let bar = progress::frames(job.frames, &short);
    let mut film = job.video.as_deref().map(Film::new);
    let (mut frames, start) = (0u64, Instant::now());
    let mut failure = None;
    // One listener for the whole run: a signal that comes while a picture is drawn counts as well.
    let mut signals = Signals::listen()?;
    loop {
        let picture = tokio::select! {
            () = signals.next() => None,
            picture = tracked.recv() => picture,
        };
        let Some(picture) = picture else { break };
        let condition = camera.view().condition();
        if let (Some(length), Some(fps)) = (
            condition.opened.as_ref().and_then(|o| o.duration),
            condition.opened.as_ref().and_then(|o| o.fps),
        ) {
            bar.set_length((length.as_secs_f64() * fps).round() as u64);
        }
        frames += 1;
        bar.set_position(frames);
        let written = out.write(&report_rows(&picture.tracks).collect::<Vec<_>>()).and_then(|()| {
            let fps = condition.opened.as_ref().and_then(|o| o.fps);
            // Drawing is the command's own work; it has no other async task to hold up.
            film.as_mut().map_or(Ok(()), |film| film.add(&picture, fps))
        });
        if let Err(error) = written {
            failure = Some(error);
            break;
        }
        if job.frames.is_some_and(|most| frames >= most) {
            break;
        }
    }
    bar.finish_and_clear();
    // Closed first: the tracker's thread must not wait for a reader that is gone.
    drop(tracked);
    let (view, seconds) = (camera.view().clone(), start.elapsed().as_secs_f64());
    camera.stop().await;
    lanes.shutdown().await;
    if let Some(film) = film {
        film.finish()?;
    }
    if let Some(error) = failure {
        return Err(error);
    }
    let condition = view.condition();
    if let (CameraState::Failed, Some(reason)) = (condition.state, condition.last_failure) {
        bail!("{name}: {reason}");
    }
    tracing::info!(frames, seconds, frames_per_second = frames as f64 / seconds, "tracked");
    Ok(Tracked { frames, seconds })
}

/// The annotated copy.
struct Film<'a> {
    path: &'a Path,
    writer: Option<VideoWriter>,
    converter: RgbConverter,
    canvas: Rgb,
    trails: Trails,
}

impl<'a> Film<'a> {
    fn new(path: &'a Path) -> Self {
        Self {
            path,
            writer: None,
            converter: RgbConverter::default(),
            canvas: Rgb::default(),
            trails: Trails::default(),
        }
    }

    fn add(&mut self, picture: &Picture, fps: Option<f64>) -> Result<()> {
        self.converter.convert(picture, usize::MAX, &mut self.canvas)?;
        self.trails.push(&picture.tracks);
        annotate(&mut self.canvas, &picture.tracks, &self.trails);
        let writer = match &mut self.writer {
            Some(writer) => writer,
            none => {
                none.insert(VideoWriter::create(self.path, picture.size(), fps.unwrap_or(25.0), Pixels::Rgb)?)
            }
        };
        writer.write_rgb(&self.canvas.data, picture.tracks.time).context("writing the annotated video")
    }

    fn finish(self) -> Result<()> {
        match self.writer {
            Some(writer) => writer.finish().context("finishing the annotated video"),
            None => Ok(()),
        }
    }
}
