//! Where video comes from, as text; and the promise that a password in it is never printed.

use std::fmt;
use std::path::PathBuf;

use super::SourceError;
use super::pattern::TestPattern;

/// The schemes that work, for error messages.
const SCHEMES: &str =
    "rtsp://, rtsps://, http://, https://, file:// or a plain path, v4l2:///dev/video0, test:";

/// A user and a password, percent-decoded.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Login {
    pub user: String,
    pub password: String,
}

/// What a source text means, taken apart.
#[derive(Clone, PartialEq)]
pub(crate) enum Location {
    /// A camera; the URI carries no login.
    Rtsp { uri: String, host: String, port: u16, login: Option<Login> },
    /// HTTP(S): a file, HLS, MPEG-TS, MJPEG; the URI carries no login.
    Http { uri: String, host: String, port: u16, login: Option<Login> },
    /// A file on this machine.
    File(PathBuf),
    /// A Video4Linux device.
    Device(PathBuf),
    /// A generated picture.
    Test(TestPattern),
}

/// The address of a source. `Debug` and `Display` replace passwords and tokens by `***`.
#[derive(Clone, PartialEq)]
pub struct SourceUrl {
    full: String,
    redacted: String,
    secrets: Vec<String>,
    location: Location,
}

impl SourceUrl {
    /// Takes an address apart. The error never repeats a password.
    pub fn parse(text: &str) -> Result<Self, SourceError> {
        let text = text.trim();
        if text.is_empty() {
            return Err(bad("the source is empty"));
        }
        if text.contains(['\0', '\n', '\r']) {
            return Err(bad("the source contains a line break or a zero byte"));
        }
        if let Some(options) = text.strip_prefix("test:") {
            let location = Location::Test(TestPattern::parse(options)?);
            return Ok(Self::plain(text, location));
        }
        let Some((scheme, rest)) = text.split_once("://") else {
            let word = text.split(':').next().unwrap_or_default().to_ascii_lowercase();
            if text.contains(':')
                && ["rtsp", "rtsps", "http", "https", "file", "v4l2"].contains(&word.as_str())
            {
                return Err(bad(format!("after `{word}:` two slashes are missing: `{word}://...`")));
            }
            return Ok(Self::plain(text, Location::File(text.into())));
        };
        match scheme.to_ascii_lowercase().as_str() {
            scheme @ ("rtsp" | "rtsps" | "http" | "https") => Self::network(text, scheme, rest),
            "file" => {
                let path = rest.strip_prefix("localhost").unwrap_or(rest);
                if !path.starts_with('/') {
                    return Err(bad("a file:// URL needs an absolute path: file:///path/to/video.mp4"));
                }
                Ok(Self::plain(text, Location::File(decode(path)?.into())))
            }
            "v4l2" => {
                if !rest.starts_with("/dev/") {
                    return Err(bad("a v4l2:// URL names a device: v4l2:///dev/video0"));
                }
                Ok(Self::plain(text, Location::Device(rest.into())))
            }
            // The text may carry a password: name nothing but the scheme, and that only if it is one.
            other => Err(SourceError::Scheme {
                scheme: if other.len() <= 16 && other.bytes().all(|b| b.is_ascii_alphanumeric()) {
                    other.to_owned()
                } else {
                    "?".to_owned()
                },
                known: SCHEMES,
            }),
        }
    }

    /// Host and port of an RTSP camera; `None` for anything else.
    pub fn rtsp_host(&self) -> Option<(&str, u16)> {
        match &self.location {
            Location::Rtsp { host, port, .. } => Some((host, *port)),
            _ => None,
        }
    }

    fn plain(text: &str, location: Location) -> Self {
        Self { full: text.to_owned(), redacted: text.to_owned(), secrets: Vec::new(), location }
    }

    fn network(full: &str, scheme: &str, rest: &str) -> Result<Self, SourceError> {
        // The authority ends at the first slash; a login ends at its last `@`, so that a password
        // with an unescaped `@`, `?` or `#` in it still works.
        let slash = rest.find('/').unwrap_or(rest.len());
        let (login, host_at) = match rest[..slash].rfind('@') {
            Some(at) => (Some(&rest[..at]), at + 1),
            None => (None, 0),
        };
        let host_end = rest[host_at..].find(['/', '?', '#']).map_or(rest.len(), |i| host_at + i);
        let (host_port, path) = (&rest[host_at..host_end], &rest[host_end..]);
        let default_port = match scheme {
            "rtsp" => 554,
            "rtsps" => 322,
            "http" => 80,
            _ => 443,
        };
        let (host, port) = split_port(host_port, default_port)?;

        let mut secrets = Vec::new();
        let mut shown = String::new();
        let login = match login {
            None => None,
            Some(text) => {
                let (user, password) = text.split_once(':').unwrap_or((text, ""));
                shown = user.to_owned();
                if text.contains(':') {
                    shown.push_str(":***");
                }
                shown.push('@');
                let login = Login { user: decode(user)?, password: decode(password)? };
                secrets.extend([password.to_owned(), login.password.clone()]);
                Some(login)
            }
        };
        let shown_path = redact_query(path, &mut secrets);
        secrets.retain(|s| !s.is_empty());
        // Longest first, so that replacing one does not leave the tail of another.
        secrets.sort_by_key(|s| std::cmp::Reverse(s.len()));
        secrets.dedup();

        let uri = format!("{scheme}://{host_port}{path}");
        let (host, redacted) = (host.to_owned(), format!("{scheme}://{shown}{host_port}{shown_path}"));
        let location = if scheme.starts_with("rtsp") {
            Location::Rtsp { uri, host, port, login }
        } else {
            Location::Http { uri, host, port, login }
        };
        Ok(Self { full: full.to_owned(), redacted, secrets, location })
    }

