//! Which trace a span belongs to, and whether it is recorded: W3C Trace Context and sampling by ratio.

use axum::http::HeaderMap;

/// Bits of a trace id that sampling looks at, as OpenTelemetry has it: the lowest 56.
const RANDOM: u64 = (1 << 56) - 1;

/// A span's place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Context {
    pub trace: u128,
    /// The caller's span, where it is part of somebody else's trace.
    pub parent: Option<u64>,
    /// Whether it is to be recorded.
    pub sampled: bool,
}

impl Context {
    /// What the caller says in `traceparent`; nothing if that is missing or broken.
    pub fn of_caller(headers: &HeaderMap) -> Option<Self> {
        let mut values = headers.get_all("traceparent").iter();
        let (Some(value), None) = (values.next(), values.next()) else { return None };
        let mut parts = value.to_str().ok()?.trim().split('-');
        let mut part = |digits: usize| {
            let part = parts.next()?;
            let is_hex = part.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
            (part.len() == digits && is_hex).then(|| u128::from_str_radix(part, 16).ok())?
        };
        let (version, trace, parent, flags) = (part(2)?, part(32)?, part(16)?, part(2)?);
        // Later versions may add parts.
        if version == 0xff || (version == 0 && parts.next().is_some()) || trace == 0 || parent == 0 {
            return None;
        }
        let parent = u64::try_from(parent).ok()?;
        Some(Self { trace, parent: Some(parent), sampled: flags & 1 == 1 })
    }
}

/// Takes a share of all traces.
pub(super) struct Sampler {
    /// Trace ids whose random bits are below are left out.
    least: u64,
}

impl Sampler {
    /// Takes `ratio`, from 0 to 1, of them.
    pub fn new(ratio: f64) -> Self {
        Self { least: ((1.0 - ratio.clamp(0.0, 1.0)) * (RANDOM + 1) as f64) as u64 }
    }

    /// A new trace, if this one is to be recorded.
    pub fn root(&self) -> Option<Context> {
        let trace = fastrand::u128(1..);
        let sampled = (trace as u64 & RANDOM) >= self.least;
        sampled.then_some(Context { trace, parent: None, sampled })
    }
}

/// A new span's id.
pub(super) fn span_id() -> u64 {
    fastrand::u64(1..)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_caller_s_trace_goes_on_if_it_is_well_told() {
        let read = |value: &str| {
            let headers = HeaderMap::from_iter([("traceparent".parse().unwrap(), value.parse().unwrap())]);
            Context::of_caller(&headers)
        };
        let trace = 0x4bf9_2f35_77b3_4da6_a3ce_929d_0e0e_4736;
        let expected = |sampled| Some(Context { trace, parent: Some(0x00f0_67aa_0ba9_02b7), sampled });
        let ids = "4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7";
        assert_eq!(read(&format!("00-{ids}-01")), expected(true));
        assert_eq!(read(&format!("00-{ids}-02")), expected(false));
        assert_eq!(read(&format!("cc-{ids}-03-more")), expected(true));
        for wrong in [
            "",
            "00",
            &format!("00-{ids}"),
            &format!("00-{ids}-1"),
            &format!("00-{ids}-01-more"),
            &format!("ff-{ids}-01"),
            &format!("00-{}-01", ids.to_uppercase()),
            &format!("00-{}-01", ids.replace('4', "+")),
            "00-00000000000000000000000000000000-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-0000000000000000-01",
        ] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
        assert_eq!(Context::of_caller(&HeaderMap::new()), None);
    }

    #[test]
    fn the_share_is_kept() {
        fastrand::seed(7);
        let share = |ratio: f64| {
            let sampler = Sampler::new(ratio);
            (0..20_000).filter(|_| sampler.root().is_some()).count() as f64 / 20_000.0
        };
        assert_eq!((share(0.0), share(1.0)), (0.0, 1.0));
        for ratio in [0.01, 0.25] {
            assert!((share(ratio) - ratio).abs() < 0.2 * ratio, "{ratio}: {}", share(ratio));
        }
    }
}
