//! What a test camera can do wrong on purpose.

use std::fmt;
use std::str::FromStr;

/// A fault of a camera. One that lasts goes on until it is lifted; one that happens is over at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Cuts every client off and listens no more.
    Refuse,
    /// Cuts every client off once; happens.
    HangUp,
    /// Cuts every client off and answers every request with 401, whoever asks.
    Unauthorized,
    /// Cuts every client off and announces its video under an encoding name that nobody knows.
    WrongCodec,
    /// The host is gone without a word: connections stand, nothing comes or is read; new ones are taken and not
    /// answered.
    HalfOpen,
    /// Sends no frame any more, in the middle of a group of pictures; the RTSP connection and RTCP live on.
    Freeze,
    /// RTP time stamps go on an hour later; happens.
    JumpForward,
    /// RTP time stamps go on an hour earlier; happens.
    JumpBackward,
    /// RTP time stamps and sequence numbers begin anew from 0; happens.
    RestartClock,
    /// The picture has half the width and height.
    Resolution,
    /// Half as many frames per second.
    FrameRate,
    /// A tenth of the RTP packets is lost, at random.
    Loss,
    /// Every RTP packet has noise for a payload.
    Noise,
    /// Cuts every client off and sends no RTCP from then on: nobody can tell when a frame was captured.
    NoSenderReports,
    /// TEARDOWN is not answered, and the connection stays.
    MuteTeardown,
    /// The RTSP connection brings random bytes; so does each new one, whatever is asked.
    Garbage,
    /// Cuts every client off and answers each request but OPTIONS with a header that has no end.
    EndlessHeader,
}

impl Fault {
    /// Every fault, in the order of a list.
    pub const ALL: [Self; 17] = [
        Self::Refuse,
        Self::HangUp,
        Self::Unauthorized,
        Self::WrongCodec,
        Self::HalfOpen,
        Self::Freeze,
        Self::JumpForward,
        Self::JumpBackward,
        Self::RestartClock,
        Self::Resolution,
        Self::FrameRate,
        Self::Loss,
        Self::Noise,
        Self::NoSenderReports,
        Self::MuteTeardown,
        Self::Garbage,
        Self::EndlessHeader,
    ];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Refuse => "refuse",
            Self::HangUp => "hang-up",
            Self::Unauthorized => "unauthorized",
            Self::WrongCodec => "wrong-codec",
            Self::HalfOpen => "half-open",
            Self::Freeze => "freeze",
            Self::JumpForward => "jump-forward",
            Self::JumpBackward => "jump-backward",
            Self::RestartClock => "restart-clock",
            Self::Resolution => "resolution",
            Self::FrameRate => "frame-rate",
            Self::Loss => "loss",
            Self::Noise => "noise",
            Self::NoSenderReports => "no-sender-reports",
            Self::MuteTeardown => "mute-teardown",
            Self::Garbage => "garbage",
            Self::EndlessHeader => "endless-header",
        }
    }

    /// Whether it is over at once.
    pub fn happens(self) -> bool {
        matches!(self, Self::HangUp | Self::JumpForward | Self::JumpBackward | Self::RestartClock)
    }

    /// Whether clients that are there are cut off when it begins.
    pub(super) fn cuts_off(self) -> bool {
        use Fault as F;
        matches!(
            self,
            F::Refuse | F::HangUp | F::Unauthorized | F::WrongCodec | F::NoSenderReports | F::EndlessHeader
        )
    }

    /// Whether connections made or used under it are of no use once it ends.
    pub(super) fn spoils(self) -> bool {
        use Fault as F;
        matches!(self, F::Unauthorized | F::WrongCodec | F::HalfOpen | F::Garbage | F::EndlessHeader)
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let all = || Self::ALL.map(Self::name).join(", ");
        Self::ALL.into_iter().find(|fault| fault.name() == name).ok_or_else(|| format!("one of {}", all()))
    }
}
