//! What `deploy/` ships for monitoring and for deployment: Prometheus's rules with Prometheus's own
//! tools, every query of every dashboard against a real Prometheus that scrapes a real service with
//! real cameras, and what Debian's tools say of the rest.
#![cfg(all(feature = "cli", feature = "service", feature = "testcam"))]

#[path = "service/support.rs"]
mod service;
#[path = "deploy/support.rs"]
mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use service::{CameraProcess, Refusing, Service, clip, film, run_to_end};
use support::{Dashboard, Prometheus, Query, exporter, files, post, read, root, tool, uncommented};

/// Dashboards whose queries find data only where a camera has a line and a zone, by these metrics.
const NEED_LINES_AND_ZONES: &[&str] = &["deploy/grafana/dashboards/gakp-retail.json"];

const OF_LINES_AND_ZONES: &[&str] = &["gakp_line_", "gakp_zone_", "gakp_events_"];

/// Until every query must have found data. A crossing, an entry and an exit must happen meanwhile.
const PATIENCE: Duration = Duration::from_secs(50);

const RULES: &str = "deploy/prometheus/gakp.rules.yml";
const RULE_TESTS: &str = "deploy/prometheus/gakp.rules.test.yml";
const MANUAL: &str = "docs/deploying.md";

/// A folder with what Prometheus is configured by, prepared by `prepare`, and with the secrets it names.
fn configuration(prepare: impl Fn(&str) -> String) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    for name in ["prometheus.yml", "targets.yml"] {
        write(name, &prepare(&read(&format!("deploy/prometheus/{name}"))));
    }
    write("gakp.rules.yml", &read(RULES));
    write("gakp.rules.test.yml", &read(RULE_TESTS));
    std::fs::create_dir(folder.path().join("secrets")).unwrap();
    write("secrets/gakp.token", "secret\n");
    write("secrets/gakp.pem", "");
    folder
}

#[test]
fn prometheus_accepts_the_configuration_and_the_rules() {
    let folder = configuration(str::to_owned);
    tool("promtool", &["check", "config", "--lint-fatal", "prometheus.yml"], folder.path());
    tool("promtool", &["test", "rules", "gakp.rules.test.yml"], folder.path());
}

/// What is commented out is an offer: it must hold as well.
#[test]
fn prometheus_accepts_what_is_commented_out() {
    let folder = configuration(|text| uncommented(text, ""));
    let config = std::fs::read_to_string(folder.path().join("prometheus.yml")).unwrap();
    for offer in ["\nalerting:", "\n    scheme: https", "\n    tls_config:", "\n  - job_name: dcgm"] {
        assert!(config.contains(offer), "{offer:?} is not in force:\n{config}");
    }
    tool("promtool", &["check", "config", "--lint-fatal", "prometheus.yml"], folder.path());
}

/// Names after `key` in a YAML text, such as those of alerts.
fn named<'a>(text: &'a str, key: &str) -> Vec<&'a str> {
    text.lines().filter_map(|line| line.trim_start().strip_prefix(key)).map(str::trim).collect()
}

#[test]
fn every_alert_is_tested_both_ways_and_explained() {
    let (rules, tests, manual) = (read(RULES), read(RULE_TESTS), read(MANUAL));
    let alerts = named(&rules, "- alert: ");
    assert!(alerts.len() > 15, "{alerts:?}");
    // Of each test: whether alerts were expected, by the text up to the next one.
    let mut tested: BTreeMap<&str, (bool, bool)> = BTreeMap::new();
    for case in tests.split("- alertname: ").skip(1) {
        let (name, rest) = case.split_once('\n').unwrap();
        let seen = tested.entry(name.trim()).or_default();
        if rest.contains("exp_alerts: []") { seen.1 = true } else { seen.0 = true }
    }
    for alert in &alerts {
        assert_eq!(
            tested.get(alert),
            Some(&(true, true)),
            "{alert} must fire in one test and not in another"
        );
        assert!(manual.contains(&format!("| `{alert}` |")), "{MANUAL} does not say what to do about {alert}");
    }
    for explained in manual.split("| `Gakp").skip(1) {
        let name = format!("Gakp{}", explained.split('`').next().unwrap());
        assert!(alerts.contains(&name.as_str()), "{MANUAL} explains {name}, which is no alert");
    }
    for key in ["summary: ", "description: ", "runbook: ", "severity: "] {
        assert_eq!(named(&rules, key).len(), alerts.len(), "each alert has one {key}");
    }
    for runbook in named(&rules, "runbook: ") {
        let (file, anchor) = runbook.split_once('#').expect(runbook);
        let anchors: Vec<_> = read(file).lines().filter_map(anchor_of).collect();
        assert!(anchors.iter().any(|a| a == anchor), "{runbook}: {file} has {anchors:?}");
    }
}

/// The anchor that a heading has when it is shown.
fn anchor_of(line: &str) -> Option<String> {
    let heading = line.strip_prefix("##")?.trim_start_matches('#').trim();
    let kept = heading.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
    Some(kept.collect::<String>().to_lowercase().replace(' ', "-"))
}

