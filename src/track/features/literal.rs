//! The features as the paper prints them: an embedding and six spatial values, for every step alike.
//!
//! | index | value |
//! | --- | --- |
//! | 0..E | the embedding, unit length; zeros where there is none, or one of another width |
//! | E, E+1 | `cx / W`, `cy / H` for a picture of `W x H` pixels |
//! | E+2, E+3 | `w / W`, `h / H` |
//! | E+4, E+5 | displacement of the centre from the observation before, `1/W` and `1/H` per second |
//!
//! So they are invariant to resolution and to frame rate, not to the place in the picture. A candidate has
//! the displacement from the track's last box, which makes it pairwise; the first observation has none.

use crate::track::pair::PairView;
use crate::track::tracklet::Tracklet;
use crate::types::{BBox, Embedding, MediaTime};

/// Spatial values of a step.
pub const SPATIAL: usize = 6;

/// Velocities are clamped to this, pictures per second: two boxes a millisecond apart say nothing.
const MAX_VELOCITY: f64 = 20.0;

/// Where and when something was seen, and what it looked like.
struct Look<'a> {
    bbox: &'a BBox,
    time: MediaTime,
    embedding: Option<&'a Embedding>,
}

fn push(
    look: &Look<'_>,
    before: Option<(&BBox, MediaTime)>,
    width: usize,
    (picture_w, picture_h): (f64, f64),
    out: &mut Vec<f32>,
) {
    match look.embedding.map(Embedding::as_slice) {
        Some(values) if values.len() == width => out.extend_from_slice(values),
        _ => out.resize(out.len() + width, 0.0),
    }
    let [w, h] = [picture_w, picture_h].map(|size| size.max(1.0));
    let velocity = |at: fn(&BBox) -> f64, size: f64| match before {
        Some((bbox, time)) if look.time > time => {
            let moved = (at(look.bbox) - at(bbox)) / size / look.time.since(time);
            moved.clamp(-MAX_VELOCITY, MAX_VELOCITY)
        }
        _ => 0.0,
    };
    let spatial: [f64; SPATIAL] = [
        look.bbox.cx() / w,
        look.bbox.cy() / h,
        look.bbox.w / w,
        look.bbox.h / h,
        velocity(BBox::cx, w),
        velocity(BBox::cy, h),
    ];
    out.extend(spatial.map(|v| v as f32));
}

pub(super) fn push_history(track: &Tracklet, width: usize, picture: (f64, f64), out: &mut Vec<f32>) {
    let mut before = None;
    for seen in &track.history {
        let look = Look { bbox: &seen.bbox, time: seen.time, embedding: seen.embedding.as_ref() };
        push(&look, before, width, picture, out);
        before = Some((&seen.bbox, seen.time));
    }
}

pub(super) fn push_candidate(pair: &PairView<'_>, width: usize, picture: (f64, f64), out: &mut Vec<f32>) {
    let last = pair.track.last();
    let look = Look { bbox: &pair.detection.bbox, time: pair.track.time, embedding: pair.embedding };
    push(&look, Some((&last.bbox, last.time)), width, picture, out);
}
