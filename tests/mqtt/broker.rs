//! A real mosquitto with a password file in a folder of its own, and Debian's clients to look at it.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// What the service's user signs in with.
pub const PASSWORD: &str = "hunter2-of-the-broker";

/// Programs that the tests need; `None`, said loudly, where one is missing. Where the environment has `CI` that is a
/// failure.
fn program(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    // Debian keeps servers where only root looks.
    let found = std::env::split_paths(&path).chain(["/usr/sbin".into()]).map(|folder| folder.join(name));
    let found = found.into_iter().find(|file| file.is_file());
    if found.is_none() {
        assert!(std::env::var_os("CI").is_none(), "{name} is missing; CI must have it");
        eprintln!("SKIPPED: {name} is missing: run `bash deploy/setup.sh test-packages`");
    }
    found
}

/// A child process that is killed when dropped.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        // Gone already, perhaps.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A broker.
pub struct Broker {
    pub address: SocketAddr,
    folder: tempfile::TempDir,
    server: PathBuf,
    process: Option<Killed>,
}

/// Messages in the order in which they came: topic and text.
type Messages = Arc<Mutex<Vec<(String, String)>>>;

/// A subscriber.
pub struct Listener {
    messages: Messages,
    _process: Killed,
}

impl Listener {
    /// The newest message of each topic.
    pub fn newest(&self) -> BTreeMap<String, String> {
        self.messages.lock().unwrap().iter().cloned().collect()
    }

    /// All messages of a topic.
    pub fn all(&self, topic: &str) -> Vec<String> {
        let messages = self.messages.lock().unwrap();
        messages.iter().filter(|(of, _)| of == topic).map(|(_, text)| text.clone()).collect()
    }
}

impl Broker {
    /// Starts it on a free port; `None` where mosquitto is missing.
    pub fn start() -> Option<Self> {
        Self::start_with(|_| String::new())
    }

    /// Starts it with more settings of its listener; they may name files that are written to the folder.
    pub fn start_with(settings: impl FnOnce(&Path) -> String) -> Option<Self> {
        let (server, passwords) = (program("mosquitto")?, program("mosquitto_passwd")?);
        for client in ["mosquitto_sub", "mosquitto_pub"] {
            program(client)?;
        }
        let folder = tempfile::tempdir().unwrap();
        let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let file = folder.path().join("passwords");
        let made = Command::new(passwords).args(["-b", "-c"]).arg(&file).args(["gakp", PASSWORD]).status();
        assert!(made.unwrap().success());
        // As root it gives up its rights, and must read the file all the same.
        std::fs::set_permissions(&file, PermissionsExt::from_mode(0o644)).unwrap();
        std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o755)).unwrap();
        let config = format!(
            "listener {} 127.0.0.1\n{}allow_anonymous false\npassword_file {}\npersistence false\n",
            address.port(),
            settings(folder.path()),
            file.display()
        );
        std::fs::write(folder.path().join("mosquitto.conf"), config).unwrap();
        let mut broker = Self { address, folder, server, process: None };
        broker.restart();
        Some(broker)
    }

    /// Starts it, at the same address; it remembers nothing.
    pub fn restart(&mut self) {
        let log = std::fs::File::options().create(true).append(true).open(self.path("log")).unwrap();
        let child = Command::new(&self.server)
            .arg("-v")
            .arg("-c")
            .arg(self.path("mosquitto.conf"))
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .spawn()
            .unwrap();
        self.process = Some(Killed(child));
        let since = Instant::now();
        while TcpStream::connect(self.address).is_err() {
            assert!(since.elapsed() < Duration::from_secs(20), "mosquitto does not listen: {}", self.log());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Kills it.
    pub fn stop(&mut self) {
        self.process = None;
    }

    pub fn log(&self) -> String {
        std::fs::read_to_string(self.path("log")).unwrap_or_default()
    }

    fn path(&self, name: &str) -> PathBuf {
        Path::new(self.folder.path()).join(name)
    }

    fn client(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.args(["-h", "127.0.0.1", "-p", &self.address.port().to_string()]);
        command.args(["-u", "gakp", "-P", PASSWORD]).stdin(Stdio::null());
        command
    }

    /// What it retains now, by topic.
    pub fn retained(&self) -> BTreeMap<String, String> {
        let args = ["-t", "#", "--retained-only", "-W", "1", "-F", "%t %p"];
        let output = self.client("mosquitto_sub").args(args).output().unwrap();
        // 27: the second is over; 0: something else came after what is retained.
        assert!(matches!(output.status.code(), Some(0 | 27)), "{output:?}");
        String::from_utf8(output.stdout).unwrap().lines().map(split).collect()
    }

    /// Publishes a message.
    pub fn publish(&self, topic: &str, text: &str) {
        let status = self.client("mosquitto_pub").args(["-t", topic, "-m", text, "-q", "1"]).status();
        assert!(status.unwrap().success());
    }

    /// Subscribes to what comes from now on, and to what is retained.
    pub fn listen(&self, filter: &str) -> Listener {
        let mut child = self
            .client("mosquitto_sub")
            .args(["-t", filter, "-q", "1", "-F", "%t %p"])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (output, messages) = (child.stdout.take().unwrap(), Messages::default());
        let kept = messages.clone();
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                kept.lock().unwrap().push(split(&line));
            }
        });
        Listener { messages, _process: Killed(child) }
    }
}

fn split(line: &str) -> (String, String) {
    let (topic, text) = line.split_once(' ').unwrap_or((line, ""));
    (topic.to_owned(), text.to_owned())
}
