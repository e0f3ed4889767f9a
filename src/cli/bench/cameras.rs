//! `gakp bench cameras`: the live service with more and more cameras, beside the models alone.

use std::io::{BufRead, BufReader, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::path::PathBuf;
use std::thread::{self, JoinHandle};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::super::models::ModelArgs;
use super::pipeline::{decode, frame_work};
use super::scrape::Scrape;
use super::served::Served;
use crate::config::ModelConfig;
use crate::infer::bench::models_alone;
use crate::ingest::testcam::{TestCamera, TestCameraConfig};

/// The service is a process of its own, as `gakp serve` starts it; every camera shows the same video over RTSP. Cameras are
/// added while it runs, until messages come late or frames are dropped.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Video file that every camera shows.
    video: PathBuf,
    /// Frames a second of a camera.
    #[arg(long, default_value_t = 10.0, value_name = "FPS")]
    fps: f64,
    /// How long each number of cameras is measured.
    #[arg(long, default_value_t = 20, value_name = "SECONDS")]
    seconds: u64,
    /// Most cameras to try.
    #[arg(long, default_value_t = 64, value_name = "N")]
    most: usize,
    /// Ends when 95 of 100 messages do not come within so many milliseconds of the capture.
    #[arg(long, default_value_t = 200.0, value_name = "MS")]
    within: f64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelArgs,
}

/// Frames that must be tracked, of all that come.
const TRACKED: f64 = 0.99;
/// Between a camera's first frame and the measurement.
const SETTLE: Duration = Duration::from_secs(4);

/// 50, 95 and 99 of 100, milliseconds.
type Quantiles = [f64; 3];

/// One number of cameras.
#[derive(Clone, Debug, Serialize)]
struct Row {
    cameras: usize,
    /// Frames tracked a second, all cameras together.
    fps: f64,
    /// Of the frames that came.
    tracked: f64,
    /// From capture to the message at a client.
    latency_ms: Quantiles,
    /// Time of all cores a tracked frame.
    cpu_ms: f64,
    /// MB (of 10^6 bytes).
    resident_mb: f64,
    /// By stage, from the service's histograms.
    stages_ms: Vec<(String, Quantiles)>,
}

#[derive(Serialize)]
struct Report {
    video: PathBuf,
    fps: f64,
    rows: Vec<Row>,
    /// Most cameras of those tried whose frames were tracked in time.
    cameras: usize,
    /// What the models alone would take.
    models_cameras: f64,
    models_fps: f64,
    models_cpu_ms: f64,
}

/// Runs the command.
///
/// # Errors
/// The video or a model fails, or the service does not start or ends.
pub fn run(args: Args) -> Result<()> {
    ensure!(args.fps > 0.0 && args.seconds > 0 && args.most > 0, "--fps, --seconds and --most are above 0");
    let settings = ModelConfig::from(args.models.clone()).settings()?;
    let video = args.video.to_str().context("the video's name is not UTF-8")?;
    let work = frame_work(&decode(video)?, &settings)?;
    let alone = models_alone(&settings, &work, work.len())?;
    drop(work);
    let models_cpu = (alone.detect + alone.reid + alone.link).as_secs_f64() * 1e3 / alone.frames as f64;
    let models_fps = alone.frames_per_second();

    let config = TestCameraConfig { fps: Some(args.fps), ..TestCameraConfig::new(&args.video) };
    let camera = TestCamera::start(config)?;
    let service = Served::start(&args.models, args.most)?;
    if !args.json {
        println!("{video} at {} frames/s a camera; ms", args.fps);
        println!("cameras  frames/s  tracked    p50    p95    p99  CPU a frame  resident MB");
    }
    let (mut rows, mut added) = (Vec::<Row>::new(), 0);
    for count in (0..).map(|step| if step < 4 { 1 << step } else { 4 * (step - 1) }) {
        let count = count.min(args.most);
        while added < count {
            service.add(&format!("camera-{added}"), &camera.url())?;
            added += 1;
        }
        let row = measure(&service, count, Duration::from_secs(args.seconds))?;
        if !args.json {
            let [p50, p95, p99] = row.latency_ms;
            println!(
                "{count:7}  {:8.1}  {:6.1}%  {p50:5.1}  {p95:5.1}  {p99:5.1}  {:11.2}  {:11.1}",
                row.fps,
                100.0 * row.tracked,
                row.cpu_ms,
                row.resident_mb
            );
        }
        let well = is_well(&row, args.within);
        rows.push(row);
        if !well || count == args.most {
            break;
        }
    }
    let good = rows.iter().filter(|row| is_well(row, args.within)).map(|row| row.cameras);
    let report = Report {
        video: args.video,
        fps: args.fps,
        cameras: good.max().unwrap_or(0),
        models_cameras: models_fps / args.fps,
        models_fps,
        models_cpu_ms: models_cpu,
        rows,
    };
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print(&report, args.within);
    }
    Ok(())
}

