//! `gakp eval`, `gakp simulate` and `gakp split` as a user runs them.
#![cfg(feature = "cli")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/mot/classes")
}

fn eval(gt: &Path, results: &Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gakp"));
    command.arg("eval").arg("--gt").arg(gt).arg("--results").arg(results).args(more).output().unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// A copy of the fixtures that a test may break: (folder, truth, results).
fn copy() -> (tempfile::TempDir, PathBuf, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let (gt, results) = (folder.path().join("gt"), folder.path().join("results"));
    std::fs::create_dir_all(&results).unwrap();
    for name in ["SEQ-01", "SEQ-02"] {
        std::fs::create_dir_all(gt.join(name).join("gt")).unwrap();
        for file in ["gt/gt.txt", "seqinfo.ini"] {
            std::fs::copy(fixtures().join("gt").join(name).join(file), gt.join(name).join(file)).unwrap();
        }
        let file = format!("{name}.txt");
        std::fs::copy(fixtures().join("results").join(&file), results.join(&file)).unwrap();
    }
    (folder, gt, results)
}

#[test]
fn json_holds_what_trackeval_says() {
    let output = eval(&fixtures().join("gt"), &fixtures().join("results"), &["--json"]);
    let report: Value = serde_json::from_str(&stdout(&output)).unwrap();
    let expected = std::fs::read_to_string(fixtures().join("expected.json")).unwrap();
    let expected: Value = serde_json::from_str(&expected).unwrap();
    let compare = |ours: &Value, theirs: &Value| {
        let (ours, theirs) = (ours.as_object().unwrap(), theirs.as_object().unwrap());
        assert!(ours.keys().eq(theirs.keys()), "{ours:?} {theirs:?}");
        for (key, expected) in theirs {
            match (ours[key].as_f64(), expected.as_f64()) {
                (Some(a), Some(b)) => assert!((a - b).abs() < 0.5e-4, "{key} is {a}, expected {b}"),
                _ => assert_eq!(&ours[key], expected),
            }
        }
    };
    compare(&report["combined"], &expected["combined"]);
    let (ours, theirs) = (report["sequences"].as_array().unwrap(), expected["sequences"].as_array().unwrap());
    assert_eq!(ours.len(), theirs.len());
    ours.iter().zip(theirs).for_each(|(a, b)| compare(a, b));
}

#[test]
fn table_has_a_line_a_sequence_and_all_of_them() {
    let (_folder, gt, results) = copy();
    let table = stdout(&eval(&gt, &results, &[]));
    let names: Vec<&str> = table.lines().skip(1).filter_map(|line| line.split_whitespace().next()).collect();
    assert_eq!(names, ["SEQ-01", "SEQ-02", "COMBINED"]);
    let titles: Vec<&str> = table.lines().next().unwrap().split_whitespace().collect();
    assert_eq!(titles, ["HOTA", "DetA", "AssA", "MOTA", "IDF1", "MT", "ML", "FP", "FN", "IDs", "Frag"]);
    assert_eq!(stdout(&eval(&gt, &results, &["--det", "02"])).lines().count(), 3);
    // Results in a folder `data` are found as well.
    std::fs::create_dir(results.join("data")).unwrap();
    std::fs::rename(results.join("SEQ-01.txt"), results.join("data/SEQ-01.txt")).unwrap();
    assert_eq!(stdout(&eval(&gt, &results, &[])), table);
}

#[test]
fn second_half_is_the_frames_after_the_middle() {
    let (_folder, gt, results) = copy();
    // 30 frames: 17 to 30 are scored, and numbered 1 to 14 in the results.
    for name in ["SEQ-01", "SEQ-02"] {
        let truth = std::fs::read_to_string(gt.join(name).join("gt/gt.txt")).unwrap();
        let rows = gakp::mot::second_half(&gakp::mot::parse_truth(&truth, None).unwrap(), 30);
        let pedestrians: Vec<_> =
            rows.into_iter().filter(|row| row.class == Some(1) && row.conf == 1.0).collect();
        assert!(pedestrians.iter().all(|row| (1..=14).contains(&row.frame)));
        std::fs::write(results.join(format!("{name}.txt")), gakp::mot::write_results(&pedestrians)).unwrap();
    }
    let report: Value =
        serde_json::from_str(&stdout(&eval(&gt, &results, &["--second-half", "--json"]))).unwrap();
    assert_eq!(report["sequences"][0]["frames"], 14);
    assert_eq!((&report["combined"]["FN"], &report["combined"]["FP"]), (&0.into(), &0.into()));
}

#[test]
fn mistakes_end_with_one_message_and_code_2() {
    type Break = fn(&Path, &Path);
    let cases: [(Break, &str); 7] = [
        (
            |_, results| std::fs::remove_file(results.join("SEQ-02.txt")).unwrap(),
            "no results for sequence SEQ-02",
        ),
        (
            |_, results| {
                std::fs::write(results.join("SEQ-02.txt"), "1,1,1,1,1,1,1\n1,1,1,1,nan,1,1\n").unwrap()
            },
            "SEQ-02.txt: line 2: column 5 (w) is \"nan\", expected",
        ),
        (
            |_, results| std::fs::write(results.join("SEQ-01.txt"), "31,1,1,1,1,1,1\n").unwrap(),
            "SEQ-01.txt: line 1: frame 31 is past the end of the sequence, which has 30 frames",
        ),
        (
            |gt, _| std::fs::write(gt.join("SEQ-01/gt/gt.txt"), "1,1,1,1,1,1\n").unwrap(),
            "gt.txt: line 1: 6 columns",
        ),
        (|gt, _| std::fs::remove_file(gt.join("SEQ-01/seqinfo.ini")).unwrap(), "cannot read"),
        (
            |gt, _| std::fs::write(gt.join("SEQ-01/seqinfo.ini"), "[Sequence]\nframeRate=3\n").unwrap(),
            "seqinfo.ini: name is missing from section [Sequence]",
        ),
        (|gt, _| std::fs::remove_dir_all(gt).unwrap(), "cannot read folder"),
    ];
    for (broken, expected) in cases {
        let (_folder, gt, results) = copy();
        broken(&gt, &results);
        let output = eval(&gt, &results, &[]);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        assert_eq!(message.trim_end().lines().count(), 1, "{message}");
        assert!(output.stdout.is_empty(), "nothing is printed before all is scored");
    }
    let (_folder, gt, results) = copy();
    let output = eval(&gt, &results, &["--det", "SDP"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("expected folders SEQ-SDP/ with gt/gt.txt"));
}

#[test]
fn a_simulated_world_is_written_as_sequences_and_is_the_same_again() {
    let folder = tempfile::tempdir().unwrap();
    let simulate = |out: &Path, more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_gakp")).arg("simulate").arg(out).args(more).output().unwrap()
    };
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    let small = ["--sequences", "2", "--seconds", "4", "--seed", "7"];
    assert!(stdout(&simulate(&a, &small)).starts_with("wrote 2 sequences of 4 s"));
    stdout(&simulate(&b, &small));
    let read = |root: &Path, file: &str| std::fs::read_to_string(root.join("SIM-7-02").join(file)).unwrap();
    for file in ["seqinfo.ini", "gt/gt.txt", "det/det.txt"] {
        assert_eq!(read(&a, file), read(&b, file), "{file}");
    }
    // The truth scores itself without a mistake.
    let results = folder.path().join("results");
    std::fs::create_dir_all(&results).unwrap();
    for name in ["SIM-7-01", "SIM-7-02"] {
        std::fs::copy(a.join(name).join("gt/gt.txt"), results.join(format!("{name}.txt"))).unwrap();
    }
    let report: Value = serde_json::from_str(&stdout(&eval(&a, &results, &["--json"]))).unwrap();
    let text = report.to_string();
    assert!(text.contains("\"IDF1\":1.0") || text.contains("\"IDF1\":100.0"), "{text}");

    let other = simulate(&a, &["--sequences", "1", "--seconds", "4", "--seed", "7"]);
    assert!(String::from_utf8_lossy(&other.stderr).contains("already holds SIM-7-02 of another world"));
    std::fs::write(folder.path().join("file"), "").unwrap();
    let refused = simulate(&folder.path().join("file"), &small);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("cannot create"));
}

