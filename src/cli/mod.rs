//! The command line.

pub mod eval;

/// Arguments of `gakp`.
#[derive(Clone, Debug, clap::Parser)]
#[command(name = "gakp", version, about)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// Subcommands.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum Command {
    /// Score result files against MOTChallenge ground truth.
    Eval(eval::Args),
}
