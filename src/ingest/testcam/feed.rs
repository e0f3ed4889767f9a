//! One client's supply of frames. GStreamer asks for each; its sinks keep the pace.

use std::sync::{Arc, Mutex, MutexGuard};

use gstreamer as gst;
use gstreamer::glib;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;

use super::footage::Footage;

/// The supplies of all clients.
#[derive(Default)]
pub(super) struct Feeds(Mutex<All>);

#[derive(Default)]
struct All {
    frozen: bool,
    /// Between two frames passes so many times as long as in the footage; 0 means 1.
    slowed: u64,
    /// Sent instead of a client's own.
    instead: Option<Arc<Footage>>,
    feeds: Vec<Feed>,
}

/// Where one client is.
struct Feed {
    source: glib::WeakRef<gst_app::AppSrc>,
    footage: Arc<Footage>,
    looped: bool,
    /// The next frame of the round.
    next: usize,
    /// When that is decoded.
    due: gst::ClockTime,
    /// It comes from the footage that is sent instead.
    away: bool,
    /// It asked for a frame while frozen.
    hungry: bool,
}

impl Feeds {
    fn lock(&self) -> MutexGuard<'_, All> {
        self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// A new client, from the first frame on.
    pub fn add(self: &Arc<Self>, source: &gst_app::AppSrc, footage: Arc<Footage>, looped: bool) {
        source.set_caps(Some(&footage.caps));
        source.set_format(gst::Format::Time);
        source.set_stream_type(gst_app::AppStreamType::Stream);
        let mut all = self.lock();
        all.feeds.retain(|feed| feed.source.upgrade().is_some());
        let due = gst::ClockTime::ZERO;
        let source_ref = source.downgrade();
        all.feeds.push(Feed {
            source: source_ref,
            footage,
            looped,
            next: 0,
            due,
            away: false,
            hungry: false,
        });
        drop(all);
        let feeds = Arc::downgrade(self);
        source.set_callbacks(
            gst_app::AppSrcCallbacks::builder()
                .need_data(move |source, _| {
                    if let Some(feeds) = feeds.upgrade() {
                        feeds.supply(source);
                    }
                })
                .build(),
        );
    }

    fn supply(&self, source: &gst_app::AppSrc) {
        let mut all = self.lock();
        let All { frozen, slowed, instead, feeds } = &mut *all;
        let Some(feed) = feeds.iter_mut().find(|feed| feed.source.upgrade().as_ref() == Some(source)) else {
            return;
        };
        if *frozen {
            feed.hungry = true;
        } else {
            feed.push(source, *slowed, instead.as_deref());
        }
    }

    /// Nothing is sent any more, or again.
    pub fn freeze(&self, frozen: bool) {
        let mut all = self.lock();
        let All { frozen: now, slowed, instead, feeds } = &mut *all;
        *now = frozen;
        if frozen {
            return;
        }
        for feed in feeds {
            if let (true, Some(source)) = (std::mem::take(&mut feed.hungry), feed.source.upgrade()) {
                // Time went on: what was not sent is not made up for in a burst.
                feed.due = source.current_running_time().map_or(feed.due, |now| now.max(feed.due));
                feed.push(&source, *slowed, instead.as_deref());
            }
        }
    }

    /// From one frame to the next it takes so many times as long.
    pub fn slow(&self, times: u64) {
        self.lock().slowed = times;
    }

    /// From the next key frame on, this is sent instead, or no longer.
    pub fn replace(&self, footage: Option<Arc<Footage>>) {
        self.lock().instead = footage;
    }
}

impl Feed {
    /// Hands over one frame. An error means that the client is leaving.
    fn push(&mut self, source: &gst_app::AppSrc, slowed: u64, instead: Option<&Footage>) {
        if self.away != instead.is_some() {
            self.away = instead.is_some();
            let footage = instead.unwrap_or(&self.footage);
            self.next = footage.key_from(self.next);
        }
        let Footage { units, round, .. } = instead.unwrap_or(&self.footage);
        let Some(unit) = units.get(self.next) else {
            let _ = source.end_of_stream();
            return;
        };
        // The copy shares the bytes.
        let mut buffer = unit.data.copy();
        if let Some(buffer) = buffer.get_mut() {
            buffer.set_pts(self.due + unit.pts.saturating_sub(unit.dts) * slowed.max(1));
            buffer.set_dts(self.due);
            if !unit.key {
                buffer.set_flags(gst::BufferFlags::DELTA_UNIT);
            }
        }
        self.next += 1;
        let follows = units.get(self.next).map_or(*round, |unit| unit.dts);
        self.due += follows.saturating_sub(unit.dts) * slowed.max(1);
        if self.looped {
            self.next %= units.len();
        }
        let _ = source.push_buffer(buffer);
    }
}
