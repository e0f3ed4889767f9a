//! A day of crowds, faster than the clock: memory, threads and ids of everything behind the models.
//!
//!     cargo bench --bench day [-- HOURS]
//!
//! Worlds of a minute with known people (`gakp simulate`), whose detections go through tracker, hub, lines and zones,
//! history, picture and a subscriber that encodes each report. People come and go; sizes, rates and crowds change from
//! world to world. Each hour: what was tracked and what the process holds. An id that comes back after its end, or one that
//! is not newer than all before it, ends the run.

#[path = "../tests/service/vitals.rs"]
mod vitals;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use gakp::analytics::{Anchor, Line, Point, RuleId, Rules, Zone};
use gakp::history::{History, HistoryMetrics, HistorySettings};
use gakp::mot::Row;
use gakp::pipeline::{CameraAnalyst, LiveOutlet, Outlet};
use gakp::publish::{Event, EventHub, Hub, HubConfig, Only};
use gakp::simulate::{Simulated, simulate};
use gakp::telemetry::Metrics;
use gakp::track::{Association, FrameInput, LinkRequest, Tracker, TrackerConfig};
use gakp::types::{
    CameraId, CaptureTime, ClassId, Clock, Detection, Epoch, Frame, FrameTracks, Image, MediaTime, Plane,
    TrackId, YuvMatrix, YuvRange,
};
use tokio::sync::watch;
use vitals::Vitals;

/// Seconds of a world.
const WORLD: f64 = 60.0;
/// Hours until memory is at its height: the history keeps no more, rings are full.
const WARM_UP: u64 = 4;
/// Reports on their way to the subscribers; the clock is faster than any real camera's, the rings are not longer.
const AHEAD: u64 = 64;

/// A camera's share of the service behind the models.
struct Camera {
    id: CameraId,
    tracker: Tracker,
    outlet: LiveOutlet,
    alive: BTreeSet<TrackId>,
    newest: u64,
    index: u64,
    /// Of the media and the calendar, nanoseconds.
    now: i64,
    begins: i64,
}

impl Camera {
    /// One world, from where the last one ended.
    fn play(&mut self, world: &Simulated, told: &dyn Fn(u64)) {
        let info = &world.info;
        let image = grey((info.width, info.height));
        let mut rows = world.detections.as_slice();
        for number in 1..=info.length {
            let of_frame = rows.partition_point(|row| row.frame <= number);
            let (mine, later) = rows.split_at(of_frame);
            rows = later;
            self.now += (1e9 / info.frame_rate) as i64;
            self.frame(&image, mine);
            told(self.index);
        }
    }

    fn frame(&mut self, image: &Image, rows: &[Row]) {
        let detection = |row: &Row| Detection { bbox: row.bbox, score: row.conf, class: ClassId::PERSON };
        let detections: Vec<_> = rows.iter().map(detection).collect();
        let time = MediaTime(self.now);
        let input = FrameInput {
            time,
            width: image.width.into(),
            height: image.height.into(),
            detections: &detections,
            embeddings: &[],
            shift: None,
        };
        self.tracker.predict(input, &mut LinkRequest::default());
        let update = self.tracker.update(&[]).expect("no scores are asked");
        for track in &update.tracks {
            if self.alive.insert(track.id) {
                assert!(track.id.0 > self.newest, "{:?} is not new", track.id);
                self.newest = track.id.0;
            }
        }
        for id in &update.ended {
            self.alive.remove(id);
        }
        assert_eq!(self.alive.len(), update.tracks.len(), "each that is no longer told of has ended");
        let capture = CaptureTime { clock: Clock::Arrival, unix_ns: self.begins + self.now };
        let frame = Frame {
            camera: self.id.clone(),
            epoch: Epoch(1),
            index: self.index,
            time,
            capture,
            decoded: Instant::now(),
            image: image.clone(),
        };
        let report = FrameTracks {
            camera: self.id.clone(),
            epoch: Epoch(1),
            seq: self.index,
            frame: self.index,
            time,
            capture,
            width: image.width,
            height: image.height,
            tracks: update.tracks,
            ended: update.ended,
        };
        self.index += 1;
        self.outlet.emit(Arc::new(frame), Arc::new(report));
    }
}

fn grey((width, height): (u32, u32)) -> Image {
    let (w, h) = (width as usize, height as usize);
    let planes = [(0, w), (w * h, w / 2), (w * h * 5 / 4, w / 2)];
    let planes = planes.map(|(offset, stride)| Plane { offset, stride });
    let bytes = Arc::new(vec![128; w * h * 3 / 2]);
    Image::i420((width, height), YuvRange::Limited, YuvMatrix::Bt601, planes, bytes).expect("a picture")
}

