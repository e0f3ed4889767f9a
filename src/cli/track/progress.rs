//! A progress bar on a terminal, nothing elsewhere.

use indicatif::{ProgressBar, ProgressStyle};

/// A bar over `length` frames; a spinner when the length is not known. Hidden where standard error is
/// no terminal.
pub fn frames(length: Option<u64>, what: &str) -> ProgressBar {
    let (bar, form) = match length {
        Some(length) => {
            (ProgressBar::new(length), "{msg} {wide_bar} {pos}/{len} frames, {per_sec}, {eta} left")
        }
        None => (ProgressBar::new_spinner(), "{spinner} {msg} {pos} frames, {per_sec}, {elapsed}"),
    };
    let style = ProgressStyle::with_template(form).unwrap_or_else(|_| ProgressStyle::default_bar());
    bar.with_style(style).with_message(what.to_string())
}
