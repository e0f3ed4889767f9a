//! Tools from Debian packages, Prometheus as a real process, and what a dashboard asks of it.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

/// The repository's root.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A file of the repository.
#[track_caller]
pub fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Names of the files in a folder of the repository that end in `suffix`, in order.
pub fn files(folder: &str, suffix: &str) -> Vec<String> {
    fn walk(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
            let path = entry.unwrap().path();
            if path.is_dir() { walk(&path, found) } else { found.push(path) }
        }
    }
    let mut found = Vec::new();
    walk(&root().join(folder), &mut found);
    let mut names: Vec<_> = found
        .iter()
        .map(|path| path.strip_prefix(root()).unwrap().to_str().unwrap().to_owned())
        .filter(|name| name.ends_with(suffix))
        .collect();
    names.sort();
    names
}

/// A command whose program must be there: a check that is skipped where nobody looks is none.
fn command(program: &str) -> Command {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let there = std::env::split_paths(&path).any(|folder| folder.join(program).is_file());
    assert!(there, "{program} is missing: run `bash deploy/setup.sh test-packages`");
    Command::new(program)
}

/// Runs a tool to its end, which must be a good one.
#[track_caller]
pub fn tool(program: &str, args: &[&str], folder: &Path) -> String {
    let Output { status, stdout, stderr } =
        command(program).args(args).current_dir(folder).stdin(Stdio::null()).output().unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert!(status.success(), "{program} {args:?}: {status}\n{said}");
    said
}

/// A comment that is a setting: `# scheme: https`, `# - job_name: dcgm`, and the list below such a key.
fn is_setting(comment: &str) -> bool {
    let text = comment.trim_start_matches(['-', ' ']);
    text.split_once(':').is_some_and(|(key, rest)| {
        !key.is_empty()
            && key.bytes().all(|b| b.is_ascii_lowercase() || b == b'_')
            && (rest.is_empty() || rest.starts_with(' '))
    })
}

/// A YAML text with what is commented out in it put in force, from the line that contains `first` to
/// the next that is no such comment; everywhere when `first` is empty.
pub fn uncommented(text: &str, first: &str) -> String {
    let (mut out, mut inside) = (String::new(), first.is_empty());
    for line in text.lines() {
        let comment = line.trim_start().strip_prefix("# ").filter(|c| is_setting(c));
        inside = first.is_empty() || comment.is_some() && (inside || line.contains(first));
        match comment {
            Some(setting) if inside => {
                let indent = line.len() - line.trim_start().len();
                writeln!(out, "{:indent$}{setting}", "").unwrap();
            }
            _ => writeln!(out, "{line}").unwrap(),
        }
    }
    out
}

/// Posts JSON to the service as the bearer of a token; the answer's status.
pub fn post(service: SocketAddr, token: &str, path: &str, body: &Value) -> u16 {
    let mut stream = TcpStream::connect(service).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let body = body.to_string();
    write!(
        stream,
        "POST {path} HTTP/1.0\r\nHost: {service}\r\nAuthorization: Bearer {token}\r\n\
         Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer.split(' ').nth(1).and_then(|status| status.parse().ok()).expect(&answer)
}

/// Serves one text to whoever asks for whatever: an exporter.
pub fn exporter(text: &'static str) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let Ok(mut stream) = stream else { return };
            let mut request = [0; 4096];
            // Who hangs up early has no use for an answer.
            let _ = stream.read(&mut request);
            let head = "HTTP/1.0 200 OK\r\nContent-Type: text/plain; version=0.0.4\r\n";
            let _ = write!(stream, "{head}Content-Length: {}\r\n\r\n{text}", text.len());
        }
    });
    address
}

/// A real Prometheus with this repository's configuration and rules, which asks every second.
pub struct Prometheus {
    child: Child,
    address: SocketAddr,
    folder: tempfile::TempDir,
}

