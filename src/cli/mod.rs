//! The command line: one file a subcommand.

#[cfg(feature = "service")]
pub mod ablate;
#[cfg(feature = "infer")]
pub mod bench;
#[cfg(feature = "testcam")]
pub mod camera;
#[cfg(feature = "service")]
pub mod check;
pub mod eval;
#[cfg_attr(not(feature = "service"), allow(dead_code, reason = "only the service changes its level"))]
mod log;
#[cfg(feature = "infer")]
mod models;
#[cfg(feature = "service")]
mod reload;
#[cfg(feature = "service")]
pub mod serve;
#[cfg(any(feature = "service", feature = "testcam"))]
mod signals;
pub mod simulate;
pub mod split;
#[cfg(feature = "service")]
pub mod token;
#[cfg(feature = "service")]
pub mod track;
#[cfg(feature = "learn")]
pub mod train;
#[cfg(feature = "learn")]
pub mod tune;

use anyhow::Context;

/// Point it at RTSP cameras, subscribe to tracks.
#[derive(clap::Parser)]
#[command(name = "gakp", version)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// What to log: error, warn, info, debug, trace, or directives such as `info,gakp::ingest=debug`.
    #[arg(long, global = true, env = "GAKP_LOG", default_value = "info", value_name = "LEVEL")]
    pub log: String,
    /// Log as one JSON object a line.
    #[arg(long, global = true)]
    pub log_json: bool,
}

/// Subcommands.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Run the service: cameras in, tracks out.
    #[cfg(feature = "service")]
    Serve(serve::Args),
    /// Try everything that the service needs and report: settings, models, GPU, address, history, cameras.
    #[cfg(feature = "service")]
    Check(check::Args),
    /// Make, list and revoke the tokens that the API asks for.
    #[cfg(feature = "service")]
    Token(token::Args),
    /// Track a video, a URL or a MOTChallenge sequence, and write MOTChallenge rows.
    #[cfg(feature = "service")]
    Track(track::Args),
    /// Score result files against MOTChallenge ground truth.
    Eval(eval::Args),
    /// Track sequences with every association of the paper, and print its table.
    #[cfg(feature = "service")]
    Ablate(ablate::Args),
    /// Serve a video as a real RTSP camera, over and over.
    #[cfg(feature = "testcam")]
    Camera(camera::Args),
    /// Measure speed beside its limit.
    #[cfg(feature = "infer")]
    Bench(Box<bench::Args>),
    /// Write a simulated world of pedestrians as MOTChallenge sequences.
    Simulate(simulate::Args),
    /// Cut MOTChallenge sequences in halves, to train on one and test on the other.
    Split(split::Args),
    /// Train the link scorer on MOTChallenge sequences.
    #[cfg(feature = "learn")]
    Train(train::Args),
    /// Tune the noise of the Kalman filter on MOTChallenge sequences.
    #[cfg(feature = "learn")]
    Tune(tune::Args),
}

/// Runs what the command line says.
///
/// # Errors
/// Whatever stops it; the message says what was wrong, where, and what to do.
pub fn run(cli: Cli) -> anyhow::Result<()> {
    log::start(&cli.log, cli.log_json).context("--log")?;
    match cli.command {
        #[cfg(feature = "service")]
        Command::Serve(args) => serve::run(args),
        #[cfg(feature = "service")]
        Command::Check(args) => check::run(args),
        #[cfg(feature = "service")]
        Command::Token(args) => token::run(args),
        #[cfg(feature = "service")]
        Command::Track(args) => track::run(args),
        Command::Eval(args) => eval::run(args),
        #[cfg(feature = "service")]
        Command::Ablate(args) => ablate::run(args),
        #[cfg(feature = "testcam")]
        Command::Camera(args) => camera::run(args),
        #[cfg(feature = "infer")]
        Command::Bench(args) => bench::run(*args),
        Command::Simulate(args) => simulate::run(args),
        Command::Split(args) => split::run(args),
        #[cfg(feature = "learn")]
        Command::Train(args) => train::run(args),
        #[cfg(feature = "learn")]
        Command::Tune(args) => tune::run(args),
    }
}
