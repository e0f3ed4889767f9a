//! Scores of the fixtures equal TrackEval's, to 4 decimals. `tests/trackeval/fixtures.py` made the
//! fixtures and `tests/trackeval/compare.py --write` the expected values.

use std::path::{Path, PathBuf};

use gakp::mot::{Benchmark, Score, SequenceInfo, evaluate, parse_results, parse_truth};
use serde_json::Value;

fn fixtures(set: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/mot").join(set)
}

fn read(path: PathBuf) -> String {
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn score(set: &str, sequence: &str, benchmark: Benchmark) -> Score {
    let folder = fixtures(set).join("gt").join(sequence);
    let info = SequenceInfo::parse(&read(folder.join("seqinfo.ini"))).unwrap();
    let truth = parse_truth(&read(folder.join("gt/gt.txt")), Some(info.length)).unwrap();
    let results = read(fixtures(set).join("results").join(format!("{sequence}.txt")));
    let results = parse_results(&results, Some(info.length)).unwrap();
    assert_eq!(Benchmark::of(sequence, &truth), benchmark);
    evaluate(&truth, &results, info.length, benchmark).unwrap()
}

/// Compares all figures; counts exactly, percentages to 4 decimals.
fn check(name: &str, score: &Score, expected: &Value) {
    let Score { hota: h, clear: c, identity: i } = score;
    let percentages = [
        ("HOTA", h.hota()),
        ("DetA", h.det_a()),
        ("DetRe", h.det_re()),
        ("DetPr", h.det_pr()),
        ("AssA", h.ass_a()),
        ("AssRe", h.ass_re()),
        ("AssPr", h.ass_pr()),
        ("LocA", h.loc_a()),
        ("MOTA", c.mota()),
        ("MOTP", c.motp()),
        ("IDF1", i.idf1()),
        ("IDP", i.idp()),
        ("IDR", i.idr()),
    ];
    for (key, value) in percentages {
        let expected = expected[key].as_f64().unwrap();
        assert!(
            (100.0 * value - expected).abs() < 0.5e-4,
            "{name}: {key} is {}, expected {expected}",
            100.0 * value
        );
    }
    let counts = [
        ("TP", c.tp),
        ("FP", c.fp),
        ("FN", c.fn_),
        ("IDs", c.idsw),
        ("Frag", c.frag),
        ("MT", c.mt),
        ("PT", c.pt),
        ("ML", c.ml),
        ("IDTP", i.tp),
        ("IDFP", i.fp),
        ("IDFN", i.fn_),
    ];
    for (key, value) in counts {
        assert_eq!(Some(value), expected[key].as_u64(), "{name}: {key}");
    }
}

fn check_set(set: &str, sequences: usize, benchmark: Benchmark) {
    let expected: Value = serde_json::from_str(&read(fixtures(set).join("expected.json"))).unwrap();
    let list = expected["sequences"].as_array().unwrap();
    assert_eq!(list.len(), sequences);
    let mut scores = Vec::new();
    for expected in list {
        let name = expected["name"].as_str().unwrap();
        let score = score(set, name, benchmark);
        check(name, &score, expected);
        scores.push(score);
    }
    check("combined", &Score::combine(&scores.iter().collect::<Vec<_>>()), &expected["combined"]);
}

#[test]
fn equals_trackeval_on_truth_with_classes() {
    check_set("classes", 4, Benchmark::Mot17);
}

#[test]
fn equals_trackeval_on_mot15() {
    check_set("mot15", 3, Benchmark::Mot15);
}

/// The same truth under rules that leave vehicles out as well scores otherwise.
#[test]
fn mot20_leaves_vehicles_out() {
    let row = |id, class: &str| format!("1,{id},{},10,20,40,1,{class},1\n", 100 * id);
    let truth = parse_truth(&(row(1, "1") + &row(2, "6") + &row(3, "8")), None).unwrap();
    let results = parse_results("1,1,100,10,20,40,1\n1,2,200,10,20,40,1\n1,3,300,10,20,40,1", None).unwrap();
    let fp = |benchmark| evaluate(&truth, &results, 1, benchmark).unwrap().clear.fp;
    assert_eq!([Benchmark::Mot15, Benchmark::Mot17, Benchmark::Mot20].map(fp), [0, 1, 0]);
    assert_eq!(Benchmark::of("MOT20-01", &truth), Benchmark::Mot20);
}
