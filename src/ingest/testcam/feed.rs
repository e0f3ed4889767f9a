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
    feeds: Vec<Feed>,
}

/// Where one client is.
struct Feed {
    source: glib::WeakRef<gst_app::AppSrc>,
    footage: Arc<Footage>,
    looped: bool,
    /// The next frame, counted through all rounds.
    next: usize,
    /// Added to every time: how long it was frozen.
    delay: gst::ClockTime,
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
        let delay = gst::ClockTime::ZERO;
        all.feeds.push(Feed { source: source.downgrade(), footage, looped, next: 0, delay, hungry: false });
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
        let frozen = all.frozen;
        let Some(feed) = all.feeds.iter_mut().find(|feed| feed.source.upgrade().as_ref() == Some(source))
        else {
            return;
        };
        if frozen {
            feed.hungry = true;
        } else {
            feed.push(source);
        }
    }

    pub fn freeze(&self, frozen: bool) {
        let mut all = self.lock();
        all.frozen = frozen;
        if frozen {
            return;
        }
        for feed in &mut all.feeds {
            if let (true, Some(source)) = (std::mem::take(&mut feed.hungry), feed.source.upgrade()) {
                // Time went on: what was not sent is not made up for in a burst.
                if let (Some(now), Some((_, due))) = (source.current_running_time(), feed.times()) {
                    feed.delay += now.saturating_sub(due);
                }
                feed.push(&source);
            }
        }
    }
}

impl Feed {
    /// When the next frame is shown and decoded; `None` at the end.
    fn times(&self) -> Option<(gst::ClockTime, gst::ClockTime)> {
        let count = self.footage.units.len();
        let round = (self.next / count) as u64;
        if round > 0 && !self.looped {
            return None;
        }
        let unit = &self.footage.units[self.next % count];
        let before = self.footage.round * round + self.delay;
        Some((before + unit.pts, before + unit.dts))
    }

    /// Hands over one frame. An error means that the client is leaving.
    fn push(&mut self, source: &gst_app::AppSrc) {
        let Some((pts, dts)) = self.times() else {
            let _ = source.end_of_stream();
            return;
        };
        let unit = &self.footage.units[self.next % self.footage.units.len()];
        // The copy shares the bytes.
        let mut buffer = unit.data.copy();
        if let Some(buffer) = buffer.get_mut() {
            buffer.set_pts(pts);
            buffer.set_dts(dts);
            if !unit.key {
                buffer.set_flags(gst::BufferFlags::DELTA_UNIT);
            }
        }
        self.next += 1;
        let _ = source.push_buffer(buffer);
    }
}
