//! Lines and zones on a real camera: counted, told, measured, remembered.

use std::collections::BTreeSet;

use serde_json::{Value, json};

use super::support::*;

/// Both counts of a line as `/v1/cameras/demo/counts` has them.
fn crossings(counts: &Value) -> [u64; 2] {
    ["in", "out"].map(|way| counts["lines"]["door"][way].as_u64().unwrap_or_else(|| panic!("{counts}")))
}

#[test]
fn people_of_the_film_are_counted_and_rules_remembered() {
    let state = tempfile::tempdir().unwrap();
    let Some(service) = Service::demo(state.path()) else { return };
    let mut events = service.socket("/v1/events/live?camera=demo");
    let door = json!({"id": "door", "points": [[0.5, 1.0], [0.5, 0.0]]});
    let all = json!([[0, 0], [1, 0], [1, 1], [0, 1]]);
    let floor = json!({"id": "floor", "points": all, "loiter_s": 2.0, "capacity": 1});
    assert_eq!(service.post("/v1/cameras/demo/lines", &door).status, 201);
    assert_eq!(service.post("/v1/cameras/demo/zones", &floor).status, 201);
    let refused = service.post("/v1/cameras/demo/lines", &door);
    assert_eq!(refused.status, 409, "{refused:?}");

    // What is told until each kind was seen.
    let mut told: Vec<Value> = vec![];
    let kinds =
        |told: &[Value]| told.iter().map(|e| e["type"].as_str().unwrap().to_owned()).collect::<BTreeSet<_>>();
    let wanted = ["line.crossed", "zone.entered", "zone.left", "zone.loitering", "zone.crowded"];
    while !wanted.iter().all(|kind| kinds(&told).contains(*kind)) {
        assert!(told.len() < 500, "500 events and only {:?}", kinds(&told));
        told.push(events.json());
    }
    let ids: BTreeSet<&str> = told.iter().map(|e| e["id"].as_str().unwrap()).collect();
    assert_eq!(ids.len(), told.len(), "ids differ");
    for event in &told {
        assert!(event["camera"] == "demo" && event["frame"].is_u64() && event["time"].is_string(), "{event}");
        let place: [f64; 2] = serde_json::from_value(event["place"].clone()).unwrap();
        assert!(place.iter().all(|v| (-0.5..1.5).contains(v)), "{event}");
    }
    let crossed: Vec<&Value> = told.iter().filter(|e| e["type"] == "line.crossed").collect();
    assert!(crossed.iter().all(|e| e["line"] == "door" && e["track"].is_u64() && e["class"] == "person"));

    // Counts, metrics and the events that were told agree; more may happen meanwhile.
    let counts = service.get("/v1/cameras/demo/counts").json();
    let metrics = service.metrics();
    let way = |way: &str| crossed.iter().filter(|e| e["direction"] == way).count() as u64;
    for (index, name) in ["in", "out"].into_iter().enumerate() {
        let series =
            format!("gakp_line_crossings_total{{camera=\"demo\",direction=\"{name}\",line=\"door\"}}");
        let measured = metrics.get(&series) as u64;
        let counted = crossings(&counts)[index];
        assert!(way(name) <= counted && counted <= measured, "{name}: {} {counted} {measured}", way(name));
    }
    let entries = counts["zones"]["floor"]["entries"].as_u64().unwrap();
    assert!(entries >= told.iter().filter(|e| e["type"] == "zone.entered").count() as u64, "{counts}");
    let heat = service.get("/v1/cameras/demo/heatmap").json();
    assert!(heat["seconds"].as_array().unwrap().iter().any(|v| v.as_f64().unwrap() > 0.0));
    let recent = service.get("/v1/events?limit=1000").json();
    let recent: BTreeSet<&str> =
        recent["events"].as_array().unwrap().iter().map(|e| e["id"].as_str().unwrap()).collect();
    assert!(ids.iter().all(|id| recent.contains(id)), "what was told can be asked for");

    // A line that moves counts anew; a zone that goes takes its series with it.
    let moved = json!({"id": "door", "points": [[0.3, 1.0], [0.3, 0.0]]});
    let put = service.request("PUT", "/v1/cameras/demo/lines/door", Some(&moved.to_string()));
    assert_eq!(put.status, 200, "{put:?}");
    assert_eq!(service.delete("/v1/cameras/demo/zones/floor").status, 204);
    assert!(!service.get("/metrics").body.contains("zone=\"floor\""));
    service.stop();

    // The camera is the command line's, its lines are remembered all the same.
    let service = Service::demo(state.path()).unwrap();
    let lines = service.get("/v1/cameras/demo/lines").json();
    let points = json!([[0.3, 1.0], [0.3, 0.0]]);
    assert_eq!(lines, json!({"lines": [{"id": "door", "points": points, "anchor": "foot"}]}));
    assert_eq!(service.get("/v1/cameras/demo/zones").json(), json!({"zones": []}));
    service.wait_for_frames("demo", 5);
    assert_eq!(service.delete("/v1/cameras/demo").status, 204);
    assert!(!service.get("/metrics").body.contains("line=\"door\""));
    service.stop();
}