fn split(args: &[&Path]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gakp")).arg("split").args(args).output().unwrap()
}

#[test]
fn halves_are_the_sequence() {
    let folder = tempfile::tempdir().unwrap();
    let (sequence, out) = (folder.path().join("MOT17-77-X"), folder.path().join("halves"));
    for within in ["gt", "det"] {
        std::fs::create_dir_all(sequence.join(within)).unwrap();
    }
    let write = |file: &str, bytes: &[u8]| std::fs::write(sequence.join(file), bytes).unwrap();
    let ini = "[Sequence]\nname=X\nframeRate=12.5\nseqLength=7\nimWidth=64\nimHeight=48\n";
    write("seqinfo.ini", ini.as_bytes());
    // Frames out of order and a blank line: what follows the frame stays as it is, to the letter.
    write(
        "gt/gt.txt",
        b"7,3,1,2,3,4,1,1,0.125\n\n1,3,1.50,2,3,4,1,1,1\n4,3,1,2,3,4,0,7,1\n5,3,1,2,3,4,1,1,1\n",
    );
    write("det/det.txt", b"1,-1,5,6,7,8,0.9\n4,-1,5,6,7,8,0.8\n5,-1,5,6,7,8,0.7\n7,-1,5,6,7,8,1e-1\n");
    let values: Vec<u8> = [1.0f64, 4.0, 5.0, 7.0]
        .iter()
        .flat_map(|frame| [*frame, -1.0, 5.0, 6.0, 7.0, 8.0, 0.9, frame * 0.1, 0.5])
        .flat_map(f64::to_le_bytes)
        .collect();
    let header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (4, 9), }";
    let npy = [&b"\x93NUMPY\x01\x00"[..], &(header.len() as u16).to_le_bytes(), header, &values].concat();
    write("det/det_features.npy", &npy);

    stdout(&split(&[&sequence, Path::new("--out"), &out]));
    let read = |half: &str, file: &str| {
        std::fs::read_to_string(out.join(format!("MOT17-77{half}-X")).join(file)).unwrap()
    };
    assert_eq!(read("a", "gt/gt.txt"), "1,3,1.50,2,3,4,1,1,1\n4,3,1,2,3,4,0,7,1\n");
    assert_eq!(read("b", "gt/gt.txt"), "3,3,1,2,3,4,1,1,0.125\n1,3,1,2,3,4,1,1,1\n");
    assert_eq!(read("b", "det/det.txt"), "1,-1,5,6,7,8,0.7\n3,-1,5,6,7,8,1e-1\n");
    for (half, frames) in [("a", 4), ("b", 3)] {
        let ini = read(half, "seqinfo.ini");
        for line in [format!("seqLength={frames}"), "frameRate=12.5".into(), format!("name=MOT17-77{half}-X")]
        {
            assert!(ini.lines().any(|l| l == line), "{line:?} is not in {ini:?}");
        }
    }
    let features = |half: &str| {
        let file = out.join(format!("MOT17-77{half}-X/det/det_features.npy"));
        gakp::mot::parse_npy(&std::fs::read(file).unwrap()).unwrap()
    };
    assert_eq!((features("a").rows, features("b").rows), (2, 2));
    assert_eq!(features("a").row(1), [4.0, -1.0, 5.0, 6.0, 7.0, 8.0, 0.9, 0.4, 0.5]);
    assert_eq!(features("b").row(1)[..2], [3.0, -1.0], "the frame of the half");

    let refused = |out: &Path| {
        let output = split(&[&sequence, Path::new("--out"), out]);
        assert_eq!(output.status.code(), Some(2));
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(refused(&out).contains("MOT17-77a-X is there already"), "nothing is overwritten");
    write("det/det_features.npy", b"x");
    let message = refused(&folder.path().join("more"));
    assert!(message.contains("MOT17-77-X: det/det_features.npy: not a NumPy array file"), "{message}");
}
