//! The history's databases: SQLite, and PostgreSQL from Debian's package; the same is asked of both.
#![cfg(feature = "service")]

use gakp::analytics::{Direction, Happening, Point, RuleId, What};
use gakp::history::{
    Cursor, Database, History, HistoryError, HistoryMetrics, HistorySettings, Place, Recorder, Snapshot,
    TrackKey, Wanted, at,
};
use gakp::publish::{EventFilter, EventHub, Heard, Hub, HubConfig};
use gakp::types::{
    BBox, CameraId, CaptureTime, ClassId, Clock, Epoch, FrameTracks, MediaTime, TrackId, TrackReport,
    TrackState,
};

#[path = "postgres/server.rs"]
mod server;

const FRAMES: u64 = 40;
const SECOND: i64 = 1_000_000_000;

fn camera(name: &str) -> CameraId {
    CameraId::new(name).unwrap()
}

/// Track 1 walks through, track 2 is covered from frame 10 to 20 and ends at 30, track 3 is never confirmed. One
/// frame a second from `start` on.
fn frame(name: &str, epoch: u64, start: i64, index: u64) -> FrameTracks {
    let track = |id, state, x: f64| TrackReport {
        id: TrackId(id),
        state,
        class: ClassId(0),
        bbox: BBox::new(x, 100.0 + (x / 9.0).sin() * 20.0, 40.0, 100.0),
        confidence: 0.5 + index as f64 / 100.0,
        link: 0.9,
        velocity: [0.0; 2],
        matched: true,
    };
    let x = index as f64 * 7.0;
    let mut tracks = vec![track(1, TrackState::Confirmed, x), track(3, TrackState::Tentative, 300.0)];
    if index < 30 {
        let state = if (10..20).contains(&index) { TrackState::Lost } else { TrackState::Confirmed };
        tracks.insert(1, track(2, state, 500.0 - x));
    }
    FrameTracks {
        camera: camera(name),
        epoch: Epoch(epoch),
        seq: index,
        frame: index,
        time: MediaTime(0),
        capture: CaptureTime { unix_ns: start + index as i64 * SECOND, clock: Clock::Arrival },
        width: 640,
        height: 480,
        tracks,
        ended: if index == 30 { vec![TrackId(2)] } else { vec![] },
    }
}

fn happening(index: u64) -> Option<Happening> {
    let rule = |name| RuleId::new(name).unwrap();
    let (track, what) = match index {
        5 => (1, What::Crossed { line: rule("door"), direction: Direction::In }),
        6 => (2, What::Entered { zone: rule("queue") }),
        25 => (2, What::Left { zone: rule("queue"), dwell: 19.0 }),
        35 => (1, What::Crossed { line: rule("door"), direction: Direction::Out }),
        _ => return None,
    };
    Some(Happening { track: Some((TrackId(track), ClassId(0))), place: Point { x: 0.5, y: 0.5 }, what })
}

/// Writes what a camera said, in batches as the service does.
async fn record(database: &Database, name: &str, epoch: u64, start: i64) {
    let classes = ["person".to_owned()];
    let hub = EventHub::new(classes.clone().into());
    let mut events = hub.listen(EventFilter::default());
    let mut recorder = Recorder::default();
    for index in 0..FRAMES {
        let frame = frame(name, epoch, start, index);
        recorder.frame(&frame);
        if let Some(happening) = happening(index) {
            hub.publish(&frame, &happening);
            let Some(Heard::Event(event)) = events.next().await else { panic!("an event") };
            recorder.event(event);
        }
        if index % 7 == 0 {
            database.write(&recorder.take(), &classes).await.unwrap();
        }
    }
    let mut batch = recorder.take();
    batch.append(recorder.finish());
    // What was written by halves and is written again is there once.
    database.write(&batch, &classes).await.unwrap();
    database.write(&batch, &classes).await.unwrap();
}

fn key(name: &str, epoch: u64, id: u64) -> TrackKey {
    TrackKey { camera: camera(name), epoch: Epoch(epoch), id: TrackId(id) }
}

