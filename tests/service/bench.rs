//! `gakp bench`: what it prints, of runs too short to say anything about speed.

use serde_json::Value;

use super::support::*;

/// What a benchmark that goes well prints.
fn bench(args: &[&str]) -> Value {
    let output = run_to_end(&[&["bench"], args, &["--provider", "cpu", "--json"]].concat(), &[]);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[track_caller]
fn check_quantiles(quantiles: &Value) {
    let [p50, p95, p99] = [0, 1, 2].map(|at| quantiles[at].as_f64().unwrap());
    assert!(0.0 < p50 && p50 <= p95 && p95 <= p99, "{quantiles}");
}

#[test]
fn each_model_by_itself() {
    if models().is_none() {
        return;
    }
    let sizes = ["--batches", "1,3", "--crops", "5", "--pairs", "7", "--seconds", "0.2"];
    let report = bench(&[&["inference"], &sizes[..]].concat());
    assert_eq!(report["provider"], "cpu");
    let models = report["models"].as_array().unwrap();
    let found = models.iter().map(|model| {
        let batches = model["rates"].as_array().unwrap().iter().map(|rate| rate["batch"].as_u64().unwrap());
        (model["task"].as_str().unwrap(), model["items"].as_str().unwrap(), batches.collect::<Vec<_>>())
    });
    let expected = [("detect", "frames", vec![1, 3]), ("reid", "crops", vec![5]), ("link", "pairs", vec![7])];
    assert_eq!(found.collect::<Vec<_>>(), expected);
    for rate in models.iter().flat_map(|model| model["rates"].as_array().unwrap()) {
        let (rate_is, inside) = (rate["per_second"].as_f64().unwrap(), rate["inside"].as_f64().unwrap());
        assert!(rate_is > 0.0 && (0.0..=1.0).contains(&inside), "{rate}");
        check_quantiles(&rate["call_ms"]);
    }
    // The colour stripes are none of ONNX Runtime's.
    assert_eq!(models[1]["rates"][0]["inside"], 0.0);
}

#[test]
fn the_service_with_cameras_beside_the_models_and_a_peer() {
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let clip = tiny_clip(folder.path());
    // A peer that keeps up with one camera and not with two, and looks at its URL.
    let peer = format!(
        "case $URL in rtsp://*) mkdir {0}/$PPID && echo 5 frames 5.0 frames/s || echo 1.0 frames/s;; esac",
        folder.path().display()
    );
    let args = ["--fps", "5", "--seconds", "2", "--most", "2", "--within", "30000", "--peer", &peer];
    let report = bench(&[&["cameras", clip.to_str().unwrap()], &args[..]].concat());
    let rows = report["rows"].as_array().unwrap();
    assert_eq!(rows.iter().map(|row| row["cameras"].as_u64().unwrap()).collect::<Vec<_>>(), [1, 2]);
    for row in rows {
        check_quantiles(&row["latency_ms"]);
        let works = row["work_ms"].as_array().unwrap();
        assert!(works.iter().any(|work| work[0] == "detector"), "{row}");
        assert!(row["fps"].as_f64().unwrap() > 0.0 && row["resident_mb"].as_f64().unwrap() > 10.0, "{row}");
        let stages = row["stages_ms"].as_array().unwrap();
        check_quantiles(&stages.iter().find(|stage| stage[0] == "detect").unwrap()[1]);
    }
    assert!(report["models_at_pace_cpu_ms"].as_f64().unwrap() > 0.0);
    assert_eq!(report["peer_cameras"], 1);
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    for (args, told) in [
        (&["inference", "--batches", "0"][..], "at least 1"),
        (&["inference", "--seconds", "0"], "--seconds"),
        (&["inference", "--frame", "4x4"], "--frame"),
        (&["cameras", "film.mp4", "--most", "0"], "--most"),
    ] {
        let output = run_to_end(&[&["bench"], args].concat(), &[]);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && errors.contains(told), "{args:?}: {errors}");
    }
}