    /// The address without passwords: what `Display` prints.
    pub fn redacted(&self) -> &str {
        &self.redacted
    }

    /// The address as it was given, passwords included: for storing it, never for printing.
    pub fn with_secrets(&self) -> &str {
        &self.full
    }

    /// Replaces every secret of this address in a text from elsewhere (GStreamer's messages).
    pub fn scrub(&self, text: &str) -> String {
        self.secrets.iter().fold(text.to_owned(), |text, secret| text.replace(secret.as_str(), "***"))
    }

    /// Whether this is a camera, which is reconnected for ever and whose end of stream is a loss.
    pub fn is_camera(&self) -> bool {
        matches!(self.location, Location::Rtsp { .. } | Location::Device(_))
    }

    pub(crate) fn location(&self) -> &Location {
        &self.location
    }
}

impl fmt::Display for SourceUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.redacted)
    }
}

impl fmt::Debug for SourceUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SourceUrl({:?})", self.redacted)
    }
}

fn bad(what: impl Into<String>) -> SourceError {
    SourceError::Url(what.into())
}

/// Splits `host:port`, `[v6]:port` or `host`.
fn split_port(host_port: &str, default: u16) -> Result<(&str, u16), SourceError> {
    let (host, port) = if let Some(rest) = host_port.strip_prefix('[') {
        let (host, tail) = rest.split_once(']').ok_or_else(|| bad("an IPv6 address needs a closing `]`"))?;
        match tail {
            "" => (host, None),
            _ => (host, Some(tail.strip_prefix(':').ok_or_else(|| bad("after `]` comes `:port` or `/`"))?)),
        }
    } else {
        match host_port.rsplit_once(':') {
            Some((host, port)) => (host, Some(port)),
            None => (host_port, None),
        }
    };
    if host.is_empty() {
        return Err(bad("the URL names no host"));
    }
    match port {
        None => Ok((host, default)),
        // What stands here may be half a password with an unescaped slash: do not repeat it.
        Some(port) => port.parse().ok().filter(|&p| p != 0).map(|p| (host, p)).ok_or_else(|| {
            bad("the port is not a number from 1 to 65535 (write a `/` in a password as %2F, a `:` as %3A)")
        }),
    }
}

/// Percent-decoding; a `%` that starts no pair of hex digits stays as it is.
fn decode(text: &str) -> Result<String, SourceError> {
    let mut out = Vec::with_capacity(text.len());
    let bytes = text.as_bytes();
    let hex = |b: Option<&u8>| b.and_then(|&b| (b as char).to_digit(16)).map(|d| d as u8);
    let mut i = 0;
    while i < bytes.len() {
        match (bytes[i], hex(bytes.get(i + 1)), hex(bytes.get(i + 2))) {
            (b'%', Some(high), Some(low)) => {
                out.push(high << 4 | low);
                i += 3;
            }
            (byte, ..) => {
                out.push(byte);
                i += 1;
            }
        }
    }
    String::from_utf8(out).map_err(|_| bad("the percent-encoded part of the URL is not UTF-8"))
}

