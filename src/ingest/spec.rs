//! What to open, and how.

use std::time::Duration;

use super::url::{Location, SourceUrl};

/// How RTP travels from a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Transport {
    /// TCP, and UDP where the camera refuses TCP.
    #[default]
    Auto,
    /// Interleaved in the RTSP connection.
    Tcp,
    /// UDP; late packets are dropped.
    Udp,
}

/// How fast a file or the test pattern is played. Cameras set their own pace.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pacing {
    /// By its time stamps.
    #[default]
    Realtime,
    /// As fast as the sink takes frames; none is lost, and capture times are the media's own.
    AsFastAsPossible,
}

/// What to open, and how. [`SourceSpec::parse`] fills in the defaults.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceSpec {
    /// The address.
    pub url: SourceUrl,
    /// For RTSP.
    pub transport: Transport,
    /// A file begins again when it ends, for ever.
    pub looped: bool,
    /// For files, HTTP and the test pattern.
    pub pacing: Pacing,
    /// A camera that sends nothing for this long is lost. 4 s.
    pub silence: Duration,
    /// RTSP's jitter buffer: how long to wait for a late packet. 100 ms.
    pub latency: Duration,
    /// Threads of a software decoder. `None`: 1 for a camera, which adds no delay; for a file a quarter of
    /// the cores, at most 4.
    pub decoder_threads: Option<u32>,
    /// Decode on the CPU even where a hardware decoder exists.
    pub software_decoder: bool,
    /// Accept any TLS certificate of `rtsps://` and `https://` (cameras often sign their own).
    pub insecure_tls: bool,
}

impl SourceSpec {
    /// From an address, with defaults: transport `Auto`, real-time pacing, no loop.
    pub fn parse(text: &str) -> Result<Self, SourceError> {
        Ok(Self {
            url: SourceUrl::parse(text)?,
            transport: Transport::Auto,
            looped: false,
            pacing: Pacing::Realtime,
            silence: Duration::from_secs(4),
            latency: Duration::from_millis(100),
            decoder_threads: None,
            software_decoder: false,
            insecure_tls: false,
        })
    }

    /// Whether a loss is followed by another attempt, for ever. Only a file, a clip of an HTTP
    /// server or a test pattern that is played once gives up.
    pub fn retries(&self) -> bool {
        self.url.is_camera()
            || self.looped
            || (matches!(self.url.location(), Location::Http { .. }) && self.pacing == Pacing::Realtime)
    }

    /// Says what is wrong before anything is opened: a missing file, settings out of range.
    pub fn check(&self) -> Result<(), SourceError> {
        if let Location::File(path) = self.url.location() {
            let file = |cause| SourceError::File { path: path.display().to_string(), cause };
            let meta = std::fs::metadata(path).map_err(file)?;
            if meta.is_dir() {
                return Err(file(std::io::Error::other("it is a directory, not a video")));
            }
            // Opening a pipe waits for whoever writes into it, perhaps for ever.
            if !meta.is_file() {
                return Err(file(std::io::Error::other("it is no regular file")));
            }
            std::fs::File::open(path).map_err(file)?;
        }
        if self.silence < Duration::from_millis(100) {
            return Err(SourceError::Setting("silence must be at least 100 ms".into()));
        }
        if self.latency > Duration::from_secs(10) {
            return Err(SourceError::Setting("latency must be at most 10 s".into()));
        }
        if self.decoder_threads.is_some_and(|n| !(1..=64).contains(&n)) {
            return Err(SourceError::Setting("decoder threads must be 1 to 64".into()));
        }
        Ok(())
    }

    /// Whether frames come at their own pace and wait for nobody.
    pub(crate) fn is_live(&self) -> bool {
        match self.url.location() {
            Location::Rtsp { .. } | Location::Device(_) => true,
            Location::Test(_) => self.pacing == Pacing::Realtime,
            Location::Http { .. } | Location::File(_) => false,
        }
    }
}

/// Why a source cannot even be tried. Passwords are never part of it.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The address is malformed.
    #[error("bad source: {0}")]
    Url(String),
    /// A scheme that is not known.
    #[error("bad source: no scheme `{scheme}`; what works: {known}")]
    Scheme {
        /// The scheme found.
        scheme: String,
        /// Those that work.
        known: &'static str,
    },
    /// A file that cannot be read.
    #[error("cannot open video {path:?}: {cause}")]
    File {
        /// Which.
        path: String,
        /// Why.
        cause: std::io::Error,
    },
    /// A setting out of range.
    #[error("bad source setting: {0}")]
    Setting(String),
    /// GStreamer or one of its parts is not installed.
    #[error("GStreamer cannot be used: {0}")]
    Gstreamer(String),
    /// The system gave no thread.
    #[error("cannot start a camera thread: {0}")]
    Thread(std::io::Error),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_regular_file_is_refused_unopened() {
        for (path, expected) in
            [("/dev/null", "no regular file"), ("/tmp", "a directory"), ("/nowhere", "No such file")]
        {
            let error = SourceSpec::parse(path).unwrap().check().unwrap_err().to_string();
            assert!(error.contains(expected), "{path}: {error}");
        }
    }
}
