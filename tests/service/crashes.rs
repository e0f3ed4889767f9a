//! kill -9 at any moment, under load: what was acknowledged is there again, what was told is in the history, and no id
//! is given out twice.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

use super::support::*;

/// What the service has said of a thing.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Said {
    There,
    Gone,
    /// Asked for when it died: either is right.
    Nothing,
}

/// What must be found again.
#[derive(Default)]
struct Book {
    /// Cameras and lines, by their path.
    things: BTreeMap<String, Said>,
    /// Ids of events that were told, and when.
    events: Vec<(String, Instant)>,
    next: usize,
}

/// Events are written every half second, and told before they are written.
const LATE: Duration = Duration::from_secs(1);

/// So many of a kind stay; then the oldest go.
const MOST: usize = 15;

/// Changes the service until it is gone: cameras and lines come and go.
fn change(service: &Service, book: &Mutex<Book>) {
    let lists = [
        ("/v1/cameras", json!({"url": "test:", "paused": true})),
        ("/v1/cameras/demo/lines", json!({"points": [[0.1, 0.1], [0.9, 0.9]]})),
    ];
    let ask = |method: &str, path: &str, thing: &str, body: Option<&str>, said: Said| {
        book.lock().unwrap().things.insert(thing.to_owned(), Said::Nothing);
        let Ok(answer) = service.try_request("", method, path, body) else { return false };
        assert_eq!(answer.status, if said == Said::There { 201 } else { 204 }, "{path}: {}", answer.body);
        book.lock().unwrap().things.insert(thing.to_owned(), said);
        true
    };
    loop {
        for (list, body) in &lists {
            let (id, surplus) = {
                let mut book = book.lock().unwrap();
                book.next += 1;
                let mine = book.things.iter().filter(|(path, said)| {
                    **said == Said::There && path.rsplit_once('/').is_some_and(|(of, _)| of == *list)
                });
                let mine: Vec<_> = mine.map(|(path, _)| path.clone()).collect();
                // Numbers of one length sort by age.
                let surplus = mine.len().saturating_sub(MOST);
                (format!("thing-{:06}", book.next), mine.into_iter().take(surplus).collect::<Vec<_>>())
            };
            let mut body = body.clone();
            body["id"] = json!(id);
            let lives = ask("POST", list, &format!("{list}/{id}"), Some(&body.to_string()), Said::There)
                && surplus.iter().all(|path| ask("DELETE", path, path, None, Said::Gone));
            if !lives {
                return;
            }
        }
    }
}

/// Notes what is told until the service is gone.
fn listen(mut socket: Socket, book: &Mutex<Book>) {
    while let Ok(Message::Text(text)) = socket.message() {
        let event: Value = serde_json::from_str(&text).unwrap();
        let Some(id) = event["id"].as_str() else { continue };
        book.lock().unwrap().events.push((id.to_owned(), Instant::now()));
    }
}

/// All of a list, page after page.
fn all(service: &Service, path: &str, list: &str) -> Vec<Value> {
    let (mut found, mut page) = (vec![], path.to_owned());
    loop {
        let answer = service.get(&page);
        assert_eq!(answer.status, 200, "{answer:?}");
        let answer = answer.json();
        found.extend(answer[list].as_array().unwrap().iter().cloned());
        match answer["next"].as_str() {
            Some(next) => page = format!("{path}&cursor={next}"),
            None => return found,
        }
    }
}

/// What must be there is, and what must not is not; what was open is settled now.
fn check(service: &Service, book: &mut Book) {
    for (path, said) in &mut book.things {
        let (list, id) = path.rsplit_once('/').unwrap();
        let there = match list {
            "/v1/cameras" => service.get(path).status == 200,
            _ => service.get(list).json()["lines"].as_array().unwrap().iter().any(|line| line["id"] == id),
        };
        match *said {
            Said::There => assert!(there, "{path} is lost"),
            Said::Gone => assert!(!there, "{path} is back"),
            Said::Nothing => *said = if there { Said::There } else { Said::Gone },
        }
    }
    book.things.retain(|_, said| *said == Said::There);
}

fn start(state: &Path, film: &Path) -> Service {
    let camera = format!("demo={}", film.display());
    Service::start(state, &["--camera", &camera, "--loop", "--detector-size", "320x256"])
}

/// 3 times; `GAKP_CRASHES=20` for more.
#[test]
fn kill_9_under_load_loses_nothing_that_was_acknowledged() {
    let Some(film) = film() else { return };
    let runs = std::env::var("GAKP_CRASHES").map_or(3, |runs| runs.parse().expect("a number"));
    let state = tempfile::tempdir().unwrap();
    let (mut book, mut epochs, mut tracks) = (Book::default(), vec![], BTreeSet::new());
    let (mut changes, mut told) = (0, 0);
    for run in 0..runs {
        let mut service = start(state.path(), &film);
        check(&service, &mut book);
        if run == 0 {
            let floor = json!({"id": "floor", "points": [[0, 0], [1, 0], [1, 1], [0, 1]]});
            assert_eq!(service.post("/v1/cameras/demo/zones", &floor).status, 201);
        }
        let epoch = service.camera("demo")["epoch"].as_u64().unwrap();
        assert!(epochs.iter().all(|earlier| *earlier < epoch), "{epoch} after {epochs:?}");
        epochs.push(epoch);
        service.wait_for_frames("demo", 5);

        let lives = Duration::from_secs_f64(1.0 + 3.0 * fastrand::f64());
        let (shared, events) = (Mutex::new(std::mem::take(&mut book)), service.socket("/v1/events/live"));
        let died = thread::scope(|scope| {
            let pid = service.process.id();
            let (service, shared) = (&service, &shared);
            scope.spawn(move || change(service, shared));
            scope.spawn(move || listen(events, shared));
            thread::sleep(lives);
            let kill = format!("kill -KILL {pid}");
            assert!(std::process::Command::new("sh").args(["-c", &kill]).status().unwrap().success());
            Instant::now()
        });
        service.process.wait();
        book = shared.into_inner().unwrap();
        (changes, told) = (book.next, told + book.events.len());

        let service = start(state.path(), &film);
        let kept = all(&service, "/v1/history/events?camera=demo&limit=500", "events");
        let kept: BTreeSet<&str> = kept.iter().map(|event| event["id"].as_str().unwrap()).collect();
        for (id, when) in book.events.drain(..) {
            assert!(kept.contains(id.as_str()) || when + LATE > died, "{id} is lost");
        }
        for track in all(&service, "/v1/history/tracks?camera=demo&limit=500", "tracks") {
            tracks.insert((track["epoch"].as_u64().unwrap(), track["id"].as_u64().unwrap()));
        }
        epochs.push(service.camera("demo")["epoch"].as_u64().unwrap());
        service.stop();
    }
    let service = start(state.path(), &film);
    check(&service, &mut book);
    let log = service.stop();
    assert!(!log.contains("panicked"), "{log}");
    eprintln!("{runs} crashes, {changes} changes, {told} events told, {} tracks kept", tracks.len());
    assert!(changes > runs && told > 0 && !tracks.is_empty(), "the test was too gentle");
}
