use std::collections::BTreeMap;
use std::sync::Weak;

use proptest::prelude::*;

use super::*;
use crate::types::{CaptureTime, Clock, MediaTime};

fn camera(name: &str) -> CameraId {
    CameraId::new(name).unwrap()
}

fn report(name: &str, epoch: u64, seq: u64) -> Arc<FrameTracks> {
    Arc::new(FrameTracks {
        camera: camera(name),
        epoch: Epoch(epoch),
        seq,
        frame: seq,
        time: MediaTime(0),
        capture: CaptureTime { unix_ns: 0, clock: Clock::Media },
        width: 64,
        height: 48,
        tracks: Vec::new(),
        ended: Vec::new(),
    })
}

fn hub(capacity: usize) -> Hub {
    Hub::new(HubConfig { capacity, max_gaps: 64 }, Arc::from(["person".to_owned()]))
}

/// What a subscriber knows of one camera: `(epoch, seq)` of all reports received or announced as
/// missing, in the order in which it learned of them.
#[derive(Default)]
struct Ledger {
    told: BTreeMap<CameraId, Vec<(u64, u64)>>,
    received: usize,
    missing: usize,
}

impl Ledger {
    fn enter(&mut self, event: &Event) {
        match event {
            Event::Tracks(report) => {
                let t = &report.tracks;
                self.told.entry(t.camera.clone()).or_default().push((t.epoch.0, t.seq));
                self.received += 1;
            }
            Event::Gap(gap) => {
                assert!(gap.first <= gap.last, "{gap:?}");
                let told = self.told.entry(gap.camera.clone()).or_default();
                told.extend((gap.first..=gap.last).map(|seq| (gap.epoch.0, seq)));
                self.missing += (gap.last - gap.first + 1) as usize;
            }
        }
    }
}

#[derive(Clone, Debug)]
enum Step {
    Publish(usize),
    Restart(usize),
    Take(usize),
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        8 => (0..3usize).prop_map(Step::Publish),
        1 => (0..3usize).prop_map(Step::Restart),
        3 => (1..9usize).prop_map(Step::Take),
    ];
    prop::collection::vec(step, 1..200)
}

proptest! {
    /// Whatever is published and whenever it is read: reports and gaps together are exactly what was
    /// published, in order; a gap is announced before the next report of its camera; the ring holds
    /// no more than its capacity; the counters agree.
    #[test]
    fn reports_and_gaps_tile_what_was_published(capacity in 1..6usize, steps in steps()) {
        let names = ["a", "b", "c"];
        let hub = hub(capacity);
        let mut all = hub.subscribe(Only::All);
        let mut only_b = hub.subscribe(Only::Cameras([camera("b")].into()));
        let (mut ledger, mut ledger_b) = (Ledger::default(), Ledger::default());
        let mut published: BTreeMap<CameraId, Vec<(u64, u64)>> = BTreeMap::new();
        let mut next = [(0, 0); 3];
        for step in steps {
            match step {
                Step::Publish(i) => {
                    let (epoch, seq) = next[i];
                    hub.publish(report(names[i], epoch, seq));
                    published.entry(camera(names[i])).or_default().push((epoch, seq));
                    next[i].1 += 1;
                }
                Step::Restart(i) => next[i] = (next[i].0 + 1, 0),
                Step::Take(n) => (0..n).for_each(|_| {
                    if let Some(event) = all.try_next() { ledger.enter(&event) }
                }),
            }
            prop_assert!(lock(&all.mailbox.ring).reports.len() <= capacity);
        }
        while let Some(event) = all.try_next() { ledger.enter(&event) }
        while let Some(event) = only_b.try_next() { ledger_b.enter(&event) }
        prop_assert!(!all.given_up() && !only_b.given_up());
        prop_assert_eq!(ledger_b.told.get(&camera("b")), published.get(&camera("b")));
        prop_assert!(ledger_b.told.keys().all(|id| id.as_str() == "b"));
        prop_assert_eq!(hub.metrics().dropped_by_lag.get() as usize, ledger.missing + ledger_b.missing);
        prop_assert_eq!(hub.metrics().published.get() as usize, ledger.received + ledger.missing);
        prop_assert_eq!(ledger.told, published);
    }
}

