//! Why a source was lost: one enum, a stable label for metrics, a text that says what to do.

use std::net::ToSocketAddrs;
use std::time::{Duration, Instant};

use gstreamer as gst;

use super::knock;
use super::url::{Location, SourceUrl};

/// Why a source was lost. The texts never contain a password.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Failure {
    /// Nothing listens at the address and port.
    #[error("connection refused: check the port, and that the camera's RTSP service is on")]
    Refused,
    /// The host name does not resolve.
    #[error("unknown host name: check the spelling and the DNS")]
    UnknownHost,
    /// No way to the host, or it does not answer.
    #[error("host unreachable: check the address, the cable and the network")]
    Unreachable,
    /// User or password are missing or wrong.
    #[error("not authorized: check user and password")]
    Unauthorized,
    /// The host answers, but has no such path; or there is no such file or device.
    #[error("not found: check the path")]
    NotFound,
    /// The device is used by someone else.
    #[error("device busy: another program uses it")]
    Busy,
    /// Nothing came for so long.
    #[error("silent for {} s: the camera may be frozen or the network down", .0.as_secs_f32())]
    Silent(Duration),
    /// The other side closed the connection.
    #[error("disconnected by the other side")]
    Disconnected,
    /// The camera has no video over this transport.
    #[error("no video over this transport: try the other one (TCP, UDP), and check that the path has video")]
    Transport,
    /// It is no video, or one that cannot be decoded here.
    #[error("unsupported: {0}")]
    Unsupported(String),
    /// Data arrive that make no sense.
    #[error("no usable video in the data: {0}")]
    Garbage(String),
    /// Anything else, in GStreamer's words.
    #[error("{0}")]
    Other(String),
}

impl Failure {
    /// A stable name for metrics and APIs.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Refused => "refused",
            Self::UnknownHost => "unknown_host",
            Self::Unreachable => "unreachable",
            Self::Unauthorized => "unauthorized",
            Self::NotFound => "not_found",
            Self::Busy => "busy",
            Self::Silent(_) => "silent",
            Self::Disconnected => "disconnected",
            Self::Transport => "transport",
            Self::Unsupported(_) => "unsupported",
            Self::Garbage(_) => "garbage",
            Self::Other(_) => "other",
        }
    }

    /// Every label, for metrics that start at 0.
    pub const LABELS: [&'static str; 12] = [
        "refused",
        "unknown_host",
        "unreachable",
        "unauthorized",
        "not_found",
        "busy",
        "silent",
        "disconnected",
        "transport",
        "unsupported",
        "garbage",
        "other",
    ];
}

/// What a GStreamer error means, and whether the connection itself failed.
///
/// The human-readable message is the same for most causes; the kind and the debug text tell.
pub(crate) fn classify(error: &gst::glib::Error, debug: &str, url: &SourceUrl) -> Failure {
    let text = || url.scrub(&one_line(error.message(), debug));
    let says = |part: &str| debug.contains(part) || error.message().contains(part);
    let camera = matches!(url.location(), Location::Rtsp { .. });
    if let Some(kind) = error.kind::<gst::ResourceError>() {
        use gst::ResourceError as R;
        return match kind {
            R::NotFound => Failure::NotFound,
            R::NotAuthorized => Failure::Unauthorized,
            R::Busy => Failure::Busy,
            _ if says("(404)") => Failure::NotFound,
            _ if says("(401)") || says("(403)") => Failure::Unauthorized,
            _ if says("(503)") || says("Service Unavailable") => Failure::Other(
                "the camera answers 503 Service Unavailable: it may have too many clients".into(),
            ),
            _ if says("Timeout while waiting") => Failure::Silent(RTSP_TIMEOUT),
            _ if says("Parse error") || says("Invalid RTSP") => {
                Failure::Garbage("the answer is not RTSP".into())
            }
            R::OpenRead | R::OpenReadWrite => probe(url).unwrap_or(Failure::Other(text())),
            R::Read | R::Write if camera && (says("System error") || says("closed") || says("EOF")) => {
                Failure::Disconnected
            }
            _ => Failure::Other(text()),
        };
    }
    if let Some(kind) = error.kind::<gst::StreamError>() {
        use gst::StreamError as S;
        return match kind {
            S::WrongType | S::TypeNotFound => Failure::Unsupported("this is not a video".into()),
            S::CodecNotFound if says("transport protocols") => Failure::Transport,
            S::CodecNotFound => Failure::Unsupported(text()),
            S::Decode | S::Demux | S::Format => Failure::Garbage(text()),
            // A demuxer that finds nothing it can pass on ("not-linked", "not-negotiated").
            S::Failed if says("not-negotiated") => Failure::Unsupported(text()),
            // souphttpsrc says no more than this of a refused connection.
            S::Failed => probe(url).unwrap_or(Failure::Other(text())),
            _ => Failure::Other(text()),
        };
    }
    if error.matches(gst::CoreError::MissingPlugin) {
        return Failure::Unsupported(text());
    }
    Failure::Other(text())
}

