//! The history of a running service: what it keeps, what a crash leaves, what a database that stands still costs.

use std::collections::BTreeSet;
use std::time::Duration;

use serde_json::{Value, json};

use super::server::{PASSWORD, Postgres};
use super::support::*;

/// A line and a zone in the demo film that people cross all the time.
fn draw(service: &Service) {
    let door = json!({"id": "door", "points": [[0.5, 1.0], [0.5, 0.0]]});
    let floor = json!({"id": "floor", "points": [[0, 0], [1, 0], [1, 1], [0, 1]]});
    assert_eq!(service.post("/v1/cameras/demo/lines", &door).status, 201);
    assert_eq!(service.post("/v1/cameras/demo/zones", &floor).status, 201);
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

fn names(tracks: &[Value]) -> BTreeSet<(u64, u64)> {
    tracks.iter().map(|t| (t["epoch"].as_u64().unwrap(), t["id"].as_u64().unwrap())).collect()
}

#[test]
fn a_crash_loses_at_most_the_last_second() {
    let state = tempfile::tempdir().unwrap();
    let Some(mut service) = Service::demo(state.path()) else { return };
    draw(&service);
    let mut events = service.socket("/v1/events/live");
    // Until somebody has left the picture, so that there are finished tracks.
    let mut told = vec![];
    while told.iter().filter(|e: &&Value| e["type"] == "zone.left").count() < 3 {
        told.push(events.json());
    }
    // What was seen a second ago is kept; what is told now may be lost.
    let counts = service.get("/v1/cameras/demo/counts").json();
    std::thread::sleep(Duration::from_millis(1500));
    service.process.signal("KILL");
    service.process.wait();

    let service = Service::demo(state.path()).unwrap();
    let kept: BTreeSet<_> = all(&service, "/v1/history/events?limit=7", "events")
        .iter()
        .map(|event| event["id"].as_str().unwrap().to_owned())
        .collect();
    for event in &told {
        assert!(kept.contains(event["id"].as_str().unwrap()), "{event} is lost");
    }
    // Tracks of the earlier run are over; those that made an event are all there.
    let epoch = told[0]["epoch"].as_u64().unwrap();
    let of_then = format!("camera=demo&epoch={epoch}");
    let tracks = all(&service, &format!("/v1/history/tracks?{of_then}&limit=3"), "tracks");
    assert!(tracks.iter().all(|track| track["ended"] == true), "{tracks:?}");
    let known = names(&tracks);
    for event in told.iter().filter(|event| event["track"].is_u64()) {
        let name = (event["epoch"].as_u64().unwrap(), event["track"].as_u64().unwrap());
        assert!(known.contains(&name), "track {name:?} is lost");
    }

    // Counts over time are the counts of then.
    let path = "/v1/history/counts?camera=demo&line=door&bucket_s=60";
    let buckets = service.get(path).json();
    for way in ["in", "out"] {
        let sum: u64 = buckets["buckets"].as_array().unwrap().iter().map(|b| b[way].as_u64().unwrap()).sum();
        assert!(sum >= counts["lines"]["door"][way].as_u64().unwrap(), "{way}: {buckets}, {counts}");
    }

    // The same as tables.
    let csv = service.get(&format!("/v1/history/tracks.csv?{of_then}"));
    assert!(csv.head.contains("text/csv") && csv.head.contains("attachment"), "{}", csv.head);
    assert_eq!(csv.body.lines().count(), tracks.len() + 1, "{}", csv.body);
    let csv = service.get("/v1/history/events.csv?type=zone.left").body;
    assert!(csv.lines().count() >= 4 && csv.lines().nth(1).unwrap().contains(",floor,"), "{csv}");
    let mot = service.get(&format!("/v1/history/tracks.txt?{of_then}")).body;
    let ids: BTreeSet<u64> =
        mot.lines().map(|line| line.split(',').nth(1).unwrap().parse().unwrap()).collect();
    assert_eq!(ids, known.iter().map(|(_, id)| *id).collect());
    let first = known.first().unwrap();
    for (path, status) in [
        (format!("/v1/history/tracks/demo/{}/{}", first.0, first.1).as_str(), 200),
        ("/v1/history/tracks/demo/1/999999", 404),
        ("/v1/history/tracks/demo/x/1", 404),
        ("/v1/history/tracks/demo/1/1/snapshot.jpg", 404),
        ("/v1/history/tracks.txt", 400),
        ("/v1/history/tracks?from=yesterday", 400),
        ("/v1/history/tracks?from=2026-01-01T00:00:00Z&to=2025-01-01T00:00:00Z", 400),
        ("/v1/history/tracks?cursor=x", 400),
        ("/v1/history/counts?camera=demo", 400),
        ("/v1/history/counts?camera=demo&line=door&from=2020-01-01T00:00:00Z&bucket_s=1", 400),
    ] {
        let answer = service.get(path);
        assert_eq!(answer.status, status, "{path}: {answer:?}");
    }
    service.stop();
}

#[test]
fn a_database_that_stands_still_stops_nothing_and_gets_everything() {
    let (Some(film), Some(server)) = (film(), Postgres::start()) else { return };
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("gakp.toml");
    let text = format!("[history]\ndatabase = \"{}\"\nsnapshots = true\n", server.url());
    std::fs::write(&config, text).unwrap();
    let state = folder.path().join("state");
    let camera = format!("demo={}", film.display());
    let args = ["--config", config.to_str().unwrap(), "--camera", &camera, "--loop"];
    let service = Service::start(&state, &args);
    draw(&service);
    let written = |service: &Service| service.metrics().get("gakp_history_rows_written_total");
    eventually("rows in the database", || (written(&service) > 0.0).then_some(()));

    server.signal("STOP");
    let before = written(&service);
    let mut events = service.socket("/v1/events/live");
    let told: Vec<Value> = (0..5).map(|_| events.json()).collect();
    service.wait_for_frames("demo", 20);
    assert!(written(&service) - before < 1000.0, "a stopped database takes nothing");
    server.signal("CONT");

    eventually("what was told meanwhile", || {
        let kept = service.get("/v1/history/events?limit=1000");
        let told = || told.iter().map(|event| event["id"].as_str().unwrap());
        (kept.status == 200 && told().all(|id| kept.body.contains(id))).then_some(())
    });
    assert_eq!(service.metrics().get("gakp_history_rows_dropped_total"), 0.0);
    assert_eq!(service.metrics().get("gakp_history_reports_missed_total"), 0.0);
    assert_eq!(service.get("/v1/history").json()["backend"], "postgres");

    let picture = eventually("a snapshot", || {
        let tracks = service.get("/v1/history/tracks?limit=1000").json();
        let tracks = tracks["tracks"].as_array().unwrap();
        tracks.iter().find_map(|track| track["snapshot"].as_str().map(str::to_owned))
    });
    let picture = service.get(&picture);
    assert!(picture.head.contains("image/jpeg") && picture.body.contains("JFIF"), "{}", picture.head);
    let metrics = service.get("/metrics").body;
    let log = service.stop();
    assert!(!log.contains(PASSWORD) && !metrics.contains(PASSWORD), "a password in: {log}");
}
