//! The `gakp` binary.

#[cfg(feature = "cli")]
fn main() -> std::process::ExitCode {
    use clap::Parser as _;
    let gakp::cli::Command::Eval(args) = gakp::cli::Cli::parse().command;
    match gakp::cli::eval::run(args) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("gakp: {error:#}");
            std::process::ExitCode::from(2)
        }
    }
}

#[cfg(not(feature = "cli"))]
fn main() {}