#[test]
fn dashboards_are_whole() {
    let dashboards = Dashboard::all();
    assert_eq!(dashboards.len(), 4);
    let uids: BTreeSet<_> = dashboards.iter().map(|d| d.json["uid"].as_str().unwrap()).collect();
    assert_eq!(uids.len(), dashboards.len(), "{uids:?}");
    for dashboard in &dashboards {
        let file = &dashboard.file;
        let text = dashboard.json.to_string();
        let counts = OF_LINES_AND_ZONES.iter().any(|metric| text.contains(metric));
        assert_eq!(counts, NEED_LINES_AND_ZONES.contains(&file.as_str()), "{file}");
        let mut ids = BTreeSet::new();
        let mut cells = BTreeSet::new();
        for panel in dashboard.panels() {
            let place = format!("{file}: panel {}", panel["title"]);
            assert!(ids.insert(panel["id"].as_u64().unwrap()), "{place}: its id is taken");
            assert!(!panel["title"].as_str().unwrap().is_empty(), "{place}");
            let [x, y, w, h] = ["x", "y", "w", "h"].map(|key| panel["gridPos"][key].as_u64().unwrap());
            assert!(w > 0 && h > 0 && x + w <= 24, "{place}: {}", panel["gridPos"]);
            for cell in (y..y + h).flat_map(|row| (x..x + w).map(move |column| (row, column))) {
                assert!(cells.insert(cell), "{place}: lies on another panel");
            }
            if panel["type"] == "row" {
                continue;
            }
            assert!(
                panel["description"].as_str().is_some_and(|d| d.ends_with('.')),
                "{place}: no description"
            );
            assert!(!panel["targets"].as_array().unwrap().is_empty(), "{place}: no query");
            let unit = &panel["fieldConfig"]["defaults"]["unit"];
            let without = ["table", "state-timeline", "heatmap"].contains(&panel["type"].as_str().unwrap());
            assert!(without || unit.is_string(), "{place}: no unit");
            for target in panel["targets"].as_array().unwrap() {
                assert_eq!(target["datasource"]["uid"], "${datasource}", "{place}");
            }
        }
        for (at, link) in text.match_indices("/d/") {
            let uid = text[at + link.len()..].split(['?', '"']).next().unwrap();
            assert!(uids.contains(uid), "{file}: links to {uid}, which is none of {uids:?}");
        }
    }
}

