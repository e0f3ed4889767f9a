//! `gakp camera`: a test camera for everyone who has none.

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::bail;
use clap::ValueEnum;

use super::signals::Signals;
use crate::ingest::Transport;
use crate::ingest::testcam::{Codec, TestCamera, TestCameraConfig};

/// Serve a video over RTSP, looping, as if it were a camera.
// No `Debug`: it holds a password.
#[derive(clap::Args)]
pub struct Args {
    /// The video: H.264 and H.265 are sent as they are, anything else is transcoded first.
    file: PathBuf,
    /// Address and port to listen on; port 0 takes a free one.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8554")]
    listen: SocketAddr,
    /// Path of the URL.
    #[arg(long, default_value = "/live")]
    path: String,
    /// User that clients must name.
    #[arg(long, requires = "password")]
    user: Option<String>,
    /// Password that clients must give.
    #[arg(long, requires = "user", env = "GAKP_CAMERA_PASSWORD", hide_env_values = true)]
    password: Option<String>,
    /// What to send, instead of the file's own codec.
    #[arg(long, value_enum)]
    codec: Option<CodecName>,
    /// Frames per second, instead of the file's own.
    #[arg(long)]
    fps: Option<f64>,
    /// Let the stream end with the file.
    #[arg(long)]
    no_loop: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum CodecName {
    H264,
    H265,
}

/// Serves until SIGINT or SIGTERM.
pub fn run(args: Args) -> anyhow::Result<()> {
    let login = match (args.user, args.password) {
        (Some(user), Some(password)) if !user.contains(':') => Some((user, password)),
        (Some(_), Some(_)) => bail!("a user name cannot contain a colon"),
        _ => None,
    };
    eprintln!("reading {}", args.file.display());
    let camera = TestCamera::start(TestCameraConfig {
        file: args.file,
        listen: args.listen,
        path: args.path,
        login,
        codec: args.codec.map(|codec| match codec {
            CodecName::H264 => Codec::H264,
            CodecName::H265 => Codec::H265,
        }),
        fps: args.fps,
        looped: !args.no_loop,
        transport: Transport::Auto,
    })?;
    println!("{}", camera.url());
    eprintln!("serving {} frames of {:?}; Ctrl-C ends it", camera.frames(), camera.codec());

    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        Signals::listen()?.next().await;
        anyhow::Ok(())
    })?;
    camera.stop();
    Ok(())
}
