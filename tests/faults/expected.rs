//! What becomes of a camera under each fault.

use gakp::ingest::Transport;
use gakp::ingest::testcam::Fault;

/// What a source says of a fault: one of these labels, or nothing, because the stream goes on.
pub fn expected(fault: Fault, transport: Transport) -> &'static [&'static str] {
    match fault {
        Fault::Refuse => &["disconnected", "refused"],
        // Over UDP the end of the RTSP connection is no end: the pictures stay away.
        Fault::HangUp | Fault::NoSenderReports if transport == Transport::Udp => &["disconnected", "silent"],
        Fault::HangUp | Fault::NoSenderReports => &["disconnected"],
        Fault::Unauthorized => &["unauthorized"],
        Fault::WrongCodec => &["unsupported"],
        Fault::HalfOpen | Fault::Freeze => &["silent"],
        // GStreamer throws away what has a lower number than the first packet, so that this looks like silence.
        Fault::RestartClock => &["silent"],
        Fault::Noise => &["garbage", "silent"],
        Fault::Garbage if transport == Transport::Udp => &["garbage", "silent"],
        Fault::Garbage => &["garbage"],
        Fault::EndlessHeader => &["silent"],
        Fault::JumpForward | Fault::JumpBackward | Fault::Resolution | Fault::FrameRate => &[],
        Fault::Loss | Fault::MuteTeardown => &[],
    }
}