#[test]
fn a_gap_comes_before_the_reports_that_follow_it() {
    let hub = hub(2);
    let mut slow = hub.subscribe(Only::All);
    for seq in 0..5 {
        hub.publish(report("a", 1, seq));
    }
    let Some(Event::Gap(gap)) = slow.try_next() else { panic!("the gap first") };
    assert_eq!(gap, Gap { camera: camera("a"), epoch: Epoch(1), first: 0, last: 2 });
    for expected in [3, 4] {
        let Some(Event::Tracks(report)) = slow.try_next() else { panic!("a report") };
        assert_eq!(report.tracks.seq, expected);
    }
    assert!(slow.try_next().is_none());
}

#[test]
fn a_slow_subscriber_touches_nobody_else() {
    let hub = hub(4);
    let slow = hub.subscribe(Only::All);
    let mut quick = hub.subscribe(Only::All);
    let mut ledger = Ledger::default();
    for seq in 0..1000 {
        hub.publish(report("a", 1, seq));
        ledger.enter(&quick.try_next().unwrap());
    }
    assert_eq!((ledger.received, ledger.missing), (1000, 0));
    assert_eq!(hub.metrics().dropped_by_lag.get(), 996);
    drop(slow);
    assert_eq!(hub.metrics().subscribers.get(), 1);
}

#[test]
fn memory_is_bounded_by_the_capacity() {
    let hub = hub(8);
    let stalled = hub.subscribe(Only::All);
    let reports: Vec<Weak<FrameTracks>> = (0..500)
        .map(|seq| {
            let report = report("a", 1, seq);
            let weak = Arc::downgrade(&report);
            hub.publish(report);
            weak
        })
        .collect();
    assert_eq!(reports.iter().filter(|weak| weak.strong_count() > 0).count(), 8);
    drop(stalled);
    assert_eq!(reports.iter().filter(|weak| weak.strong_count() > 0).count(), 0);
}

#[tokio::test]
async fn a_subscriber_with_too_many_holes_is_given_up() {
    let hub = hub(1);
    let mut stalled = hub.subscribe(Only::All);
    // Every epoch leaves a hole of its own: 64 may be pending.
    for epoch in 0..66 {
        assert!(!stalled.given_up(), "{epoch}");
        hub.publish(report("a", epoch, 0));
    }
    assert!(stalled.given_up());
    assert!(stalled.next().await.is_none(), "it learns nothing rather than half of it");
    assert_eq!(hub.metrics().given_up.get(), 1);
}

#[tokio::test]
async fn closing_ends_after_what_is_there() {
    let hub = hub(4);
    let mut subscription = hub.subscribe(Only::All);
    hub.publish(report("a", 1, 0));
    hub.close();
    hub.publish(report("a", 1, 1));
    assert!(matches!(subscription.next().await, Some(Event::Tracks(r)) if r.tracks.seq == 0));
    assert!(subscription.next().await.is_none());
    assert!(hub.subscribe(Only::All).next().await.is_none(), "a closed hub has nothing to say");
}

/// Publishers and subscribers on threads of their own, subscribers coming and going at different
/// paces: nobody misses a wake-up (that would hang here), and everybody's account is exact.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn threads_race_and_every_account_is_exact() {
    const REPORTS: u64 = 20_000;
    let hub = hub(16);
    let readers: Vec<_> = (0..4u64)
        .map(|pace| {
            let mut subscription = hub.subscribe(Only::All);
            tokio::spawn(async move {
                let mut ledger = Ledger::default();
                let mut count = 0;
                while let Some(event) = subscription.next().await {
                    ledger.enter(&event);
                    count += 1;
                    // Reader 0 never pauses; the others let go ever more often.
                    if pace > 0 && count % (1000 / pace) == 0 {
                        tokio::time::sleep(std::time::Duration::from_millis(1)).await;
                    }
                }
                ledger
            })
        })
        .collect();
    let publishers: Vec<_> = ["a", "b"]
        .map(|name| {
            let hub = hub.clone();
            std::thread::Builder::new()
                .name(format!("publish-{name}"))
                .spawn(move || (0..REPORTS).for_each(|seq| hub.publish(report(name, 3, seq))))
                .unwrap()
        })
        .into();
    publishers.into_iter().for_each(|thread| thread.join().unwrap());
    hub.close();
    let mut missing = 0;
    for reader in readers {
        let ledger = reader.await.unwrap();
        for name in ["a", "b"] {
            let expected: Vec<_> = (0..REPORTS).map(|seq| (3, seq)).collect();
            assert_eq!(ledger.told[&camera(name)], expected, "camera {name}");
        }
        missing += ledger.missing;
    }
    assert_eq!(hub.metrics().dropped_by_lag.get() as usize, missing);
    assert_eq!(hub.metrics().published.get(), 2 * REPORTS);
}
