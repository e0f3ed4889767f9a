//! The queue of encoded frames before a camera's decoder, kept short in age.
//!
//! On a machine that cannot decode as fast as a camera sends, something must go. Whole groups of
//! pictures go, up to the next key frame, so that what is decoded is sound and never old.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use gstreamer as gst;
use gstreamer::prelude::*;

use super::graph::Shared;

/// Encoded frames that wait, at most.
const MOST_FRAMES: u32 = 200;
/// How long one waits, at most.
const MOST_AGE: Duration = Duration::from_secs(2);

/// Under this name a buffer carries when it arrived.
const ARRIVAL: &str = "timestamp/x-gakp-arrival";

/// Watches both ends of a queue element.
pub(crate) fn guard(queue: &gst::Element, shared: &Arc<Shared>) -> Option<()> {
    let (entry, exit) = (queue.static_pad("sink")?, queue.static_pad("src")?);
    let caps = gst::Caps::new_empty_simple(ARRIVAL);

    let (weak, told, gap) = (queue.downgrade(), shared.clone(), AtomicBool::new(false));
    entry.add_probe(gst::PadProbeType::BUFFER, move |_, info| {
        told.data_arrived();
        let Some(buffer) = info.buffer_mut() else { return gst::PadProbeReturn::Ok };
        let full = weak.upgrade().is_some_and(|q| q.property::<u32>("current-level-buffers") >= MOST_FRAMES);
        if full || (gap.load(Ordering::Relaxed) && !is_key(buffer)) {
            gap.store(true, Ordering::Relaxed);
            told.skip_one();
            return gst::PadProbeReturn::Handled;
        }
        gap.store(false, Ordering::Relaxed);
        let age = gst::ClockTime::try_from(told.started().elapsed()).unwrap_or_default();
        gst::ReferenceTimestampMeta::add(buffer.make_mut(), &caps, age, gst::ClockTime::NONE);
        gst::PadProbeReturn::Ok
    });

    let (told, gap) = (shared.clone(), AtomicBool::new(false));
    exit.add_probe(gst::PadProbeType::BUFFER, move |_, info| {
        let Some(buffer) = info.buffer() else { return gst::PadProbeReturn::Ok };
        let old = arrival(buffer, told.started()).is_some_and(|at| at.elapsed() > MOST_AGE);
        if old || (gap.load(Ordering::Relaxed) && !is_key(buffer)) {
            gap.store(true, Ordering::Relaxed);
            told.skip_one();
            return gst::PadProbeReturn::Handled;
        }
        gap.store(false, Ordering::Relaxed);
        gst::PadProbeReturn::Ok
    });
    Some(())
}

/// When the encoded frame arrived that this buffer holds or was decoded from.
pub(crate) fn arrival(buffer: &gst::BufferRef, started: Instant) -> Option<Instant> {
    buffer
        .iter_meta::<gst::ReferenceTimestampMeta>()
        .find(|meta| meta.reference().structure(0).is_some_and(|s| s.name() == ARRIVAL))
        .map(|meta| started + Duration::from(meta.timestamp()))
}

fn is_key(buffer: &gst::BufferRef) -> bool {
    !buffer.flags().contains(gst::BufferFlags::DELTA_UNIT)
}
