//! `gakp check`: everything that the service needs, tried and reported before it is started.

use std::fmt::Display;
use std::io::Write;
use std::net::TcpListener;
use std::ops::ControlFlow;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use serde_json::json;

use super::serve::{self, Plan};
use crate::api::NewCamera;
use crate::history::{Database, Place};
use crate::infer::Models;
use crate::ingest::{self, Opened, SourceEvent};
use crate::pipeline::source_spec;

/// Tries everything that `gakp serve` needs with the same settings, and reports: configuration, state folder, address,
/// models, history, receivers of events and traces, every camera. Nothing is changed, nothing is posted, no camera is
/// tracked.
///
/// Ends with 0 if all is well, with 2 if anything failed. A service that runs already holds its address.
#[derive(Clone, clap::Args)]
// Those of `serve` are a group of this name already.
#[group(id = "check")]
pub struct Args {
    #[command(flatten)]
    serve: serve::Args,
    /// Print one JSON object a line.
    #[arg(long)]
    json: bool,
    /// Longest that a camera may take for its first picture, seconds.
    #[arg(long, default_value_t = 15.0, value_name = "S")]
    patience: f64,
}

/// How one part fared.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Ok,
    /// It works, but not as well as it could.
    Note,
    Failed,
}

/// Prints findings as they come.
struct Findings {
    json: bool,
    failed: usize,
}

impl Findings {
    fn add(&mut self, verdict: Verdict, part: &str, text: impl Display) -> Result<()> {
        let word = match verdict {
            Verdict::Ok => "ok",
            Verdict::Note => "note",
            Verdict::Failed => "FAILED",
        };
        self.failed += usize::from(verdict == Verdict::Failed);
        let text = text.to_string();
        let mut out = std::io::stdout().lock();
        if self.json {
            writeln!(out, "{}", json!({"part": part, "verdict": word.to_lowercase(), "text": text}))?;
        } else {
            writeln!(out, "{word:<7} {part:<20} {text}")?;
        }
        Ok(())
    }

    /// A part that is well or not.
    fn of<T: Display>(&mut self, part: &str, found: Result<T, impl Display>) -> Result<()> {
        match found {
            Ok(text) => self.add(Verdict::Ok, part, text),
            Err(error) => self.add(Verdict::Failed, part, error),
        }
    }
}

/// Tries everything.
///
/// # Errors
/// Something failed; the report says what.
pub fn run(args: Args) -> Result<()> {
    let mut findings = Findings { json: args.json, failed: 0 };
    let plan = match Plan::new(args.serve) {
        Ok(plan) => plan,
        Err(error) => {
            findings.add(Verdict::Failed, "configuration", format!("{error:#}"))?;
            bail!("the configuration cannot be used; nothing else was tried");
        }
    };
    findings.add(Verdict::Ok, "configuration", format!("{} cameras in it", plan.cameras.len()))?;
    state_folder(&mut findings, &plan)?;
    let bound = TcpListener::bind(plan.listen).map(|_| format!("{} is free", plan.listen));
    findings.of(
        "address",
        bound.map_err(|error| format!("{}: {error}; choose another with --listen", plan.listen)),
    )?;
    models(&mut findings, &plan)?;
    history(&mut findings, &plan)?;
    receivers(&mut findings, &plan)?;
    cameras(&mut findings, &plan, Duration::try_from_secs_f64(args.patience)?)?;
    match findings.failed {
        0 => Ok(()),
        1 => bail!("one part failed"),
        failed => bail!("{failed} parts failed"),
    }
}

fn state_folder(findings: &mut Findings, plan: &Plan) -> Result<()> {
    let folder = &plan.state_dir;
    let remembered = plan.store.1.cameras.len();
    let tokens = if plan.gate.has_tokens() { "tokens are asked for" } else { "no token is asked for" };
    let shown = folder.display();
    if !folder.exists() {
        return findings.add(
            Verdict::Note,
            "state folder",
            format!("{shown} is not there; it will be made. {tokens}"),
        );
    }
    // A file without a name: it is gone when it is closed.
    let writable = tempfile_in(folder);
    let text = format!("{shown}: {remembered} cameras remembered, {tokens}");
    let why = |error| {
        format!("{shown} cannot be written: {error}; run as its owner, or give another with --state-dir")
    };
    findings.of("state folder", writable.map(|()| text).map_err(why))
}

fn tempfile_in(folder: &std::path::Path) -> std::io::Result<()> {
    let probe = folder.join(format!(".check-{}", std::process::id()));
    std::fs::OpenOptions::new().write(true).create_new(true).open(&probe)?;
    std::fs::remove_file(probe)
}

