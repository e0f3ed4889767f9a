//! Which decoder: hardware before software, then by GStreamer's rank.

use std::cmp::Reverse;

use gstreamer as gst;
use gstreamer::prelude::*;

use super::failure::Failure;

/// The best decoder for these caps that this machine can bring up.
///
/// `software` leaves hardware out, `avoid` leaves out decoders by name (they failed before), and
/// `threads` limits a software decoder (more than one delays the picture by as many frames).
pub(crate) fn create(
    caps: &gst::Caps,
    software: bool,
    threads: u32,
    avoid: &[String],
) -> Result<gst::Element, Failure> {
    let hardware = |f: &gst::ElementFactory| f.has_type(gst::ElementFactoryType::HARDWARE);
    let raw = gst::Caps::new_empty_simple("video/x-raw");
    let all = gst::ElementFactory::factories_with_type(gst::ElementFactoryType::DECODER, gst::Rank::MARGINAL);
    let mut found: Vec<gst::ElementFactory> = all
        .into_iter()
        .filter(|f| f.can_sink_any_caps(caps) && f.can_src_any_caps(&raw))
        .filter(|f| !(software && hardware(f)) && !avoid.iter().any(|name| f.name() == name.as_str()))
        .collect();
    found.sort_by_key(|f| (!hardware(f), Reverse(f.rank()), f.name()));
    for factory in &found {
        let Ok(decoder) = factory.create().build() else { continue };
        // Hardware may be registered and yet not open: no permission, no free session.
        if hardware(factory) && decoder.set_state(gst::State::Ready).is_err() {
            let _ = decoder.set_state(gst::State::Null);
            continue;
        }
        if decoder.has_property("max-threads") {
            decoder.set_property_from_str("max-threads", &threads.to_string());
        }
        return Ok(decoder);
    }
    let name = caps.structure(0).map(|s| s.name().to_string()).unwrap_or_default();
    Err(Failure::Unsupported(format!(
        "no decoder for {name} is installed (Debian: gstreamer1.0-libav, gstreamer1.0-plugins-bad)"
    )))
}
