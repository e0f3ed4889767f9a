//! `gakp bench pipeline`: the whole offline run beside the models alone, and beside a peer.

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::{Arc, mpsc};

use anyhow::{Context, Result, bail, ensure};
use serde::Serialize;

use super::super::models::ModelArgs;
use super::super::track::{Job, Output, track_video};
use super::{frames_per_second, run_peer, spread};
use crate::config::{ModelConfig, TrackerOptions};
use crate::infer::bench::{AloneReport, FrameWork, models_alone};
use crate::infer::{ModelSettings, Models};
use crate::ingest::{self, Pacing, SourceEvent, SourceSpec};
use crate::track::{FrameInput, LinkRequest, Tracker, TrackerConfig};
use crate::types::{CameraId, Image, MediaTime};

/// The models alone are the detector (its input prepared beforehand), the appearance model and the link
/// scorer, run on the video's own frames, boxes and pairs, on as many threads as the provider's
/// arrangement has. The runs alternate, so that a machine that slows down slows all of them.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Video file.
    video: String,
    /// Rounds; medians are printed.
    #[arg(long, default_value_t = 5, value_name = "N")]
    rounds: usize,
    /// Command of a peer that tracks the same video and prints `X frames/s`; run by the shell.
    #[arg(long, value_name = "COMMAND")]
    peer: Option<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelArgs,
}

/// One round.
struct Round {
    whole: f64,
    alone: AloneReport,
    peer: Option<f64>,
}

#[derive(Serialize)]
struct Report {
    video: String,
    frames: usize,
    rounds: usize,
    threads: usize,
    /// Frames a second of the whole offline run: median, least, most.
    whole_fps: [f64; 3],
    /// Frames a second of the models alone.
    models_fps: [f64; 3],
    /// Whole over models, round by round.
    ratio: [f64; 3],
    /// Milliseconds of one thread a frame, inside the models alone.
    detect_ms: f64,
    reid_ms: f64,
    link_ms: f64,
    /// Milliseconds of all cores a frame that the whole run takes beyond the models.
    beside_models_ms: f64,
    /// Frames a second of the peer.
    peer_fps: Option<[f64; 3]>,
    /// Whole over peer, round by round.
    peer_ratio: Option<[f64; 3]>,
}

/// Runs the command.
///
/// # Errors
/// The video, a model or the peer fails.
pub fn run(args: Args) -> Result<()> {
    ensure!(args.rounds > 0, "--rounds is 0: give at least 1");
    let settings = ModelConfig::from(args.models).settings()?;
    let frames = decode(&args.video)?;
    let work = frame_work(&frames, &settings)?;
    let peer = |command: &str| frames_per_second(&run_peer(command)?);
    let job = Job {
        tracker: TrackerOptions::default(),
        models: settings.clone(),
        frames: None,
        second_half: false,
        features: false,
        video: None,
    };
    let rounds = (0..args.rounds)
        .map(|_| {
            let alone = models_alone(&settings, &work, work.len())?;
            let tracked = track_video(&args.video, &job, &mut Output::create(Path::new("/dev/null"))?)?;
            ensure!(
                tracked.frames == work.len() as u64,
                "{} frames tracked, {} decoded: the run is not whole",
                tracked.frames,
                work.len()
            );
            let whole = tracked.frames as f64 / tracked.seconds;
            Ok(Round { whole, alone, peer: args.peer.as_deref().map(peer).transpose()? })
        })
        .collect::<Result<Vec<_>>>()?;
    let report = report(args.video, &rounds);
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print(&report);
    }
    Ok(())
}

