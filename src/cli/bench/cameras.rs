//! `gakp bench cameras`: the live service with more and more cameras, beside the models alone.

use std::io::{BufRead, BufReader, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::thread::{self, JoinHandle};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::super::models::ModelArgs;
use super::frames_per_second;
use super::pipeline::{decode, frame_work};
use super::scrape::Scrape;
use super::served::Served;
use crate::config::ModelConfig;
use crate::infer::bench::{AloneReport, models_alone, models_at_pace};
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
    /// Command of a peer that tracks one camera, `$URL`, until it ends, and prints `X frames/s`; run by the shell, one
    /// process a camera, of more and more at a time.
    #[arg(long, value_name = "COMMAND")]
    peer: Option<String>,
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
    /// The same by what the threads do.
    work_ms: Vec<(&'static str, f64)>,
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
    /// Most cameras of those tried with which the peer keeps up.
    peer_cameras: Option<usize>,
    models_cpu_ms: f64,
    /// The same with one camera's frames as they come, on one thread.
    models_at_pace_cpu_ms: f64,
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
    let interval = Duration::from_secs_f64(1.0 / args.fps);
    let paced = (args.seconds as f64 * args.fps).ceil() as usize;
    let paced = models_at_pace(&settings, &work, paced, interval)?;
    drop(work);
    let cpu_ms = |report: &AloneReport| {
        (report.detect + report.reid + report.link).as_secs_f64() * 1e3 / report.frames as f64
    };
    let models_fps = alone.frames_per_second();

    let config = TestCameraConfig { fps: Some(args.fps), ..TestCameraConfig::new(&args.video) };
    let camera = TestCamera::start(config)?;
    let service = Served::start(&args.models, args.most)?;
    if !args.json {
        println!("{video} at {} frames/s a camera; ms", args.fps);
        println!("cameras  frames/s  tracked    p50    p95    p99  CPU a frame  resident MB");
    }
    let (mut rows, mut added) = (Vec::<Row>::new(), 0);
    for count in counts(args.most) {
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
        if !well {
            break;
        }
    }
    drop(service);
    let peer = |command: &str| peer_cameras(command, &args);
    let peer_cameras = args.peer.as_deref().map(peer).transpose()?;
    let good = rows.iter().filter(|row| is_well(row, args.within)).map(|row| row.cameras);
    let report = Report {
        video: args.video,
        fps: args.fps,
        cameras: good.max().unwrap_or(0),
        models_cameras: models_fps / args.fps,
        models_fps,
        peer_cameras,
        models_cpu_ms: cpu_ms(&alone),
        models_at_pace_cpu_ms: cpu_ms(&paced),
        rows,
    };
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print(&report, args.within);
    }
    Ok(())
}

/// Numbers of cameras to try, up to `most`: 1, 2, 4, 8, 12, 16 and so on.
fn counts(most: usize) -> impl Iterator<Item = usize> {
    let steps = (0..).map(|step| if step < 4 { 1 << step } else { 4 * (step - 1) });
    steps.take_while(move |count| *count < most).chain([most])
}

/// Most cameras of those tried with which the peer keeps up.
fn peer_cameras(command: &str, args: &Args) -> Result<usize> {
    let config =
        TestCameraConfig { fps: Some(args.fps), looped: false, ..TestCameraConfig::new(&args.video) };
    let camera = TestCamera::start(config)?;
    let mut most = 0;
    for count in counts(args.most) {
        let start = |_| {
            Command::new("sh").args(["-c", command]).env("URL", camera.url()).stdout(Stdio::piped()).spawn()
        };
        let peers =
            (0..count).map(start).collect::<std::io::Result<Vec<_>>>().context("cannot run the peer")?;
        let mut slowest = f64::INFINITY;
        for peer in peers {
            let output = peer.wait_with_output()?;
            ensure!(output.status.success(), "the peer failed ({})", output.status);
            slowest = slowest.min(frames_per_second(&String::from_utf8_lossy(&output.stdout))?);
        }
        if !args.json {
            println!("peer, {count} cameras: {slowest:.2} frames/s of the slowest");
        }
        if slowest < TRACKED * args.fps {
            break;
        }
        most = count;
    }
    Ok(most)
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
    println!("CPU of a frame of one camera, ms");
    for (work, ms) in &first.work_ms {
        println!("  {work:40}  {ms:5.2}");
    }
    println!("  {:40}  {:5.2}", "all", first.cpu_ms);
    for (how, ms) in
        [("at this pace", report.models_at_pace_cpu_ms), ("frame after frame", report.models_cpu_ms)]
    {
        let times = first.cpu_ms / ms;
        println!(
            "  {:40}  {ms:5.2}  of it the service takes {times:.2} times",
            format!("the models alone, {how}")
        );
    }
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
    if let Some(peer) = report.peer_cameras {
        let times = report.cameras as f64 / peer as f64;
        println!(
            "with how many cameras the peer keeps up: {peer}; the service takes {times:.1} times as many"
        );
    }
}

/// The service as it is, once the cameras have settled.
fn measure(service: &Served, cameras: usize, window: Duration) -> Result<Row> {
    service.wait_until_live(cameras)?;
    thread::sleep(SETTLE);
    let client = Client::start(service.address)?;
    let (before, cpu, works) = (Scrape::of(service)?, service.cpu()?, service.cpu_by_work()?);
    thread::sleep(window);
    let (cpu, now) = (service.cpu()? - cpu, service.cpu_by_work()?);
    let after = Scrape::of(service)?;
    let mut latencies = client.stop()?;
    ensure!(!latencies.is_empty(), "no message came within {} s", window.as_secs());
    latencies.sort_by(f64::total_cmp);
    let at = |share: f64| latencies[((latencies.len() - 1) as f64 * share).round() as usize];
    let more = |name: &str| after.sum(name) - before.sum(name);
    let (came, tracked) = (more("gakp_frames_in_total"), more("gakp_frames_tracked_total"));
    let stages = after.stages_since(&before);
    let a_frame = |time: Duration| time.as_secs_f64() * 1e3 / tracked.max(1.0);
    let since = |work: &'static str, time: Duration| {
        time.saturating_sub(works.get(work).copied().unwrap_or_default())
    };
    let mut work_ms: Vec<_> =
        now.into_iter().map(|(work, time)| (work, a_frame(since(work, time)))).collect();
    work_ms.sort_by(|a, b| b.1.total_cmp(&a.1));
    Ok(Row {
        cameras,
        fps: tracked / window.as_secs_f64(),
        tracked: tracked / came.max(1.0),
        latency_ms: [0.5, 0.95, 0.99].map(at),
        cpu_ms: a_frame(cpu),
        work_ms,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_and_more_cameras_up_to_the_most() {
        let all = |most| counts(most).collect::<Vec<_>>();
        assert_eq!(all(1), [1]);
        assert_eq!(all(3), [1, 2, 3]);
        assert_eq!(all(18), [1, 2, 4, 8, 12, 16, 18]);
    }
}