async fn every_answer_is_right(place: Place) {
    let database = Database::new(&place).unwrap();
    database.prepare().await.unwrap();
    // Again: tables that are there stay.
    database.prepare().await.unwrap();
    let start = 1_767_323_045 * SECOND;
    record(&database, "gate", 1, start).await;
    record(&database, "gate", 2, start + 100 * SECOND).await;
    record(&database, "hall", 1, start).await;

    let totals = database.totals().await.unwrap();
    // Events are numbered by the second in which a hub began and count: those of three hubs may be the same.
    assert!((4..=12).contains(&totals.events), "{totals:?}");
    assert_eq!((totals.tracks, totals.oldest_ns), (6, Some(start)));
    assert!(database.bytes().await.unwrap() > 1000);

    // One track, its path as it was seen.
    let track = database.track(&key("gate", 1, 2)).await.unwrap().unwrap();
    assert_eq!((track.first_ns, track.last_ns, track.ended), (start, start + 29 * SECOND, true));
    assert_eq!((track.class.as_str(), track.size), ("person", [640, 480]));
    assert!((track.confidence - 0.79).abs() < 1e-9, "{}", track.confidence);
    assert!(track.path.len() < 20, "{} boxes are not simple", track.path.len());
    for index in 0..FRAMES {
        let seen = frame("gate", 1, start, index);
        let seen = seen.tracks.iter().find(|t| t.id == TrackId(2) && t.state == TrackState::Confirmed);
        match (seen, at(&track.path, index)) {
            (None, None) => {}
            (Some(seen), Some([x, y, w, h])) => {
                let b = seen.bbox;
                for (kept, seen) in [(x, b.x), (y, b.y), (x + w, b.x + b.w), (y + h, b.y + b.h)] {
                    assert!((kept - seen).abs() <= 3.0 + 1e-9, "frame {index}: {kept} for {seen}");
                }
            }
            (seen, kept) => panic!("frame {index}: {seen:?}, {kept:?}"),
        }
    }
    assert_eq!(database.track(&key("gate", 1, 3)).await.unwrap(), None, "never confirmed");

    // By camera, time, line and zone; page after page.
    let all = Wanted::default();
    let names = async |wanted: &Wanted| -> Vec<(String, u64, u64)> {
        let (mut names, mut cursor): (_, Option<Cursor>) = (vec![], None);
        loop {
            let (tracks, next) = database.tracks(wanted, cursor.as_ref(), 2).await.unwrap();
            assert!(tracks.len() <= 2);
            names.extend(tracks.iter().map(|t| (t.key.camera.to_string(), t.key.epoch.0, t.key.id.0)));
            // As it travels.
            match next {
                Some(next) => cursor = Some(next.to_string().parse().unwrap()),
                None => return names,
            }
        }
    };
    let expect = |names: &[(&str, u64, u64)]| -> Vec<(String, u64, u64)> {
        names.iter().map(|(camera, epoch, id)| ((*camera).to_owned(), *epoch, *id)).collect()
    };
    let everything =
        [("gate", 2, 2), ("gate", 2, 1), ("hall", 1, 2), ("hall", 1, 1), ("gate", 1, 2), ("gate", 1, 1)];
    assert_eq!(names(&all).await, expect(&everything));
    let gate = Wanted { camera: Some(camera("gate")), ..all.clone() };
    let door = Wanted { line: Some("door".into()), epoch: Some(Epoch(1)), ..gate.clone() };
    assert_eq!(names(&door).await, expect(&[("gate", 1, 1)]));
    let queue = Wanted { zone: Some("queue".into()), epoch: Some(Epoch(1)), ..gate.clone() };
    assert_eq!(names(&queue).await, expect(&[("gate", 1, 2)]));
    let late =
        Wanted { from_ns: Some(start + 35 * SECOND), to_ns: Some(start + 100 * SECOND), ..gate.clone() };
    assert_eq!(names(&late).await, expect(&[("gate", 1, 1)]));
    let long = Wanted { min_s: Some(35.0), camera: Some(camera("hall")), ..all.clone() };
    assert_eq!(names(&long).await, expect(&[("hall", 1, 1)]));
    let none = Wanted { class: Some("car' OR '1'='1".into()), ..all.clone() };
    assert_eq!(names(&none).await, expect(&[]));

    // Counts in buckets of ten seconds.
    let range = [start, start, start + 60 * SECOND];
    let crossings = database.crossings(&camera("gate"), "door", range, 10 * SECOND).await.unwrap();
    let counted: Vec<_> =
        crossings.iter().map(|b| ((b.start_ns - start) / SECOND, b.inwards, b.outwards)).collect();
    assert_eq!(counted, [(0, 1, 0), (30, 0, 1)]);
    let visits = database.visits(&camera("gate"), "queue", range, 60 * SECOND).await.unwrap();
    assert_eq!((visits.len(), visits[0].inwards, visits[0].outwards), (1, 1, 1));
    assert_eq!(visits[0].mean_dwell, Some(19.0));

    // Events, the newest first.
    let left = Wanted { kind: Some("zone.left".into()), to_ns: Some(start + 60 * SECOND), ..gate.clone() };
    let (events, next) = database.events(&left, None, 10).await.unwrap();
    assert!(next.is_none() && events.len() == 1, "{events:?}");
    assert!(events[0].json.contains("\"dwell_s\":19.0"), "{}", events[0].json);
    let (first, next) = database.events(&gate, None, 1).await.unwrap();
    let (second, _) = database.events(&gate, next.as_ref(), 1).await.unwrap();
    assert!(first[0].time_ns > second[0].time_ns, "{first:?} {second:?}");

    // A picture goes with its track.
    let picture = |id, jpeg: &[u8]| Snapshot { key: key("hall", 1, id), score: 1.0, jpeg: jpeg.into() };
    assert!(database.keep_snapshot(&picture(1, &[0, 1, 255])).await.unwrap());
    assert!(database.keep_snapshot(&picture(1, &[2, 3])).await.unwrap());
    assert!(!database.keep_snapshot(&picture(99, &[1])).await.unwrap());
    assert_eq!(database.snapshot(&key("hall", 1, 1)).await.unwrap(), Some(vec![2, 3]));
    assert!(database.track(&key("hall", 1, 1)).await.unwrap().unwrap().snapshot);

    // What is old goes, and what belongs to it.
    let cut = database.share_ends_at(0.5).await.unwrap().unwrap();
    assert!(cut > start && cut < start + 140 * SECOND, "{cut}");
    assert!(database.forget_before(start + 100 * SECOND).await.unwrap() >= 4);
    assert_eq!(names(&all).await, expect(&everything[..2]));
    assert_eq!(database.snapshot(&key("hall", 1, 1)).await.unwrap(), None);
    database.close().await;
}