fn is_well(row: &Row, within: f64) -> bool {
    row.latency_ms[1] <= within && row.tracked >= TRACKED
}

fn print(report: &Report, within: f64) {
    let first = &report.rows[0];
    println!(
        "a frame of one camera, by stage              p50    p95    p99   (interpolated in the buckets of /metrics)"
    );
    for (stage, [p50, p95, p99]) in &first.stages_ms {
        println!("  {stage:40}  {p50:5.1}  {p95:5.1}  {p99:5.1}");
    }
    println!(
        "CPU of a frame with one camera {:.2} ms, of the models alone {:.2} ms: {:.2} times",
        first.cpu_ms,
        report.models_cpu_ms,
        first.cpu_ms / report.models_cpu_ms
    );
    if let Some(last) = report.rows.iter().rfind(|row| row.cameras > 1 && is_well(row, within)) {
        let each = (last.resident_mb - first.resident_mb) / (last.cameras - 1) as f64;
        println!("memory with one camera {:.0} MB, each further {each:.1} MB", first.resident_mb);
    }
    println!(
        "cameras whose p95 is within {within} ms and of whose frames {} % are tracked: {}; by the models alone ({:.0} frames/s): {:.1}",
        100.0 * TRACKED,
        report.cameras,
        report.models_fps,
        report.models_cameras
    );
}

/// The service as it is, once the cameras have settled.
fn measure(service: &Served, cameras: usize, window: Duration) -> Result<Row> {
    service.wait_until_live(cameras)?;
    thread::sleep(SETTLE);
    let client = Client::start(service.address)?;
    let (before, cpu) = (Scrape::of(service)?, service.cpu()?);
    thread::sleep(window);
    let (after, cpu) = (Scrape::of(service)?, service.cpu()? - cpu);
    let mut latencies = client.stop()?;
    ensure!(!latencies.is_empty(), "no message came within {} s", window.as_secs());
    latencies.sort_by(f64::total_cmp);
    let at = |share: f64| latencies[((latencies.len() - 1) as f64 * share).round() as usize];
    let more = |name: &str| after.sum(name) - before.sum(name);
    let (came, tracked) = (more("gakp_frames_in_total"), more("gakp_frames_tracked_total"));
    let stages = after.stages_since(&before);
    Ok(Row {
        cameras,
        fps: tracked / window.as_secs_f64(),
        tracked: tracked / came.max(1.0),
        latency_ms: [0.5, 0.95, 0.99].map(at),
        cpu_ms: cpu.as_secs_f64() * 1e3 / tracked.max(1.0),
        resident_mb: service.resident()?,
        stages_ms: stages,
    })
}

/// A subscriber to every camera's tracks, as server-sent events.
struct Client {
    stream: TcpStream,
    reader: JoinHandle<Vec<(SystemTime, String)>>,
}

#[derive(Deserialize)]
struct Message {
    capture_ts: Option<String>,
}

impl Client {
    fn start(address: SocketAddr) -> Result<Self> {
        let mut stream = TcpStream::connect(address)?;
        write!(
            stream,
            "GET /v1/tracks/stream HTTP/1.0\r\nHost: {address}\r\nAccept: text/event-stream\r\n\r\n"
        )?;
        let lines = BufReader::new(stream.try_clone()?).lines();
        // Only the time is taken here; what it says is looked at when the measurement is over.
        let read = move || {
            let data = |line: String| Some((SystemTime::now(), line.strip_prefix("data:")?.to_owned()));
            lines.map_while(Result::ok).filter_map(data).collect()
        };
        let reader = thread::Builder::new().name("subscriber".into()).spawn(read)?;
        Ok(Self { stream, reader })
    }

    /// Ends; how old each message was when it came, milliseconds.
    fn stop(self) -> Result<Vec<f64>> {
        self.stream.shutdown(Shutdown::Both)?;
        let came = self.reader.join().map_err(|_| anyhow::anyhow!("the subscriber panicked"))?;
        let aged = |(at, text): (SystemTime, String)| {
            let message: Message = serde_json::from_str(&text).context("a message of the service")?;
            // A gap has no capture.
            message.capture_ts.map(|captured| Ok(age(at, captured.parse()?))).transpose()
        };
        came.into_iter().map(aged).filter_map(Result::transpose).collect()
    }
}

fn age(at: SystemTime, captured: Timestamp) -> f64 {
    let at = at.duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as i128;
    (at - captured.as_nanosecond()) as f64 * 1e-6
}
