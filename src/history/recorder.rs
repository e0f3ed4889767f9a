//! What is to be written: tracks that changed, their new key boxes, events.

use std::collections::{BTreeMap, HashMap};
use std::mem::take;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::path::{KeyBox, Path};
use crate::publish::NumberedEvent;
use crate::types::{CameraId, ClassId, Epoch, FrameTracks, TrackId, TrackReport, TrackState};

/// A camera that has said nothing for so long has ended, and its tracks with it.
const SILENCE: Duration = Duration::from_secs(60);

/// A track's name for good.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TrackKey {
    /// Whose.
    pub camera: CameraId,
    /// Generation of ids.
    pub epoch: Epoch,
    /// Id within it.
    pub id: TrackId,
}

/// What is known of a track.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackRow {
    /// Which.
    pub key: TrackKey,
    /// Its class.
    pub class: ClassId,
    /// When it was first seen, nanoseconds since 1970.
    pub first_ns: i64,
    /// The newest box: when it was last seen.
    pub last: KeyBox,
    /// Whether it is over.
    pub ended: bool,
    /// Its best score.
    pub confidence: f64,
    /// Width and height of the picture.
    pub size: [u32; 2],
}

/// What one transaction writes. A later batch may name the same tracks again.
#[derive(Debug, Default)]
pub struct Batch {
    /// Tracks that are new or have changed.
    pub tracks: Vec<TrackRow>,
    /// Their key boxes.
    pub boxes: Vec<(TrackKey, KeyBox)>,
    /// Events.
    pub events: Vec<Arc<NumberedEvent>>,
}

impl Batch {
    /// Whether there is nothing to write.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Rows.
    pub fn len(&self) -> usize {
        self.tracks.len() + self.boxes.len() + self.events.len()
    }

    /// Adds what came later.
    pub fn append(&mut self, mut later: Batch) {
        self.tracks.append(&mut later.tracks);
        self.boxes.append(&mut later.boxes);
        self.events.append(&mut later.events);
    }

    /// Each row alone, tracks before what belongs to them.
    pub(super) fn into_rows(self) -> impl Iterator<Item = Batch> {
        let tracks = self.tracks.into_iter().map(|row| Batch { tracks: vec![row], ..Batch::default() });
        let boxes = self.boxes.into_iter().map(|row| Batch { boxes: vec![row], ..Batch::default() });
        let events = self.events.into_iter().map(|row| Batch { events: vec![row], ..Batch::default() });
        tracks.chain(boxes).chain(events)
    }
}

/// A track that lives. It is recorded from its first confirmed box on.
struct Live {
    class: ClassId,
    first_ns: i64,
    path: Path,
    confidence: f64,
    seen: bool,
    changed: bool,
}

/// The live tracks of one camera and epoch.
struct Generation {
    live: BTreeMap<TrackId, Live>,
    size: [u32; 2],
    heard: Instant,
}

/// Takes what is published; its size is bounded by the tracks that live and what was not taken yet.
#[derive(Default)]
pub struct Recorder {
    generations: HashMap<(CameraId, Epoch), Generation>,
    batch: Batch,
}

impl Recorder {
    /// A frame.
    pub fn frame(&mut self, report: &FrameTracks) {
        let key = (report.camera.clone(), report.epoch);
        if !self.generations.contains_key(&key) {
            // Ids have begun anew: what was alive is over.
            self.end_generations(|(camera, epoch), _| *camera == report.camera && *epoch < report.epoch);
            let generation = Generation { live: BTreeMap::new(), size: [0; 2], heard: Instant::now() };
            self.generations.insert(key.clone(), generation);
        }
        let Some(generation) = self.generations.get_mut(&key) else { return };
        (generation.heard, generation.size) = (Instant::now(), [report.width, report.height]);
        let mut keys = vec![];
        for track in &report.tracks {
            generation.see(report, track, &mut keys);
            let key = || TrackKey { camera: report.camera.clone(), epoch: report.epoch, id: track.id };
            self.batch.boxes.extend(keys.drain(..).map(|found| (key(), found)));
        }
        for id in &report.ended {
            if let Some(live) = generation.live.remove(id) {
                let key = TrackKey { camera: report.camera.clone(), epoch: report.epoch, id: *id };
                live.end(key, generation.size, &mut self.batch);
            }
        }
    }

    /// An event.
    pub fn event(&mut self, event: Arc<NumberedEvent>) {
        self.batch.events.push(event);
    }

    /// What is to be written since the last time.
    pub fn take(&mut self) -> Batch {
        self.end_generations(|_, generation| generation.heard.elapsed() > SILENCE);
        let mut batch = take(&mut self.batch);
        for ((camera, epoch), generation) in &mut self.generations {
            for (id, live) in generation.live.iter_mut().filter(|(_, live)| live.changed) {
                live.changed = false;
                let key = TrackKey { camera: camera.clone(), epoch: *epoch, id: *id };
                batch.tracks.push(live.row(key, generation.size, false));
            }
        }
        batch
    }

    /// Ends everything that lives: the service stops.
    pub fn finish(&mut self) -> Batch {
        self.end_generations(|_, _| true);
        take(&mut self.batch)
    }

    fn end_generations(&mut self, over: impl Fn(&(CameraId, Epoch), &Generation) -> bool) {
        let batch = &mut self.batch;
        self.generations.retain(|name, generation| {
            let over = over(name, generation);
            if over {
                for (id, live) in take(&mut generation.live) {
                    let key = TrackKey { camera: name.0.clone(), epoch: name.1, id };
                    live.end(key, generation.size, batch);
                }
            }
            !over
        });
    }
}

impl Generation {
    fn see(&mut self, report: &FrameTracks, track: &TrackReport, keys: &mut Vec<KeyBox>) {
        let live = self.live.get_mut(&track.id);
        if track.state != TrackState::Confirmed {
            if let Some(live) = live {
                live.seen = false;
            }
            return;
        }
        let bbox = track.bbox;
        let next = KeyBox {
            frame: report.frame,
            unix_ns: report.capture.unix_ns,
            bbox: [bbox.x, bbox.y, bbox.w, bbox.h],
            after_gap: live.as_ref().is_some_and(|live| !live.seen),
        };
        match live {
            Some(live) => {
                live.path.push(next, keys);
                live.confidence = live.confidence.max(track.confidence);
                (live.seen, live.changed) = (true, true);
            }
            None => {
                keys.push(next);
                let (class, first_ns, confidence) = (track.class, next.unix_ns, track.confidence);
                let path = Path::new(next);
                self.live
                    .insert(track.id, Live { class, first_ns, path, confidence, seen: true, changed: true });
            }
        }
    }
}

impl Live {
    fn row(&self, key: TrackKey, size: [u32; 2], ended: bool) -> TrackRow {
        let Self { class, first_ns, confidence, .. } = *self;
        TrackRow { key, class, first_ns, last: *self.path.last(), ended, confidence, size }
    }

    fn end(mut self, key: TrackKey, size: [u32; 2], batch: &mut Batch) {
        let mut keys = vec![];
        self.path.close(&mut keys);
        batch.boxes.extend(keys.into_iter().map(|found| (key.clone(), found)));
        batch.tracks.push(self.row(key, size, true));
    }
}