/// How long rtspsrc waits for an answer over TCP.
pub(crate) const RTSP_TIMEOUT: Duration = Duration::from_secs(4);

/// GStreamer says "Failed to connect" for everything: asks the network itself. `None` when the
/// port takes connections, so that something else is wrong.
fn probe(url: &SourceUrl) -> Option<Failure> {
    let (Location::Rtsp { host, port, .. } | Location::Http { host, port, .. }) = url.location() else {
        return None;
    };
    let Ok(mut addresses) = (host.as_str(), *port).to_socket_addrs() else {
        return Some(Failure::UnknownHost);
    };
    knock::connect_to(&addresses.next()?, Instant::now() + Duration::from_secs(1)).err()
}

/// GStreamer's message and the last line of its debug text, which holds the cause.
fn one_line(message: &str, debug: &str) -> String {
    let detail = debug.lines().rev().map(str::trim).find(|line| !line.is_empty()).unwrap_or_default();
    let text = if detail.is_empty() || message.contains(detail) {
        message.to_owned()
    } else {
        format!("{message} ({detail})")
    };
    text.chars().take(300).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_distinct_and_complete() {
        let all = [
            Failure::Refused,
            Failure::UnknownHost,
            Failure::Unreachable,
            Failure::Unauthorized,
            Failure::NotFound,
            Failure::Busy,
            Failure::Silent(Duration::ZERO),
            Failure::Disconnected,
            Failure::Transport,
            Failure::Unsupported(String::new()),
            Failure::Garbage(String::new()),
            Failure::Other(String::new()),
        ];
        assert_eq!(all.each_ref().map(Failure::label), Failure::LABELS);
    }

    #[test]
    fn reads_what_gstreamer_says() {
        let url = SourceUrl::parse("rtsp://u:hunter2@127.0.0.1:1/x").unwrap();
        let resource = gst::ResourceError::Read;
        for (error, debug, label) in [
            (gst::glib::Error::new(gst::ResourceError::NotFound, "x"), "Not Found (404)", "not_found"),
            (
                gst::glib::Error::new(gst::ResourceError::NotAuthorized, "x"),
                "Unauthorized (401)",
                "unauthorized",
            ),
            (gst::glib::Error::new(resource, "Unhandled error"), "Service Unavailable (503)", "other"),
            (gst::glib::Error::new(resource, "x"), "Timeout while waiting for server response", "silent"),
            (gst::glib::Error::new(gst::ResourceError::OpenReadWrite, "x"), "Failed to connect.", "refused"),
            (gst::glib::Error::new(gst::StreamError::WrongType, "x"), "", "unsupported"),
            (gst::glib::Error::new(gst::StreamError::Decode, "x"), "", "garbage"),
            (gst::glib::Error::new(gst::LibraryError::Failed, "hunter2"), "at hunter2", "other"),
        ] {
            let failure = classify(&error, debug, &url);
            assert_eq!(failure.label(), label, "{debug}");
            assert!(!failure.to_string().contains("hunter2"), "{failure}");
        }
    }
}