impl Prometheus {
    /// Starts it for a service, its token, and an exporter of GPU metrics; waits until it is ready.
    pub fn start(service: SocketAddr, token: &str, gpu: SocketAddr) -> Self {
        // Another process may take the port between its choice and its use.
        (0..5).find_map(|_| Self::try_start(service, token, gpu)).expect("a port for Prometheus")
    }

    fn try_start(service: SocketAddr, token: &str, gpu: SocketAddr) -> Option<Self> {
        let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let config = uncommented(&read("deploy/prometheus/prometheus.yml"), "job_name: dcgm")
            .replace("scrape_interval: 15s", "scrape_interval: 1s")
            .replace("evaluation_interval: 15s", "evaluation_interval: 1s")
            .replace("scrape_timeout: 5s", "scrape_timeout: 1s")
            .replace("127.0.0.1:9400", &gpu.to_string())
            .replace("127.0.0.1:9090", &address.to_string());
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        std::fs::create_dir(folder.path().join("secrets")).unwrap();
        write("secrets/gakp.token", token);
        write("prometheus.yml", &config);
        write("targets.yml", &format!("- targets: [\"{service}\"]\n"));
        write("gakp.rules.yml", &read("deploy/prometheus/gakp.rules.yml"));
        let log = std::fs::File::create(folder.path().join("log")).unwrap();
        let child = command("prometheus")
            .args(["--config.file=prometheus.yml", "--storage.tsdb.path=data"])
            .arg(format!("--web.listen-address={address}"))
            .current_dir(folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap();
        let mut started = Self { child, address, folder };
        let since = Instant::now();
        loop {
            if started.get("/-/ready").is_some_and(|(status, _)| status == 200) {
                return Some(started);
            }
            if started.child.try_wait().unwrap().is_some() {
                assert!(started.log().contains("address already in use"), "{}", started.log());
                return None;
            }
            assert!(since.elapsed() < Duration::from_secs(20), "not ready: {}", started.log());
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    /// Status and body; nothing while it does not listen yet.
    fn get(&self, path: &str) -> Option<(u16, String)> {
        let mut stream = TcpStream::connect(self.address).ok()?;
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        // HTTP/1.0: the answer ends with the connection and has no chunks.
        write!(stream, "GET {path} HTTP/1.0\r\nHost: {}\r\n\r\n", self.address).ok()?;
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).ok()?;
        let text = String::from_utf8_lossy(&bytes);
        let (head, body) = text.split_once("\r\n\r\n")?;
        Some((head.split(' ').nth(1)?.parse().ok()?, body.to_owned()))
    }

    /// An answer of the API, or what it says is wrong.
    pub fn api(&self, path: &str, parameters: &[(&str, &str)]) -> Result<Value, String> {
        let query: Vec<_> = parameters.iter().map(|(k, v)| format!("{k}={}", percent(v))).collect();
        let (_, body) = self.get(&format!("/api/v1/{path}?{}", query.join("&"))).ok_or("no answer")?;
        let mut answer: Value = serde_json::from_str(&body).map_err(|e| format!("{e}: {body}"))?;
        if answer["status"] == "success" {
            Ok(answer["data"].take())
        } else {
            Err(answer["error"].to_string())
        }
    }

    /// How many series with a number in them a query finds now, or over the last seconds.
    pub fn series(&self, query: &str, instant: bool) -> Result<usize, String> {
        let data = if instant {
            self.api("query", &[("query", query)])?
        } else {
            let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs();
            let (from, to) = ((now - 10).to_string(), now.to_string());
            self.api("query_range", &[("query", query), ("start", &from), ("end", &to), ("step", "1")])?
        };
        let result = data["result"].as_array().ok_or_else(|| format!("no series but {data}"))?;
        let number = |point: &Value| point[1].as_str().is_some_and(|v| v.parse().is_ok_and(f64::is_finite));
        let has_data = |series: &&Value| match series["values"].as_array() {
            Some(points) => points.iter().any(number),
            None => number(&series["value"]),
        };
        Ok(result.iter().filter(has_data).count())
    }
}

impl Drop for Prometheus {
    fn drop(&mut self) {
        // Gone already, perhaps.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("--- Prometheus wrote:\n{}---", self.log());
        }
    }
}

fn percent(text: &str) -> String {
    text.bytes().fold(String::new(), |mut out, byte| {
        if byte.is_ascii_alphanumeric() {
            out.push(char::from(byte));
        } else {
            write!(out, "%{byte:02X}").unwrap();
        }
        out
    })
}

/// A query of a dashboard, and where it stands.
#[derive(Debug)]
pub struct Query {
    pub place: String,
    pub expr: String,
    pub instant: bool,
}

/// A dashboard as Grafana reads it.
pub struct Dashboard {
    pub file: String,
    pub json: Value,
}

impl Dashboard {
    /// All dashboards.
    pub fn all() -> Vec<Self> {
        let names = files("deploy/grafana/dashboards", ".json");
        names
            .into_iter()
            .map(|file| {
                let json = serde_json::from_str(&read(&file)).unwrap_or_else(|e| panic!("{file}: {e}"));
                Self { file, json }
            })
            .collect()
    }