/// Cameras take credentials in paths and queries too (`?user=admin&password=x`,
/// `/user=admin_password=x_channel=1`): masks the values of keys that look like one.
fn redact_query(path: &str, secrets: &mut Vec<String>) -> String {
    const KEYS: [&str; 11] =
        ["password", "passwd", "pass", "pwd", "token", "secret", "auth", "apikey", "key", "sig", "signature"];
    let mut out = String::with_capacity(path.len());
    let mut rest = path;
    while let Some(equals) = rest.find('=') {
        let key = rest[..equals].rsplit(|c: char| !c.is_ascii_alphanumeric()).next();
        let key = key.unwrap_or_default().to_ascii_lowercase();
        out.push_str(&rest[..=equals]);
        rest = &rest[equals + 1..];
        if KEYS.contains(&key.as_str()) {
            let end = rest.find(['&', ';', '/', '?', '#']).unwrap_or(rest.len());
            if end > 0 {
                secrets.push(rest[..end].to_owned());
                out.push_str("***");
            }
            rest = &rest[end..];
        }
    }
    out.push_str(rest);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rtsp(text: &str) -> (String, String, u16, Option<(String, String)>) {
        match SourceUrl::parse(text).unwrap().location {
            Location::Rtsp { uri, host, port, login } => {
                (uri, host, port, login.map(|l| (l.user, l.password)))
            }
            _ => panic!("{text} is not RTSP"),
        }
    }

    #[test]
    fn takes_camera_addresses_apart() {
        let login = |u: &str, p: &str| Some((u.to_owned(), p.to_owned()));
        for (text, uri, host, port, who) in [
            ("rtsp://cam/live", "rtsp://cam/live", "cam", 554, None),
            ("RTSP://cam:8554", "rtsp://cam:8554", "cam", 8554, None),
            ("rtsps://cam/a?b=c", "rtsps://cam/a?b=c", "cam", 322, None),
            ("rtsp://u:p@cam/live", "rtsp://cam/live", "cam", 554, login("u", "p")),
            ("rtsp://u@cam/live", "rtsp://cam/live", "cam", 554, login("u", "")),
            ("rtsp://u:p%40ss%2F%3a@cam:1/x", "rtsp://cam:1/x", "cam", 1, login("u", "p@ss/:")),
            ("rtsp://u:p@ss#?1@cam/x", "rtsp://cam/x", "cam", 554, login("u", "p@ss#?1")),
            ("rtsp://u:a:b@[fe80::1]:99/x", "rtsp://[fe80::1]:99/x", "fe80::1", 99, login("u", "a:b")),
            ("rtsp://u:100%@cam/", "rtsp://cam/", "cam", 554, login("u", "100%")),
        ] {
            assert_eq!(rtsp(text), (uri.into(), host.into(), port, who), "{text}");
        }
    }

    #[test]
    fn never_prints_a_secret() {
        for (text, shown) in [
            ("rtsp://u:hunter2@cam/live", "rtsp://u:***@cam/live"),
            ("rtsp://u:hunter2%21@cam/live", "rtsp://u:***@cam/live"),
            ("rtsp://cam/x?user=u&password=hunter2&n=1", "rtsp://cam/x?user=u&password=***&n=1"),
            ("http://cam/v.m3u8?token=hunter2", "http://cam/v.m3u8?token=***"),
            ("rtsp://cam/ü😀password=hunter2", "rtsp://cam/ü😀password=***"),
            ("rtsp://cam/user=u_password=hunter2_channel=1/x", "rtsp://cam/user=u_password=***/x"),
        ] {
            let url = SourceUrl::parse(text).unwrap();
            assert_eq!(url.redacted(), shown);
            assert!(!format!("{url} {url:?}").contains("hunter2"), "{text}");
            let spec = crate::ingest::SourceSpec::parse(text).unwrap();
            assert!(!format!("{spec:?}").contains("hunter2"), "{text}");
            assert_eq!(url.with_secrets(), text);
            let scrubbed = url.scrub(&format!("cannot open {text}"));
            assert!(!scrubbed.contains("hunter2"), "{scrubbed}");
        }
    }

    #[test]
    fn says_what_is_wrong_without_the_password() {
        for (text, part) in [
            ("", "empty"),
            ("rtmp://u:hunter2@host/x", "rtmp"),
            ("hunter2 with spaces://x", "rtsp://"),
            ("rtsp:/cam/live", "two slashes"),
            ("rtsp://", "no host"),
            ("rtsp://u:hunter2@/x", "no host"),
            ("rtsp://u:hunter2/9@cam/x", "port"),
            ("rtsp://cam:0/x", "port"),
            ("rtsp://cam:70000/x", "port"),
            ("rtsp://[::1/x", "closing"),
            ("rtsp://u:%ffhunter2@cam/x", "UTF-8"),
            ("file://relative.mp4", "absolute"),
            ("v4l2://video0", "/dev/video0"),
            ("test:?pattern=hunter2", "pattern"),
        ] {
            let error = SourceUrl::parse(text).expect_err(text);
            for shown in [format!("{error}"), format!("{error:?}")] {
                assert!(shown.contains(part), "{text}: {shown}");
                assert!(!shown.contains("hunter2") || text.starts_with("test:"), "{text}: {shown}");
            }
        }
    }

    #[test]
    fn files_and_devices() {
        for (text, location) in [
            ("a.mp4", Location::File("a.mp4".into())),
            ("/a b/ü.mp4", Location::File("/a b/ü.mp4".into())),
            ("file:///a%20b.mp4", Location::File("/a b.mp4".into())),
            ("file://localhost/a.mp4", Location::File("/a.mp4".into())),
            ("12:30.mp4", Location::File("12:30.mp4".into())),
            ("v4l2:///dev/video0", Location::Device("/dev/video0".into())),
        ] {
            assert!(SourceUrl::parse(text).unwrap().location == location, "{text}");
        }
    }
}
