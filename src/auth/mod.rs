//! Who may do what: tokens with roles, sessions of the page.
//!
//! A token is 256 random bits, shown once by `gakp token create`; its SHA-256 lies in `tokens.json` in the state
//! folder. So many random bits need no slow hash: nobody guesses them, with the file or without. A page signs
//! in with a token and gets a session, a cookie that lives in memory.
//!
//! Without any token a service that listens on the loopback interface is open to whoever can reach it there;
//! one that listens elsewhere does not start.

mod sessions;
pub mod tls;
mod tokens;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use serde::{Deserialize, Serialize};

pub use sessions::{SESSION_LIFE, SessionId};
pub use tokens::{NewToken, TokenError, TokenFile, TokenRecord};

use sessions::Sessions;

/// How old what is known of the token file may be.
const RECHECK: Duration = Duration::from_secs(1);

/// What a token's bearer may do; each may do all that those before it may.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Read: cameras, tracks, counts, events, metrics.
    Viewer,
    /// And change: cameras on the network, lines, zones.
    Operator,
    /// And everything else: files and devices of the machine as cameras.
    Admin,
}

impl Role {
    /// All roles, from the least to the most.
    pub const ALL: [Role; 3] = [Role::Viewer, Role::Operator, Role::Admin];

    /// The name on the wire and on the command line.
    pub fn as_str(self) -> &'static str {
        match self {
            Role::Viewer => "viewer",
            Role::Operator => "operator",
            Role::Admin => "admin",
        }
    }
}

/// Who asks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The token's name.
    pub name: String,
    /// What it may do.
    pub role: Role,
    /// Whether it may see pictures.
    pub video: bool,
}

/// What a route asks of whoever calls it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Right {
    /// Nothing: health, the page's files, signing in.
    Nobody,
    /// A role of at least this.
    Role(Role),
    /// Any role, and the right to see pictures.
    Video,
}

impl Right {
    /// Whether `identity` has it.
    pub fn is_of(self, identity: &Identity) -> bool {
        match self {
            Right::Nobody => true,
            Right::Role(least) => identity.role >= least,
            Right::Video => identity.video,
        }
    }
}

/// Who is known.
pub struct Gate {
    file: Option<PathBuf>,
    /// Whether somebody unknown may come in as long as there is no token.
    open_without_tokens: bool,
    /// Hash of the admin's token that came in a file.
    admin: Option<String>,
    known: Mutex<Known>,
    sessions: Mutex<Sessions>,
}

struct Known {
    tokens: TokenFile,
    checked: Instant,
    /// The file's time and length when it was read.
    stamp: Option<(SystemTime, u64)>,
    /// Once there was a token, nobody comes in without one, whatever becomes of the file.
    locked: bool,
}

impl Gate {
    /// A gate by the tokens in `file`. Without any token in it everybody may do everything if
    /// `open_without_tokens`, and nobody anything otherwise.
    ///
    /// # Errors
    /// The file is there and cannot be read.
    pub fn new(file: PathBuf, open_without_tokens: bool) -> Result<Self, TokenError> {
        let stamp = stamp(&file);
        let tokens = TokenFile::read(&file)?;
        let locked = !tokens.is_empty();
        let known = Known { tokens, checked: Instant::now(), stamp, locked };
        let known = Mutex::new(known);
        Ok(Self { file: Some(file), open_without_tokens, admin: None, known, sessions: Mutex::default() })
    }

    /// A gate that lets everybody do everything.
    pub fn open() -> Self {
        let tokens = TokenFile::default();
        let known = Known { tokens, checked: Instant::now(), stamp: None, locked: false };
        Self {
            file: None,
            open_without_tokens: true,
            admin: None,
            known: Mutex::new(known),
            sessions: Mutex::default(),
        }
    }