fn models(findings: &mut Findings, plan: &Plan) -> Result<()> {
    let settings = match plan.tracker.without_idle(&plan.models) {
        Ok(settings) => settings,
        Err(error) => return findings.add(Verdict::Failed, "models", format!("{error:#}")),
    };
    let started = Instant::now();
    let models = match Models::load(&settings, std::sync::Arc::new(())) {
        Ok(models) => models,
        Err(error) => {
            let text = format!("{error}; `bash deploy/setup.sh models` sets up those that gakp ships with");
            return findings.add(Verdict::Failed, "models", text);
        }
    };
    let report = &models.report;
    let names: Vec<_> =
        report.models.iter().map(|(task, name, _)| format!("{} {name}", task.as_str())).collect();
    let text = format!("{}; loaded in {:.1} s", names.join(", "), started.elapsed().as_secs_f64());
    findings.add(Verdict::Ok, "models", text)?;
    match &report.fallback {
        Some(why) => findings.add(Verdict::Note, "GPU", format!("models run on the CPU: {why}")),
        None => findings.add(Verdict::Ok, "GPU", format!("models run on {}", report.provider)),
    }
}

fn history(findings: &mut Findings, plan: &Plan) -> Result<()> {
    let Some(settings) = &plan.history else {
        return findings.add(Verdict::Note, "history", "none is kept");
    };
    if let Place::Sqlite(file) = &settings.place
        && !file.exists()
    {
        return findings.add(Verdict::Note, "history", format!("{} will be made", file.display()));
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let found = runtime.block_on(async {
        let database = Database::new(&settings.place)?;
        let answered = database.ping().await;
        database.close().await;
        answered.map(|()| format!("{} answers", database.name()))
    });
    findings.of("history", found)
}

/// Whoever is told what happens. They hear nothing of it but a connection.
fn receivers(findings: &mut Findings, plan: &Plan) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let found = runtime.block_on(async {
        let mut found = plan.notify.knock().await;
        if let Some(traces) = &plan.traces {
            found.push(("traces".to_owned(), traces.place(), traces.knock().await));
        }
        found
    });
    for (part, place, knocked) in found {
        let reached = format!("{place} is there");
        findings.of(&part, knocked.map(|()| reached).map_err(|error| format!("{place}: {error}")))?;
    }
    Ok(())
}

/// All at a time: one that does not answer costs nobody else's patience.
fn cameras(findings: &mut Findings, plan: &Plan, patience: Duration) -> Result<()> {
    let remembered = &plan.store.1.cameras;
    let configured = |id| plan.cameras.iter().any(|camera| camera.id == id);
    let others = remembered.iter().filter(|camera| !configured(camera.id.clone()));
    let all: Vec<&NewCamera> = plan.cameras.iter().chain(others).collect();
    if all.is_empty() {
        return findings.add(
            Verdict::Note,
            "cameras",
            "none yet; add them at the page or with POST /v1/cameras",
        );
    }
    let (tell, told) = mpsc::sync_channel(all.len());
    let mut open = vec![];
    for (index, camera) in all.iter().enumerate() {
        let spec = match source_spec(camera) {
            Ok(spec) => spec,
            Err(error) => {
                tell.send((index, Err(error.to_string())))?;
                continue;
            }
        };
        let (tell_events, started, mut opened) = (tell.clone(), Instant::now(), None);
        let handle = ingest::start(&camera.id, spec, move |event| {
            let found = match event {
                SourceEvent::Opened(what) => {
                    opened = Some(what);
                    return ControlFlow::Continue(());
                }
                SourceEvent::Frame(_) => Ok(seen(opened.as_ref(), started.elapsed())),
                SourceEvent::Lost { reason, .. } => Err(reason.to_string()),
                SourceEvent::Ended => Err("it ended before its first picture".to_owned()),
                SourceEvent::Corrupt | SourceEvent::Skipped { .. } => return ControlFlow::Continue(()),
            };
            // Room for one of each camera.
            let _ = tell_events.send((index, found));
            ControlFlow::Break(())
        });
        match handle {
            Ok(handle) => open.push(handle),
            Err(error) => tell.send((index, Err(error.to_string())))?,
        }
    }
    let until = Instant::now() + patience;
    let mut found: Vec<Option<Result<String, String>>> = vec![None; all.len()];
    while found.iter().any(Option::is_none) {
        let Ok((index, result)) = told.recv_timeout(until.saturating_duration_since(Instant::now())) else {
            break;
        };
        found[index] = Some(result);
    }
    for (camera, found) in all.iter().zip(found) {
        let late = || Err(format!("no picture within {} s", patience.as_secs_f64()));
        findings.of(&format!("camera {}", camera.id), found.unwrap_or_else(late))?;
    }
    // They stop by themselves; one that hangs is left behind with the process.
    drop(open);
    Ok(())
}

fn seen(opened: Option<&Opened>, after: Duration) -> String {
    let Some(Opened { width, height, fps, codec, decoder, transport, .. }) = opened else {
        return "a picture came".into();
    };
    let fps = fps.map_or(String::new(), |fps| format!(" at {fps:.4} frames/s"));
    let transport = transport.map_or(String::new(), |by| format!(" over {by:?}").to_lowercase());
    let after = after.as_secs_f64();
    format!(
        "{width}x{height} {codec}{fps}{transport}, decoded by {decoder}; first picture after {after:.1} s"
    )
}