/// Every frame of the video, in order.
pub(super) fn decode(video: &str) -> Result<Vec<(Image, MediaTime)>> {
    let mut spec = SourceSpec::parse(video)?;
    ensure!(!spec.retries(), "{}: give a video file, not a camera", spec.url.redacted());
    spec.pacing = Pacing::AsFastAsPossible;
    let (send, frames) = mpsc::sync_channel(1);
    let mut failure = None;
    let handle = ingest::start(&CameraId::new("bench")?, spec, move |event| {
        let gone = match event {
            SourceEvent::Frame(frame) => send.send(Ok((frame.image, frame.time))).is_err(),
            SourceEvent::Lost { reason, .. } => send.send(Err(reason)).is_err(),
            _ => false,
        };
        if gone { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    let mut all = Vec::new();
    for event in frames {
        match event {
            Ok(frame) => all.push(frame),
            Err(reason) => failure = Some(reason),
        }
    }
    handle.stop();
    if let Some(reason) = failure {
        bail!("{video}: {reason}");
    }
    ensure!(!all.is_empty(), "{video}: no frame in it");
    Ok(all)
}

/// What the models are asked about each frame: the boxes that are detected, the pairs that are gated.
pub(super) fn frame_work(frames: &[(Image, MediaTime)], settings: &ModelSettings) -> Result<Vec<FrameWork>> {
    let models = Models::load(settings, Arc::new(()))?;
    let linker = models.linker.clone().context("tracking needs a link scorer: set --link to one")?;
    let mut tracker = Tracker::new(models.calibrate(TrackerConfig::default()));
    let mut request = LinkRequest::default();
    let mut work = Vec::with_capacity(frames.len());
    for (image, time) in frames {
        let detections = models.detector.detect_blocking(image.clone())?;
        let boxes: Vec<_> = detections.iter().map(|d| d.bbox).collect();
        let embeddings = match &models.embedder {
            Some(embedder) if !boxes.is_empty() => embedder.embed_blocking(image.clone(), boxes.clone())?,
            _ => Vec::new(),
        };
        let input = FrameInput {
            time: *time,
            width: f64::from(image.width),
            height: f64::from(image.height),
            detections: &detections,
            embeddings: &embeddings,
            shift: None,
        };
        tracker.predict(input, &mut request);
        let links = if request.is_empty() { Vec::new() } else { linker.score_blocking(request.clone())? };
        tracker.update(&links)?;
        work.push(FrameWork { image: image.clone(), boxes, link: request.clone() });
    }
    models.shutdown();
    Ok(work)
}

fn report(video: String, rounds: &[Round]) -> Report {
    let alone = &rounds[0].alone;
    let frames = alone.frames;
    let ms = |of: fn(&AloneReport) -> std::time::Duration| {
        spread(rounds.iter().map(|r| of(&r.alone).as_secs_f64() * 1e3 / frames as f64))[0]
    };
    let whole_fps = spread(rounds.iter().map(|r| r.whole));
    let models_fps = spread(rounds.iter().map(|r| r.alone.frames_per_second()));
    let peers = || rounds.iter().filter_map(|r| Some((r.whole, r.peer?)));
    let has_peer = peers().next().is_some();
    Report {
        video,
        frames,
        rounds: rounds.len(),
        threads: alone.threads,
        ratio: spread(rounds.iter().map(|r| r.whole / r.alone.frames_per_second())),
        detect_ms: ms(|a| a.detect),
        reid_ms: ms(|a| a.reid),
        link_ms: ms(|a| a.link),
        beside_models_ms: alone.threads as f64 * 1e3 * (1.0 / whole_fps[0] - 1.0 / models_fps[0]),
        whole_fps,
        models_fps,
        peer_fps: has_peer.then(|| spread(peers().map(|(_, peer)| peer))),
        peer_ratio: has_peer.then(|| spread(peers().map(|(whole, peer)| whole / peer))),
    }
}

fn print(report: &Report) {
    let row = |name: &str, [median, least, most]: [f64; 3], unit: &str| {
        println!("{name:<28} {median:8.2} {unit:<9} ({least:.2} to {most:.2})");
    };
    println!(
        "{}: {} frames, {} rounds, {} threads",
        report.video, report.frames, report.rounds, report.threads
    );
    row("whole offline run", report.whole_fps, "frames/s");
    row("models alone", report.models_fps, "frames/s");
    row("whole / models", report.ratio, "");
    for (name, ms) in [
        ("detector", report.detect_ms),
        ("appearance", report.reid_ms),
        ("link scorer", report.link_ms),
        ("everything beside the models", report.beside_models_ms),
    ] {
        println!("{name:<28} {ms:8.2} ms of a core a frame");
    }
    if let (Some(fps), Some(ratio)) = (report.peer_fps, report.peer_ratio) {
        row("peer", fps, "frames/s");
        row("whole / peer", ratio, "");
    }
}