/// What a kind of event leaves out is NULL; a statement that the database keeps must take it both ways.
async fn every_kind_of_event_is_taken_in_any_order(place: Place) {
    let database = Database::new(&place).unwrap();
    database.prepare().await.unwrap();
    let (door, queue) = (RuleId::new("door").unwrap(), RuleId::new("queue").unwrap());
    let kinds = [
        What::Crossed { line: door, direction: Direction::In },
        What::Left { zone: queue.clone(), dwell: 1.5 },
        What::Crowded { zone: queue.clone(), occupancy: 9 },
        What::Loitering { zone: queue.clone(), dwell: 2.5 },
        What::Entered { zone: queue },
    ];
    let classes = ["person".to_owned()];
    let hub = EventHub::new(classes.clone().into());
    let mut events = hub.listen(EventFilter::default());
    let mut told = 0;
    for first in 0..kinds.len() {
        for second in 0..kinds.len() {
            for kind in [first, second] {
                let what = kinds[kind].clone();
                let track = (!matches!(what, What::Crowded { .. })).then_some((TrackId(1), ClassId(0)));
                let happening = Happening { track, place: Point { x: 0.5, y: 0.5 }, what };
                hub.publish(&frame("gate", 1, SECOND, told), &happening);
                told += 1;
                let Some(Heard::Event(event)) = events.next().await else { panic!("an event") };
                let mut recorder = Recorder::default();
                recorder.event(event);
                database.write(&recorder.take(), &classes).await.unwrap();
            }
        }
    }
    assert_eq!(database.totals().await.unwrap().events, i64::try_from(told).unwrap());
    let left = Wanted { kind: Some("zone.left".into()), ..Wanted::default() };
    assert_eq!(database.events(&left, None, 100).await.unwrap().0.len(), 2 * kinds.len());
    database.close().await;
}

