//! `gakp bench`: speed beside its limit, and beside a peer doing the same job, in one run.

#[cfg(all(feature = "service", feature = "testcam"))]
mod cameras;
mod core;
mod crowd;
mod inference;
#[cfg(feature = "service")]
mod pipeline;
#[cfg(all(feature = "service", feature = "testcam"))]
mod scrape;
#[cfg(all(feature = "service", feature = "testcam"))]
mod served;

use std::process::Command;

use anyhow::{Context, Result, ensure};

/// Measures speed beside its limit.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

/// What to measure.
#[derive(Clone, Debug, clap::Subcommand)]
enum What {
    /// Each model by itself: its rate against the batch, and how much of it is ONNX Runtime's.
    Inference(inference::Args),
    /// The whole offline run against the models alone on the same frames, and against a peer.
    #[cfg(feature = "service")]
    Pipeline(pipeline::Args),
    /// The tracker alone on detections from files, one thread, by part, and against peers.
    Core(core::Args),
    /// The live service with more and more cameras, against the models alone.
    #[cfg(all(feature = "service", feature = "testcam"))]
    Cameras(cameras::Args),
}

/// Runs the command.
///
/// # Errors
/// What is measured, or a peer, fails.
pub fn run(args: Args) -> Result<()> {
    match args.what {
        What::Inference(args) => inference::run(args),
        #[cfg(feature = "service")]
        What::Pipeline(args) => pipeline::run(args),
        What::Core(args) => core::run(args),
        #[cfg(all(feature = "service", feature = "testcam"))]
        What::Cameras(args) => cameras::run(args),
    }
}

/// Runs a peer by the shell; what it prints.
fn run_peer(command: &str) -> Result<String> {
    let output = Command::new("sh").arg("-c").arg(command).output().context("cannot run the peer")?;
    ensure!(
        output.status.success(),
        "the peer failed ({}): {}",
        output.status,
        String::from_utf8_lossy(&output.stderr).trim()
    );
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// The first `X frames/s` in what a peer printed.
#[cfg(feature = "service")]
fn frames_per_second(text: &str) -> Result<f64> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let fps = words.windows(2).find(|w| w[1] == "frames/s").and_then(|w| w[0].parse().ok());
    fps.with_context(|| format!("the peer printed no `X frames/s`: {}", text.trim()))
}

/// Median, least and most.
fn spread(values: impl Iterator<Item = f64>) -> [f64; 3] {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    let median =
        if sorted.len() % 2 == 1 { sorted[middle] } else { (sorted[middle - 1] + sorted[middle]) / 2.0 };
    [median, sorted[0], sorted[sorted.len() - 1]]
}
