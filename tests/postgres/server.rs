//! A PostgreSQL server of the test's own, from Debian's package.

use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Password of its user.
pub const PASSWORD: &str = "hist0ry-Wort";

/// A server on a free port of loopback; it ends with the test.
pub struct Postgres {
    server: Child,
    port: u16,
    _folder: tempfile::TempDir,
}

impl Postgres {
    /// Starts one; `None`, said loudly, without the package. Where the environment has `CI` that is a failure.
    pub fn start() -> Option<Self> {
        let Some(programs) = programs() else {
            assert!(std::env::var_os("CI").is_none(), "PostgreSQL is missing; CI must have it");
            eprintln!("SKIPPED: PostgreSQL is missing: run `bash deploy/setup.sh test-packages`");
            return None;
        };
        let folder = tempfile::tempdir().unwrap();
        // The server does not run as root: its user must reach the folder.
        std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o777)).unwrap();
        let (data, password) = (folder.path().join("data"), folder.path().join("password"));
        std::fs::write(&password, PASSWORD).unwrap();
        std::fs::set_permissions(&password, std::fs::Permissions::from_mode(0o644)).unwrap();
        let made = as_its_user(&programs.join("initdb"))
            .args([
                "--username",
                "gakp",
                "--auth",
                "scram-sha-256",
                "--no-sync",
                "--encoding",
                "UTF8",
                "--pwfile",
            ])
            .args([&password, Path::new("-D"), &data])
            .output()
            .unwrap();
        assert!(made.status.success(), "{made:?}");
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let server = as_its_user(&programs.join("postgres"))
            .arg("-D")
            .arg(&data)
            .args(["-p", &free.port().to_string(), "-c", "listen_addresses=127.0.0.1"])
            .args(["-c", "unix_socket_directories="])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let server = Self { server, port: free.port(), _folder: folder };
        let since = Instant::now();
        while !server.answers(&programs) {
            assert!(since.elapsed() < Duration::from_secs(60), "PostgreSQL does not start");
            std::thread::sleep(Duration::from_millis(50));
        }
        Some(server)
    }

    fn answers(&self, programs: &Path) -> bool {
        let port = self.port.to_string();
        let mut ask = Command::new(programs.join("pg_isready"));
        ask.args(["-q", "-h", "127.0.0.1", "-p", &port]).status().unwrap().success()
    }

    /// Its database.
    pub fn url(&self) -> String {
        format!("postgres://gakp:{PASSWORD}@127.0.0.1:{}/postgres", self.port)
    }

    /// `STOP` or `CONT` to it and its processes, each of which has a group of its own.
    #[allow(dead_code, reason = "each test binary uses its own part")]
    pub fn signal(&self, name: &str) {
        let pid = self.server.id();
        let all = format!("kill -{name} {pid}; pkill -{name} -P {pid}");
        assert!(Command::new("sh").args(["-c", &all]).status().unwrap().success(), "{all}");
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        // What was stopped would stay.
        let pid = self.server.id();
        let _ = Command::new("sh").args(["-c", &format!("kill -CONT {pid}; pkill -CONT -P {pid}")]).status();
        // Its processes end when they find it gone.
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

fn programs() -> Option<PathBuf> {
    let versions = std::fs::read_dir("/usr/lib/postgresql").ok()?;
    versions.flatten().map(|entry| entry.path().join("bin")).find(|bin| bin.join("postgres").exists())
}

/// By Debian's `postgres` user if the test is run by root.
fn as_its_user(program: &Path) -> Command {
    let is_root = Command::new("id").arg("-u").output().unwrap().stdout == b"0\n";
    if !is_root {
        return Command::new(program);
    }
    let mut command = Command::new("setpriv");
    command.args(["--reuid=postgres", "--regid=postgres", "--clear-groups"]).arg(program);
    command
}
