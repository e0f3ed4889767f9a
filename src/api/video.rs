//! JPEGs of live cameras: made only while somebody watches, once for all who watch the same.
//!
//! ```text
//! newest Picture (watch) --gate--> blocking thread: RGB, boxes, JPEG --> newest Shot (watch) --> viewers
//! ```
//!
//! Both ends are `watch` channels of one value: a slow encoder or viewer skips pictures and always
//! has the newest. The gate bounds how many cores pictures may take from the models.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use axum::body::Bytes;
use tokio::sync::{Semaphore, watch};
use tokio::task::spawn_blocking;

use super::Cameras;
use crate::publish::{Masks, Picture, PictureError, Rgb, RgbConverter, Trails, annotate};
use crate::types::{CameraId, FrameTracks};

/// Pictures encoded at a time, over all cameras.
const ENCODERS: usize = 1;
/// Width of live pictures at most.
const LIVE_WIDTH: usize = 960;
/// JPEG quality of live pictures.
const LIVE_QUALITY: u8 = 70;
/// Width of snapshots at most.
const SNAPSHOT_WIDTH: usize = 1920;
/// JPEG quality of snapshots.
const SNAPSHOT_QUALITY: u8 = 85;

/// Whether boxes are drawn into a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum View {
    Plain,
    Annotated,
}

/// An encoded picture and the tracks of its frame.
pub(super) struct Shot {
    pub jpeg: Bytes,
    pub tracks: Arc<FrameTracks>,
}

type Newest = Option<Arc<Shot>>;

/// Makes pictures.
pub(super) struct Studio {
    gate: Arc<Semaphore>,
    live: Arc<Live>,
}

/// The encoders that run, by what they make.
type Live = Mutex<BTreeMap<(CameraId, View), Weak<watch::Sender<Newest>>>>;

impl Default for Studio {
    fn default() -> Self {
        Self { gate: Arc::new(Semaphore::new(ENCODERS)), live: Arc::default() }
    }
}

impl Studio {
    /// Live pictures of a camera; `None` when there is no such camera. The sender goes when the
    /// camera does. Dropping the last receiver stops the work.
    pub fn watch(&self, cameras: &dyn Cameras, id: &CameraId, view: View) -> Option<watch::Receiver<Newest>> {
        let source = cameras.video(id)?;
        let key = (id.clone(), view);
        let mut live = self.live.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(running) = live.get(&key).and_then(Weak::upgrade) {
            let mut newest = running.subscribe();
            // A camera that stands still has shown its last picture already: show it again.
            newest.mark_changed();
            return Some(newest);
        }
        let (shots, newest) = watch::channel(None);
        let shots = Arc::new(shots);
        live.insert(key.clone(), Arc::downgrade(&shots));
        tokio::spawn(film(source, shots, key, self.gate.clone(), self.live.clone()));
        Some(newest)
    }

    /// One picture, as large as snapshots are.
    pub async fn snapshot(&self, picture: Arc<Picture>, view: View) -> Result<Shot, PictureError> {
        // The gate is never closed.
        let _turn = self.gate.acquire().await;
        let lens = Lens { view, max_width: SNAPSHOT_WIDTH, quality: SNAPSHOT_QUALITY };
        expose(Darkroom::default(), lens, picture).await.1
    }
}

/// Encodes one camera's newest pictures until nobody watches or the camera is gone.
async fn film(
    mut source: watch::Receiver<Option<Arc<Picture>>>,
    shots: Arc<watch::Sender<Newest>>,
    key: (CameraId, View),
    gate: Arc<Semaphore>,
    live: Arc<Live>,
) {
    let lens = Lens { view: key.1, max_width: LIVE_WIDTH, quality: LIVE_QUALITY };
    let mut room = Darkroom::default();
    let mut masks = Masks::none();
    // The picture that is already there is wanted as well.
    source.mark_changed();
    loop {
        let here = tokio::select! {
            changed = source.changed() => changed.is_ok(),
            // A camera may stand still: its last picture is made again.
            () = masks.changed() => true,
            () = shots.closed() => true,
        };
        {
            // Under the lock that hands out receivers: nobody can begin to watch in between.
            let mut live = live.lock().unwrap_or_else(PoisonError::into_inner);
            if !here || shots.is_closed() {
                if live.get(&key).is_some_and(|entry| entry.as_ptr() == Arc::as_ptr(&shots)) {
                    live.remove(&key);
                }
                return;
            }
        }
        let _turn = gate.acquire().await;
        // Whatever came while waiting for the turn: the newest.
        let Some(picture) = source.borrow_and_update().clone() else { continue };
        masks = picture.masks().clone();
        masks.mark_seen();
        let (back, shot) = expose(room, lens, picture).await;
        room = back;
        match shot {
            Ok(shot) => drop(shots.send_replace(Some(Arc::new(shot)))),
            Err(error) => tracing::warn!(camera = %key.0, %error, "a live picture could not be made"),
        }
    }
}

#[derive(Clone, Copy)]
struct Lens {
    view: View,
    max_width: usize,
    quality: u8,
}

/// What is kept from one picture to the next.
#[derive(Default)]
struct Darkroom {
    converter: RgbConverter,
    canvas: Rgb,
    trails: Trails,
}

/// Makes one picture on a blocking thread.
async fn expose(
    mut room: Darkroom,
    lens: Lens,
    picture: Arc<Picture>,
) -> (Darkroom, Result<Shot, PictureError>) {
    let size = (picture.size().0 as usize, picture.size().1 as usize);
    let made = spawn_blocking(move || {
        let shot = room.expose(lens, &picture);
        (room, shot)
    });
    made.await.unwrap_or_else(|error| {
        (Darkroom::default(), Err(PictureError::Encode(size.0, size.1, error.to_string())))
    })
}

impl Darkroom {
    fn expose(&mut self, lens: Lens, picture: &Picture) -> Result<Shot, PictureError> {
        self.converter.convert(picture, lens.max_width, &mut self.canvas)?;
        if lens.view == View::Annotated {
            self.trails.push(&picture.tracks);
            annotate(&mut self.canvas, &picture.tracks, &self.trails);
        }
        let jpeg = self.canvas.to_jpeg(lens.quality)?;
        Ok(Shot { jpeg: jpeg.into(), tracks: picture.tracks.clone() })
    }
}