/// Draws a line down the middle of a camera's picture, and a zone that is all of it but the rim, which
/// people come in and go out by.
fn draw(service: SocketAddr, token: &str, camera: &str) {
    let line = json!({"id": "door", "points": [[0.5, 0], [0.5, 1]]});
    let zone = json!({"id": "floor", "points": [[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]});
    for (what, body) in [("lines", line), ("zones", zone)] {
        assert_eq!(post(service, token, &format!("/v1/cameras/{camera}/{what}"), &body), 201, "{what}");
    }
}

#[test]
fn every_query_finds_data() {
    let (Some(clip), Some(film)) = (clip(), film()) else { return };
    let camera = CameraProcess::start(&clip, &[]);
    let refusing = Refusing::start();
    let state = tempfile::tempdir().unwrap();
    // As in docs/deploying.md: an admin's token by file, a viewer's for Prometheus.
    let admin = "an admin's token of this test, no secret".replace([' ', ','], "-");
    let secret = state.path().join("admin.token");
    std::fs::write(&secret, &admin).unwrap();
    let made =
        run_to_end(&["token", "create", "prometheus", "--state-dir", state.path().to_str().unwrap()], &[]);
    assert!(made.status.success(), "{made:?}");
    // Nobody is there to be told: what is measured of that is there all the same.
    let config = state.path().join("gakp.toml");
    let gone = refusing.address();
    let sinks =
        format!("[[webhook]]\nname = \"gone\"\nurl = \"http://{gone}/\"\n[mqtt]\nurl = \"mqtt://{gone}\"\n");
    std::fs::write(&config, sinks).unwrap();
    let service = Service::start(
        state.path(),
        &[
            "--config",
            config.to_str().unwrap(),
            "--admin-token-file",
            secret.to_str().unwrap(),
            "--loop",
            "--camera",
            &format!("gate={}", camera.url),
            "--camera",
            &format!("hall={}", film.display()),
            "--camera",
            &format!("broken=rtsp://{}/live", refusing.address()),
        ],
    );
    assert_eq!(service.get("/metrics").status, 401, "without a token");
    let viewer = String::from_utf8(made.stdout).unwrap();
    let gpu = exporter(include_str!("deploy/dcgm.txt"));
    let prometheus = Prometheus::start(service.address, &viewer, gpu);
    draw(service.address, &admin, "gate");
    draw(service.address, &admin, "hall");

    let mut missing: Vec<Query> =
        Dashboard::all().iter().flat_map(|dashboard| dashboard.queries(service.address, "gate")).collect();
    // Zero is a number too: somebody must really have been counted.
    for count in ["gakp_line_crossings_total", "gakp_zone_entries_total", "gakp_zone_exits_total"] {
        let expr = format!("sum({count}) > 0");
        missing.push(Query { place: "what is counted".to_owned(), expr, instant: true });
    }
    let (all, since) = (missing.len(), Instant::now());
    assert!(all > 80, "only {all} queries");
    while !missing.is_empty() {
        missing.retain(|query| {
            let found = prometheus.series(&query.expr, query.instant);
            found.unwrap_or_else(|error| panic!("{}: {}: {error}", query.place, query.expr)) == 0
        });
        if since.elapsed() > PATIENCE {
            let places = missing.iter().map(|query| format!("{}: {}\n", query.place, query.expr));
            panic!("of {all} queries these find nothing:\n{}", places.collect::<String>());
        }
        std::thread::sleep(Duration::from_secs(1));
    }
    eprintln!("{all} queries of dashboards found data after {:.0?}", since.elapsed());

    let alerts = rules_work(&prometheus);
    let active = |alert: &str| alerts[alert].clone();
    assert_eq!(active("GakpCameraDown"), BTreeSet::from(["broken".to_owned()]));
    for quiet in ["GakpDown", "GakpAbsent", "GakpNoCameras", "GakpAllCamerasDown", "GakpNotTracking"] {
        assert!(active(quiet).is_empty(), "{quiet}: {:?}", active(quiet));
    }
}

/// Every rule is evaluated without an error, and each recording has data. The alerts that are pending
/// or firing, by the camera that they name or "".
fn rules_work(prometheus: &Prometheus) -> BTreeMap<String, BTreeSet<String>> {
    let answer = prometheus.api("rules", &[]).unwrap();
    let rules: Vec<&Value> =
        answer["groups"].as_array().unwrap().iter().flat_map(|g| g["rules"].as_array().unwrap()).collect();
    let text = read(RULES);
    assert_eq!(rules.len(), named(&text, "- alert: ").len() + named(&text, "- record: ").len());
    let mut active = BTreeMap::new();
    for rule in rules {
        assert_eq!(rule["health"], "ok", "{rule}");
        let name = rule["name"].as_str().unwrap();
        let found = prometheus.series(rule["query"].as_str().unwrap(), true);
        let found = found.unwrap_or_else(|error| panic!("{rule}: {error}"));
        if rule["type"] == "recording" {
            assert!(found > 0, "{rule}: finds nothing");
            assert!(prometheus.series(name, true).unwrap() > 0, "{name} records nothing");
        } else {
            let of = rule["alerts"].as_array().unwrap().iter();
            let cameras = of.map(|a| a["labels"]["camera"].as_str().unwrap_or_default().to_owned());
            active.insert(name.to_owned(), cameras.collect());
        }
    }
    active
}

#[test]
fn yaml_is_clean() {
    let mut all = files("deploy", ".yml");
    all.extend(files("deploy", ".yaml"));
    assert!(all.len() > 5, "{all:?}");
    // Descriptions of alerts are long lines.
    let rules = "{extends: default, rules: {line-length: disable, document-start: disable, \
                 braces: {max-spaces-inside: 1}, comments: {min-spaces-from-content: 1}}}";
    let mut args = vec!["--strict", "-d", rules];
    args.extend(all.iter().map(String::as_str));
    tool("yamllint", &args, root());
}

/// What Compose mounts must be there: Docker would make a folder of what is not.
#[test]
fn compose_mounts_what_there_is() {
    let mut mounts = 0;
    for file in files("deploy/compose", ".yml") {
        let text = read(&file);
        let words = text.split(['"', '\'', ' ', '[', ']', '\n']);
        for path in words.filter(|w| w.starts_with("./") || w.starts_with("../")).filter(|w| w.contains(':'))
        {
            let path = path.split(':').next().unwrap();
            assert!(root().join("deploy/compose").join(path).exists(), "{file}: {path}");
            mounts += 1;
        }
    }
    assert!(mounts >= 10, "{mounts}");
}

/// ONNX Runtime looks up a host of its maker's unless this is set before it is loaded.
#[test]
fn nothing_calls_home() {
    for file in ["Dockerfile", "deploy/systemd/gakp.service"] {
        assert!(read(file).contains("ORT_DISABLE_TELEMETRY=1"), "{file}");
    }
}

#[test]
fn systemd_accepts_the_unit() {
    let folder = tempfile::tempdir().unwrap();
    let unit = read("deploy/systemd/gakp.service");
    // It looks whether the program is there.
    let program = "/usr/local/bin/gakp";
    assert!(unit.contains(&format!("ExecStart={program} ")));
    let path = folder.path().join("gakp.service");
    std::fs::write(&path, unit.replace(program, env!("CARGO_BIN_EXE_gakp"))).unwrap();
    let said = tool("systemd-analyze", &["verify", "--man=no", path.to_str().unwrap()], folder.path());
    let complaints: Vec<_> = said.lines().filter(|line| line.contains("gakp.service")).collect();
    assert!(complaints.is_empty(), "{complaints:?}");
    // 0 is locked in, 10 is free to do anything.
    let args = ["security", "--offline=true", "--threshold=20", path.to_str().unwrap()];
    tool("systemd-analyze", &args, folder.path());
}