    /// Lets in, as an admin, who bears the token in a file: what containers get as a secret.
    ///
    /// # Errors
    /// The file cannot be read, or what is in it is too short to be a secret.
    pub fn admit_admin(&mut self, file: &std::path::Path) -> Result<(), TokenError> {
        let io = |reason| TokenError::Io { verb: "read the admin's token from", path: file.into(), reason };
        let token = std::fs::read_to_string(file).map_err(io)?;
        let token = token.trim();
        if token.len() < LEAST_SECRET || !token.bytes().all(|b| b.is_ascii_graphic()) {
            let what = format!(
                "it must be {LEAST_SECRET} or more visible ASCII characters, such as `openssl rand -hex 32` prints"
            );
            return Err(io(std::io::Error::other(what)));
        }
        self.admin = Some(sha256(token));
        Ok(())
    }

    /// Whether there is at least one token.
    pub fn has_tokens(&self) -> bool {
        self.admin.is_some() || !self.known().tokens.is_empty()
    }

    /// Whether everybody may do everything.
    pub fn is_open(&self) -> bool {
        self.open_without_tokens && self.admin.is_none() && !self.known().locked
    }

    /// Who bears `token`.
    pub fn bearer(&self, token: &str) -> Option<Identity> {
        if self.admin.as_deref() == Some(sha256(token).as_str()) {
            return Some(file_admin());
        }
        self.known().tokens.bearer(token)
    }

    /// A session for the bearer of `token`.
    pub fn sign_in(&self, token: &str) -> Option<(SessionId, Identity)> {
        let identity = self.bearer(token)?;
        Some((self.sessions().begin(identity.name.clone()), identity))
    }

    /// Who is signed in as `session`. It ends with its token.
    pub fn session(&self, session: &str) -> Option<Identity> {
        let name = self.sessions().name(session)?;
        if self.admin.is_some() && name == FILE_ADMIN {
            return Some(file_admin());
        }
        self.known().tokens.named(&name)
    }

    /// Whether `identity` may still do what it could.
    pub fn still_knows(&self, identity: &Identity) -> bool {
        if self.is_open() || (self.admin.is_some() && identity.name == FILE_ADMIN) {
            return true;
        }
        self.known().tokens.named(&identity.name).as_ref() == Some(identity)
    }

    /// Ends a session.
    pub fn sign_out(&self, session: &str) {
        self.sessions().end(session);
    }

    fn sessions(&self) -> MutexGuard<'_, Sessions> {
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the file says, read again when it has changed. A file that cannot be read changes nothing: those
    /// who are known stay so.
    fn known(&self) -> MutexGuard<'_, Known> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(file) = &self.file
            && known.checked.elapsed() >= RECHECK
        {
            known.checked = Instant::now();
            let now = stamp(file);
            if now != known.stamp {
                match TokenFile::read(file) {
                    Ok(tokens) => {
                        known.locked |= !tokens.is_empty();
                        (known.tokens, known.stamp) = (tokens, now);
                        tracing::info!(
                            tokens = known.tokens.records().len(),
                            "the token file was read again"
                        );
                    }
                    Err(error) => tracing::error!(%error, "the token file cannot be read again"),
                }
            }
        }
        known
    }
}

/// Who bears the token that came in a file. No token of `gakp token` has such a name.
const FILE_ADMIN: &str = "(admin token file)";
/// Fewer characters are no secret.
const LEAST_SECRET: usize = 32;

fn file_admin() -> Identity {
    Identity { name: FILE_ADMIN.into(), role: Role::Admin, video: true }
}

fn stamp(file: &std::path::Path) -> Option<(SystemTime, u64)> {
    let meta = std::fs::metadata(file).ok()?;
    Some((meta.modified().ok()?, meta.len()))
}

/// 256 random bits as 64 hexadecimal digits.
fn random_text() -> String {
    let mut bytes = [0u8; 32];
    // The system's random source does not fail on a system that runs.
    getrandom::fill(&mut bytes).expect("the system gives random bytes");
    hex(&bytes)
}

/// The SHA-256 of a text, as hexadecimal digits.
fn sha256(text: &str) -> String {
    use sha2::Digest;
    hex(&sha2::Sha256::digest(text))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Maps by name, in a stable order.
type ByName<T> = BTreeMap<String, T>;
