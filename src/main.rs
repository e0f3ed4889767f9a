//! The `gakp` binary.

/// 0: done. 2: the arguments, the configuration, a model or an input is wrong; nothing was begun.
#[cfg(feature = "cli")]
fn main() -> std::process::ExitCode {
    use clap::Parser as _;
    match gakp::cli::run(gakp::cli::Cli::parse()) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("gakp: {error:#}");
            std::process::ExitCode::from(2)
        }
    }
}

#[cfg(not(feature = "cli"))]
fn main() {
    eprintln!("gakp: built without its command line; build with the feature `cli`");
    std::process::exit(2);
}
