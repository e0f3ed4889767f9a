//! `gakp camera`: a test camera for everyone who has none.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::bail;
use clap::ValueEnum;
use clap::builder::{PossibleValuesParser, TypedValueParser};

use super::signals::Signals;
use crate::ingest::Transport;
use crate::ingest::testcam::{Codec, Fault, TestCamera, TestCameraConfig};

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
    /// Go wrong in this way, to see what a client makes of it.
    #[arg(long, value_name = "FAULT", value_parser = fault_names())]
    fault: Option<Fault>,
    /// Seconds until it goes wrong.
    #[arg(long, value_name = "S", default_value_t = 10.0, requires = "fault", value_parser = seconds)]
    fault_after: f64,
    /// Seconds until it is well again; without end by default.
    #[arg(long, value_name = "S", requires = "fault", value_parser = seconds)]
    fault_for: Option<f64>,
    /// Then begin anew, for ever.
    #[arg(long, requires = "fault_for")]
    fault_again: bool,
}

fn fault_names() -> impl TypedValueParser<Value = Fault> {
    PossibleValuesParser::new(Fault::ALL.map(Fault::name)).try_map(|name| name.parse::<Fault>())
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.0..=1e9).contains(seconds));
    seconds.ok_or_else(|| "a number of seconds, 0 to 1e9".into())
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
        faulty: args.fault.is_some(),
    })?;
    println!("{}", camera.url());
    eprintln!("serving {} frames of {:?}; Ctrl-C ends it", camera.frames(), camera.codec());

    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let after = Duration::from_secs_f64(args.fault_after);
    let lasts = args.fault_for.map(Duration::from_secs_f64);
    runtime.block_on(async {
        let mut signals = Signals::listen()?;
        if let Some(fault) = args.fault {
            tokio::select! {
                _ = signals.next() => return Ok(()),
                done = misbehave(&camera, fault, after, lasts, args.fault_again) => done?,
            }
        }
        signals.next().await;
        anyhow::Ok(())
    })?;
    camera.stop();
    Ok(())
}

/// Until the fault is there for good, or over for good.
async fn misbehave(
    camera: &TestCamera,
    fault: Fault,
    after: Duration,
    lasts: Option<Duration>,
    again: bool,
) -> anyhow::Result<()> {
    loop {
        tokio::time::sleep(after).await;
        camera.inject(Some(fault))?;
        eprintln!("goes wrong: {fault}");
        let Some(lasts) = lasts else { return Ok(()) };
        tokio::time::sleep(lasts).await;
        camera.inject(None)?;
        eprintln!("is well again");
        if !again {
            return Ok(());
        }
    }
}
