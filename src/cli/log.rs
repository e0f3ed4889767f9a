//! Logs: to standard error, at a level that can be changed while the program runs.

use std::io::{self, IsTerminal};
use std::sync::{Mutex, OnceLock, PoisonError};

use anyhow::{Result, anyhow, ensure};
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry, fmt, reload};

/// The level in use, and what changes it.
struct Running {
    handle: reload::Handle<EnvFilter, Registry>,
    level: Mutex<String>,
}

static RUNNING: OnceLock<Running> = OnceLock::new();

/// Starts it: what a command prints goes to standard output, logs go to standard error.
///
/// # Errors
/// `level` is no level, or logging was started already.
pub fn start(level: &str, json: bool) -> Result<()> {
    let (filter, handle) = reload::Layer::new(filter(level)?);
    let layer = fmt::layer().with_writer(io::stderr);
    let registry = tracing_subscriber::registry().with(filter);
    let started = match json {
        true => registry.with(layer.json()).try_init(),
        false => registry.with(layer.with_ansi(io::stderr().is_terminal())).try_init(),
    };
    started.map_err(|e| anyhow!("cannot start logging: {e}"))?;
    // The first is the only one: starting twice is an error above.
    let _ = RUNNING.set(Running { handle, level: Mutex::new(level.to_owned()) });
    Ok(())
}

/// What is logged now.
pub fn level() -> String {
    RUNNING
        .get()
        .map_or_else(String::new, |it| it.level.lock().unwrap_or_else(PoisonError::into_inner).clone())
}

/// Logs otherwise from now on.
///
/// # Errors
/// `level` is no level; nothing changed.
pub fn set_level(level: &str) -> Result<()> {
    let running = RUNNING.get().ok_or_else(|| anyhow!("nothing is logged"))?;
    running.handle.reload(filter(level)?)?;
    level.clone_into(&mut running.level.lock().unwrap_or_else(PoisonError::into_inner));
    tracing::info!(level, "the log's level was changed");
    Ok(())
}

fn filter(level: &str) -> Result<EnvFilter> {
    // A word that is no level would be taken as a module's name, and all else would fall silent.
    let levels = level.split(',').filter(|part| !part.contains(['=', '[']));
    for word in levels.map(str::trim) {
        let known = word.parse::<LevelFilter>().is_ok();
        ensure!(known, "the log level {level:?}: {word:?} is none of off, error, warn, info, debug, trace");
    }
    // ONNX Runtime tells every step of its optimiser; say `ort=info` to hear it.
    EnvFilter::try_new(format!("ort=warn,{level}"))
        .map_err(|e| anyhow!("the log level {level:?}: {e}; use error, warn, info, debug or trace"))
}