#[tokio::test]
async fn sqlite_takes_every_kind_of_event() {
    let folder = tempfile::tempdir().unwrap();
    every_kind_of_event_is_taken_in_any_order(Place::Sqlite(folder.path().join("h.sqlite"))).await;
}

#[tokio::test]
async fn postgres_takes_every_kind_of_event() {
    let Some(server) = server::Postgres::start() else { return };
    every_kind_of_event_is_taken_in_any_order(Place::Postgres(server.url())).await;
}

/// PostgreSQL takes no NUL in a text, whoever has named a class so.
#[tokio::test]
async fn a_row_that_is_refused_keeps_no_other_out() {
    let Some(server) = server::Postgres::start() else { return };
    let hub = Hub::new(HubConfig::default(), ["person".to_owned(), "per\0son".to_owned()].into());
    let events = EventHub::new(hub.classes().clone());
    let metrics = HistoryMetrics::new(&prometheus::Registry::new()).unwrap();
    let settings =
        HistorySettings { place: Place::Postgres(server.url()), keep: None, pictures: None, max_bytes: None };
    let history = History::start(settings, &hub, &events, metrics.clone()).await.unwrap();
    for index in 0..FRAMES {
        let mut report = frame("gate", 1, SECOND, index);
        for track in report.tracks.iter_mut().filter(|track| track.id == TrackId(2)) {
            track.class = ClassId(1);
        }
        hub.publish(report.clone().into());
        if let Some(happening) = happening(index) {
            events.publish(&report, &happening);
        }
    }
    hub.close();
    drop(events);
    let database = history.database().clone();
    tokio::time::timeout(std::time::Duration::from_secs(20), async {
        while metrics.dropped.get() == 0 || metrics.pending.get() > 0 {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    })
    .await
    .expect("a row is refused, and nothing waits");
    let (tracks, _) = database.tracks(&Wanted::default(), None, 10).await.unwrap();
    let ids: Vec<_> = tracks.iter().map(|track| track.key.id.0).collect();
    assert_eq!(ids, [1], "the other track");
    assert_eq!(database.totals().await.unwrap().events, 4);
    assert_eq!(metrics.up.get(), 1);
    history.stop().await;
}

#[tokio::test]
async fn sqlite_answers_right() {
    let folder = tempfile::tempdir().unwrap();
    // A name that means something in a URL.
    let file = folder.path().join("a b%20#?.sqlite");
    every_answer_is_right(Place::Sqlite(file.clone())).await;
    let mode = std::os::unix::fs::PermissionsExt::mode(&file.metadata().unwrap().permissions());
    assert_eq!(mode & 0o777, 0o600, "who may read it");
}

#[tokio::test]
async fn postgres_answers_right() {
    let Some(server) = server::Postgres::start() else { return };
    every_answer_is_right(Place::Postgres(server.url())).await;
}

#[tokio::test]
async fn what_cannot_be_used_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("broken.sqlite");
    std::fs::write(&broken, "this is no database, and it is long enough to be taken for one").unwrap();
    let error = Database::new(&Place::Sqlite(broken)).unwrap().prepare().await.unwrap_err();
    assert!(matches!(error, HistoryError::Database(_)), "{error}");
    let error = Database::new(&Place::Sqlite("/dev/null/x".into())).unwrap_err();
    assert!(matches!(error, HistoryError::File { .. }), "{error}");
    let error = Database::new(&Place::Postgres("postgres://u:s3cret@[/x".into())).unwrap_err();
    assert!(!error.to_string().contains("s3cret"), "{error}");
}
