//! The `gakp` binary.
fn main() {}
