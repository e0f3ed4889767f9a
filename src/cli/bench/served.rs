//! A service of one's own, as a process, for benchmarks.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};

use super::super::models::ModelArgs;

/// To load models, and for a camera to be there.
const PATIENCE: Duration = Duration::from_secs(60);

/// `gakp serve` on a free port, with a state folder of its own; both end with it.
pub struct Served {
    /// Its API.
    pub address: SocketAddr,
    child: Child,
    state: PathBuf,
}

impl Served {
    /// Starts it and waits until it answers.
    pub fn start(models: &ModelArgs, cameras: usize) -> Result<Self> {
        let state = std::env::temp_dir().join(format!("gakp-bench-{}", std::process::id()));
        let mut child = Command::new(std::env::current_exe()?)
            .args(["--log", "warn,gakp::cli=info", "serve", "--listen", "127.0.0.1:0", "--state-dir"])
            .arg(&state)
            .arg("--max-cameras")
            .arg(cameras.to_string())
            .args(models.to_args())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .context("cannot start the service")?;
        let errors = child.stderr.take().context("a pipe")?;
        let (told, address) = mpsc::channel();
        // To its end, so that the service never waits for a reader.
        thread::Builder::new().name("log".into()).spawn(move || {
            for line in BufReader::new(errors).lines().map_while(Result::ok) {
                let at = line
                    .split_once("the page is at http://")
                    .and_then(|(_, rest)| rest.split('/').next()?.parse().ok());
                match at {
                    Some(at) => drop(told.send(at)),
                    None if line.contains("INFO") => {}
                    None => eprintln!("service: {line}"),
                }
            }
        })?;
        let mut this = Self { address: ([127, 0, 0, 1], 0).into(), child, state };
        this.address =
            address.recv_timeout(PATIENCE).ok().context("the service does not start: see above")?;
        Ok(this)
    }

    /// The body of an answer that is well.
    pub fn request(&self, method: &str, path: &str, json: &str) -> Result<String> {
        let mut stream = TcpStream::connect(self.address).context("the service has ended")?;
        stream.set_read_timeout(Some(PATIENCE))?;
        let length = json.len();
        // HTTP/1.0: the answer ends with the connection and has no chunks.
        write!(
            stream,
            "{method} {path} HTTP/1.0\r\nHost: {}\r\nContent-Type: application/json\r\nContent-Length: {length}\r\n\r\n{json}",
            self.address
        )?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let (head, body) = answer.split_once("\r\n\r\n").context("the service's answer has no end")?;
        ensure!(
            head.split(' ').nth(1).is_some_and(|status| status.starts_with('2')),
            "{method} {path}: {answer}"
        );
        Ok(body.to_owned())
    }

    /// Adds a camera.
    pub fn add(&self, id: &str, url: &str) -> Result<()> {
        self.request("POST", "/v1/cameras", &serde_json::json!({"id": id, "url": url}).to_string()).map(drop)
    }

    /// Until so many cameras send frames.
    pub fn wait_until_live(&self, cameras: usize) -> Result<()> {
        let since = Instant::now();
        while since.elapsed() < PATIENCE {
            let metrics = self.request("GET", "/metrics", "")?;
            let up =
                metrics.lines().filter(|line| line.starts_with("gakp_camera_up{") && line.ends_with(" 1"));
            if up.count() >= cameras {
                return Ok(());
            }
            thread::sleep(Duration::from_millis(200));
        }
        bail!("not all of the {cameras} cameras are live within {} s", PATIENCE.as_secs())
    }

    /// Time that it has had of all cores.
    pub fn cpu(&self) -> Result<Duration> {
        cpu_of(&format!("/proc/{}/stat", self.child.id()))
    }

    /// The same of each thread that lives, by what it does. Threads that have ended are in [`Served::cpu`] alone.
    pub fn cpu_by_work(&self) -> Result<BTreeMap<&'static str, Duration>> {
        let mut sums = BTreeMap::new();
        for task in std::fs::read_dir(format!("/proc/{}/task", self.child.id()))? {
            let task = task?.path();
            // It may have ended meanwhile.
            let Ok(name) = std::fs::read_to_string(task.join("comm")) else { continue };
            let Ok(cpu) = cpu_of(&task.join("stat").to_string_lossy()) else { continue };
            *sums.entry(work_of(name.trim())).or_default() += cpu;
        }
        Ok(sums)
    }

    /// Resident memory, MB (of 10^6 bytes).
    pub fn resident(&self) -> Result<f64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).context("VmRSS")?;
        let kilobytes: f64 = line.trim().trim_end_matches(" kB").parse()?;
        Ok(kilobytes * 1024e-6)
    }
}

/// Of a process or a thread (`man 5 proc`, `/proc/PID/stat`).
fn cpu_of(stat: &str) -> Result<Duration> {
    let stat = std::fs::read_to_string(stat)?;
    // After the name, which may hold anything: user and system time are the 12th and 13th, in hundredths.
    let (_, rest) = stat.rsplit_once(") ").context("/proc/PID/stat")?;
    let ticks = rest.split(' ').skip(11).take(2).map(str::parse::<u64>).sum::<Result<u64, _>>()?;
    Ok(Duration::from_millis(10 * ticks))
}

/// What a thread of this name does.
fn work_of(name: &str) -> &'static str {
    let works = [
        ("detect-", "detector"),
        ("reid-", "appearance"),
        ("link-", "link scorer"),
        ("tracker", "tracker"),
        ("async", "stages and API"),
        // GStreamer's queue before the decoder.
        ("queue", "decoder"),
        ("sqlx-", "history"),
    ];
    // The rest is GStreamer's and the camera's own: sockets, RTP, the jitter buffer.
    works.iter().find(|(prefix, _)| name.starts_with(prefix)).map_or("receiving", |(_, work)| work)
}

impl Drop for Served {
    fn drop(&mut self) {
        // It may have ended already, and there is nobody to tell.
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.state);
    }
}