/// A line across the picture, a zone in its middle.
fn rules() -> Rules {
    let point = |x, y| Point { x, y };
    let id = |name| RuleId::new(name).expect("a name");
    let points = vec![point(0.5, 1.0), point(0.5, 0.0)];
    let line = Line { id: id("middle"), points, anchor: Anchor::Foot };
    let polygon = vec![point(0.2, 0.2), point(0.8, 0.2), point(0.8, 0.9), point(0.2, 0.9)];
    let (loiter, capacity) = (Some(10.0), Some(5));
    let zone = Zone { id: id("floor"), points: polygon, anchor: Anchor::Foot, loiter, capacity };
    Rules { lines: vec![line], zones: vec![zone], ..Rules::default() }
}

/// What is allocated, MB: the worlds themselves, which no service has, come and go in between and leave holes.
fn in_use() -> f64 {
    // SAFETY: takes nothing, gives numbers.
    let info = unsafe { nix::libc::mallinfo2() };
    (info.uordblks + info.hblkhd) as f64 * 1e-6
}

/// Takes every report, as a client's stream does, and says how far it is.
async fn subscribe(hub: Hub, seen: Arc<AtomicU64>) {
    let mut reports = hub.subscribe(Only::All);
    while let Some(event) = reports.next().await {
        if let Event::Tracks(report) = event {
            std::hint::black_box((report.json(), report.protobuf()));
            seen.store(report.tracks.seq, Ordering::Release);
        }
    }
}

fn main() {
    gakp::ingest::memory::arena_a_core();
    // Cargo passes `--bench`.
    let hours = std::env::args().skip(1).find(|arg| arg != "--bench");
    let hours: u64 = hours.map_or(24, |n| n.parse().expect("a number of hours"));
    let folder = tempfile::tempdir().expect("a folder");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let metrics = Metrics::new().expect("metrics");
    let classes: Arc<[String]> = [String::from("person")].into();
    let (hub, events) = (Hub::new(HubConfig::default(), classes.clone()), EventHub::new(classes));
    // So little that the oldest goes all the time.
    let settings =
        HistorySettings { max_bytes: Some(5_000_000), ..HistorySettings::in_folder(folder.path()) };
    let figures = HistoryMetrics::new(&prometheus::Registry::new()).expect("metrics");
    let history = runtime.block_on(History::start(settings, &hub, &events, figures)).expect("a history");
    let seen = Arc::new(AtomicU64::new(0));
    let client = runtime.spawn(subscribe(hub.clone(), seen.clone()));
    let id = CameraId::new("square").expect("a name");
    let analyst = Arc::new(CameraAnalyst::new(id.clone(), rules(), metrics, events));
    let (video, watched) = watch::channel(None);
    let mut config = TrackerConfig::default();
    config.association.method = Association::IouMotion;
    let since_1970 =
        SystemTime::now().duration_since(UNIX_EPOCH).expect("a clock after 1970").as_nanos() as i64;
    let mut camera = Camera {
        id,
        tracker: Tracker::new(config),
        outlet: LiveOutlet { hub: hub.clone(), video, analyst: analyst.clone() },
        alive: BTreeSet::new(),
        newest: 0,
        index: 0,
        now: 0,
        begins: since_1970 - (hours * 3600) as i64 * 1_000_000_000,
    };
    let told = |index: u64| {
        while index > seen.load(Ordering::Acquire) + AHEAD {
            std::thread::sleep(Duration::from_micros(200));
        }
    };
    println!("hour     frames       ids  crossings  in use MB  resident MB  threads  descriptors");
    let (started, mut looks) = (Instant::now(), vec![]);
    for hour in 1..=hours {
        for minute in 0..60 {
            camera.play(&simulate("square", WORLD, 60 * hour + minute), &told);
        }
        // What is under way comes to rest; the history writes what came a thousand times too fast.
        let mut written = u64::MAX;
        while std::mem::replace(&mut written, history.metrics().written.get()) != written {
            std::thread::sleep(Duration::from_secs(3));
        }
        let vitals = Vitals::of(std::process::id());
        let in_use = in_use();
        let crossings: u64 = analyst.counts().lines.values().map(|line| line.inwards + line.outwards).sum();
        println!(
            "{hour:4}  {:9}  {:8}  {crossings:9}  {in_use:9.1}  {:11.1}  {:7}  {:11}",
            camera.index, camera.newest, vitals.resident, vitals.threads, vitals.descriptors
        );
        if hour >= WARM_UP {
            looks.push((hour as f64, in_use));
        }
    }
    let took = started.elapsed();
    println!("{hours} hours in {:.0} s; no id was used twice", took.as_secs_f64());
    if looks.len() > 1 {
        let (slope, error) = vitals::slope(&looks);
        println!(
            "slope of the memory in use after {WARM_UP} hours: {slope:.3} MB an hour, standard error {error:.3}"
        );
    }
    let missed = history.metrics().missed_reports.get();
    println!(
        "reports that the history missed: {missed}; tracks and events that it wrote: {}",
        history.metrics().written.get()
    );
    drop((camera, watched));
    hub.close();
    runtime.block_on(async {
        client.await.expect("the client's task ends");
        history.stop().await;
    });
}
