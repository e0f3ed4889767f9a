//! cli

#[cfg(feature = "testcam")]
pub mod camera;
