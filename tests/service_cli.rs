//! The command line, as the real binary: mistakes, and offline tracking.
#![cfg(all(feature = "cli", feature = "service", feature = "testcam"))]

#[path = "service/bench.rs"]
mod bench;
#[path = "service/check.rs"]
mod check;
#[path = "service/mistakes.rs"]
mod mistakes;
#[path = "service/support.rs"]
mod support;
#[path = "service/tokens.rs"]
mod tokens;
#[path = "service/track.rs"]
mod track;