    /// Its panels, those in collapsed rows too; the rows themselves with them.
    pub fn panels(&self) -> Vec<&Value> {
        let top = self.json["panels"].as_array().unwrap();
        top.iter()
            .flat_map(|p| std::iter::once(p).chain(p["panels"].as_array().into_iter().flatten()))
            .collect()
    }

    pub fn variables(&self) -> &[Value] {
        self.json["templating"]["list"].as_array().unwrap()
    }

    /// Every query, variables' too, as Grafana would send it for a short time range.
    pub fn queries(&self, service: SocketAddr, camera: &str) -> Vec<Query> {
        let values: BTreeMap<_, _> = self
            .variables()
            .iter()
            .map(|variable| {
                let name = variable["name"].as_str().unwrap();
                let several = variable["multi"] == true;
                let value = match (name, several) {
                    // Grafana escapes the values of such variables for a regular expression.
                    ("instance", true) => service.to_string().replace('.', "\\\\."),
                    ("instance", false) => service.to_string(),
                    ("camera", true) => {
                        variable["allValue"].as_str().expect("what All stands for").to_owned()
                    }
                    ("camera", false) => camera.to_owned(),
                    ("datasource", _) => String::new(),
                    _ => panic!("{}: what would the variable {name} be?", self.file),
                };
                (name.to_owned(), value)
            })
            .collect();
        let fill = |expr: &str, place: &str| {
            let mut text = expr.replace("$__rate_interval", "10s").replace("$__interval", "10s");
            text = text.replace("$__range", "60s");
            for (name, value) in &values {
                text = text.replace(&format!("${name}"), value);
            }
            assert!(!text.contains("$"), "{place}: unknown variable in {text}");
            text
        };
        let mut queries = Vec::new();
        for variable in self.variables().iter().filter(|v| v["type"] == "query") {
            let place = format!("{}: variable {}", self.file, variable["name"]);
            let text = variable["query"]["query"].as_str().unwrap();
            let inner = text.strip_prefix("label_values(").and_then(|t| t.strip_suffix(')')).expect(&place);
            let (selector, label) = inner.rsplit_once(", ").expect(&place);
            let expr = fill(&format!("count by ({label}) ({selector})"), &place);
            queries.push(Query { place, expr, instant: true });
        }
        for panel in self.panels() {
            for target in panel["targets"].as_array().into_iter().flatten() {
                let place = format!("{}: panel {} query {}", self.file, panel["title"], target["refId"]);
                let expr = fill(target["expr"].as_str().expect(&place), &place);
                queries.push(Query { place, expr, instant: target["instant"] == true });
            }
        }
        queries
    }
}
