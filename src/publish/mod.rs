//! Tracks to subscribers: the hub, the wire forms of a report, pictures with boxes drawn in.
//!
//! The tracker's thread calls [`Hub::publish`], which waits for nobody. Each subscriber has a bounded
//! ring of its own; what it is too slow to take is dropped, oldest first, and announced as a [`Gap`].
//! A [`Report`] is encoded at most once per format, by the first subscriber that sends it, and the
//! bytes are shared. What the analytics find in the tracks goes to an [`EventHub`].

mod draw;
mod event;
mod filter;
mod hub;
mod json;
mod mask;
mod picture;
mod protobuf;
mod report;

pub use draw::{Trails, annotate, colour};
pub use event::{EVENT_KINDS, EventFilter, EventHub, EventListener, Heard, NumberedEvent, event_kind};
pub use filter::{Sieve, Sifted, TrackFilter};
pub use hub::{Event, Gap, Hub, HubConfig, HubMetrics, Only, Subscription};
pub(crate) use json::CaptureTs;
pub use mask::Masks;
pub use picture::{Picture, PictureError, Rgb, RgbConverter};
pub use protobuf::wire;
pub(crate) use report::class_name;
pub use report::{Report, encode_gap_json, encode_gap_protobuf, encode_json, encode_protobuf};
