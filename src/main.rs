//! The `gakp` binary.

/// 0: done. 2: the arguments, the configuration, a model or an input is wrong; nothing was begun.
#[cfg(feature = "cli")]
fn main() -> std::process::ExitCode {
    use clap::Parser as _;
    // ONNX Runtime reports to its maker, names it, and keeps a database in the home folder, as soon as its library is
    // loaded, whatever its environment is told later. A service that watches people tells nobody.
    // SAFETY: no other thread runs yet that could read the environment.
    unsafe { std::env::set_var("ORT_DISABLE_TELEMETRY", "1") };
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
