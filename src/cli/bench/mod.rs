//! `gakp bench`: speed beside its limit, and beside a peer doing the same job, in one run.

#[cfg(all(feature = "service", feature = "testcam"))]
mod cameras;
mod core;
mod crowd;
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
    /// The whole offline run against the models alone on the same frames, and against a peer.
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

/// Median, least and most.
fn spread(values: impl Iterator<Item = f64>) -> [f64; 3] {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    let median =
        if sorted.len() % 2 == 1 { sorted[middle] } else { (sorted[middle - 1] + sorted[middle]) / 2.0 };
    [median, sorted[0], sorted[sorted.len() - 1]]
}
