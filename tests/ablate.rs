//! `gakp ablate` and `gakp track` with each association, as a user runs them.
#![cfg(feature = "service")]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

mod infer_support;

const ROWS: [&str; 15] = [
    "IOU",
    "IOU + motion (IoU cost)",
    "IOU + motion + deep",
    "explicit",
    "implicit",
    "Huang",
    "explicit + deep",
    "implicit + deep",
    "explicit, looks learned",
    "implicit, looks learned",
    "implicit, literal, boxes alone",
    "implicit, literal",
    "explicit, fixed weights",
    "implicit, -ln P",
    "Mahalanobis cost",
];

fn gakp(args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gakp"));
    // What needs no link network must not look for one.
    command.args(args).env("GAKP_MODELS", "nowhere").env("GAKP_LOG", "error").output().expect("run")
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout.clone()).expect("text")
}

fn refused(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(2));
    assert!(output.stdout.is_empty());
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Six people who walk to and fro at the edge of each other; some are missed, some boxes are wrong.
fn write_sequence(root: &Path, name: &str, features: bool) {
    let folder = root.join(name);
    let (mut truth, mut detections) = (String::new(), String::new());
    let (mut rows, mut values) = (0, Vec::new());
    for frame in 1..=80u32 {
        for person in 0..6u32 {
            let phase = f64::from(frame) * 0.02 + f64::from(person) * 1.7;
            let (x, y) = (300.0 + 250.0 * phase.sin(), 100.0 + 30.0 * f64::from(person));
            writeln!(truth, "{frame},{person},{x:.2},{y:.2},40,100,1,1,1").expect("written");
            if (frame + 4 * person) % 9 != 0 {
                let x = x + f64::from((frame * 7 + person * 3) % 5) - 2.0;
                writeln!(detections, "{frame},-1,{x:.2},{y:.2},40,100,0.9").expect("written");
                let mut look = [0.1f32; 6];
                look[person as usize] = 1.0;
                values.extend(look.iter().flat_map(|v| v.to_le_bytes()));
                rows += 1;
            }
        }
    }
    std::fs::create_dir_all(folder.join("gt")).expect("created");
    std::fs::create_dir_all(folder.join("det")).expect("created");
    std::fs::write(folder.join("gt/gt.txt"), truth).expect("written");
    std::fs::write(folder.join("det/det.txt"), detections).expect("written");
    let ini = format!("[Sequence]\nname={name}\nframeRate=25\nseqLength=80\nimWidth=640\nimHeight=480\n");
    std::fs::write(folder.join("seqinfo.ini"), ini).expect("written");
    if features {
        let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, 6), }}");
        let mut bytes = [b"\x93NUMPY\x01\x00".as_slice(), &(header.len() as u16).to_le_bytes()].concat();
        bytes.extend(header.as_bytes());
        bytes.extend(values);
        std::fs::write(folder.join("det/det_features.npy"), bytes).expect("written");
    }
}

/// Two footages by detector A, one of them by detector B too, with appearance.
fn world() -> (tempfile::TempDir, String) {
    let root = tempfile::tempdir().expect("a folder");
    write_sequence(root.path(), "MOT17-91-A", false);
    write_sequence(root.path(), "MOT17-92-A", false);
    write_sequence(root.path(), "MOT17-92-B", true);
    let path = root.path().display().to_string();
    (root, path)
}

fn row<'a>(report: &'a Value, block: &str, name: &str) -> &'a Value {
    let named = |list: &'a Value, name: &str| -> &'a Value {
        list.as_array().expect("a list").iter().find(|v| v["name"] == name).expect("listed")
    };
    named(&named(&report["blocks"], block)["rows"], name)
}

#[test]
fn every_association_has_a_row_in_every_set() {
    let (_folder, root) = world();
    let report: Value = serde_json::from_str(&stdout(&gakp(&["ablate", &root, "--json"]))).expect("JSON");
    let blocks: Vec<&Value> = report["blocks"].as_array().expect("a list").iter().collect();
    let names: Vec<&str> = blocks.iter().filter_map(|b| b["name"].as_str()).collect();
    assert_eq!(names, ["A", "B", "all sets", "with appearance vectors"]);
    for block in blocks {
        let rows = block["rows"].as_array().expect("rows");
        let names: Vec<&str> = rows.iter().filter_map(|r| r["name"].as_str()).collect();
        assert_eq!(names, ROWS);
        for row in rows {
            // Figures or the reason why there are none, never both.
            assert_ne!(row["figures"].is_null(), row["missing"].is_null(), "{row}");
            assert_eq!(row["figures"].is_null(), row["Hz"].is_null(), "{row}");
        }
    }
    let missing = |block, name| row(&report, block, name)["missing"].as_str().expect("missing").to_string();
    assert_eq!(missing("A", "Huang"), "no appearance vectors in 2 of 2 sequences");
    assert_eq!(missing("all sets", "IOU + motion + deep"), "no appearance vectors in 2 of 3 sequences");
    assert_eq!(missing("B", "implicit"), "no network for this footage in 1 of 1 sequences");
    for (block, name) in [
        ("A", "IOU + motion (IoU cost)"),
        ("B", "IOU + motion + deep"),
        ("B", "Huang"),
        ("all sets", "explicit, fixed weights"),
    ] {
        let found = row(&report, block, name);
        let hota = found["figures"]["HOTA"].as_f64().expect("a figure");
        assert!(hota > 30.0 && found["Hz"].as_f64().expect("a rate") > 0.0, "{block}, {name}: {found}");
    }
    // Appearance of its own for each person: nobody is confused.
    assert_eq!(row(&report, "B", "IOU + motion + deep")["figures"]["IDs"], 0);
}

#[test]
fn the_table_is_the_papers() {
    let (_folder, root) = world();
    let table = stdout(&gakp(&["ablate", &root, "--det", "B", "--second-half", "B"]));
    let mut lines = table.lines();
    assert_eq!(lines.next(), Some("B: MOT17-92-B (second half)"));
    let titles: Vec<&str> = lines.next().expect("a line").split_whitespace().collect();
    assert_eq!(titles, ["HOTA", "MOTA", "IDF1", "MT", "ML", "FP", "FN", "IDs", "Frag", "Hz"]);
    let rows: Vec<&str> = lines.collect();
    assert_eq!(rows.len(), ROWS.len(), "one set is one block:\n{table}");
    for (row, name) in rows.iter().zip(ROWS) {
        assert!(row.starts_with(name), "{row:?} is not {name:?}");
    }
    assert!(rows[4].contains("no network for this footage"), "{table}");
}

/// The same figures by another way: `gakp track` with the setting, then `gakp eval`.
#[test]
fn a_row_is_what_track_and_eval_give() {
    let (folder, root) = world();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let report: Value = serde_json::from_str(&stdout(&gakp(&["ablate", &root, "--json"]))).expect("JSON");
    for (setting, name, features) in [
        ("iou", "IOU", false),
        ("iou-motion", "IOU + motion (IoU cost)", false),
        ("deep", "IOU + motion + deep", true),
        ("huang", "Huang", true),
        ("explicit-fixed", "explicit, fixed weights", false),
        ("mahalanobis", "Mahalanobis cost", false),
    ] {
        std::fs::write(at("a.toml"), format!("[tracker]\nassociation = \"{setting}\"\n")).expect("written");
        let (input, out) = (at("MOT17-92-B"), at("out/MOT17-92-B.txt"));
        std::fs::create_dir_all(at("out")).expect("created");
        let (settings, results) = (at("a.toml"), at("out"));
        let mut args = vec!["track", &input, "--out", &out, "--config", &settings];
        if features {
            args.push("--features");
        }
        stdout(&gakp(&args));
        let eval = stdout(&gakp(&["eval", "--gt", &root, "--results", &results, "--det", "B", "--json"]));
        let expected: Value = serde_json::from_str(&eval).expect("JSON");
        let (found, expected) = (&row(&report, "B", name)["figures"], &expected["combined"]);
        for (key, value) in expected.as_object().expect("figures") {
            // A file of results has boxes of two decimals: scores feel it in the second, counts do not.
            let bound = if value.is_u64() { 0.0 } else { 0.05 };
            let (ours, theirs) = (found[key].as_f64().expect("a figure"), value.as_f64().expect("a figure"));
            assert!((ours - theirs).abs() <= bound, "{setting}: {key} is {ours}, expected {theirs}");
        }
    }
}

#[test]
fn mistakes_are_named() {
    let (folder, root) = world();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let no_such = at("no");
    for (args, expected) in [
        (vec!["ablate", &no_such], "cannot read folder"),
        (vec!["ablate", &root, "--det", "A,SDP"], "ends in -SDP"),
        (vec!["ablate", &root, "--links", &no_such], "there is no folder"),
    ] {
        let message = refused(&gakp(&args));
        assert!(message.contains(expected), "{message:?} lacks {expected:?}");
    }
    let (input, out) = (at("MOT17-91-A"), at("x.txt"));
    let message = refused(&gakp(&["track", &input, "--out", &out, "--features"]));
    assert!(message.contains("det_features.npy (leave --features out without it)"), "{message}");
    std::fs::write(at("MOT17-92-B/det/det_features.npy"), "x").expect("written");
    let message = refused(&gakp(&["ablate", &root]));
    assert!(message.contains("det_features.npy: not a NumPy array file"), "{message}");
    assert!(!Path::new(&out).exists());
}

#[test]
fn networks_are_those_of_the_footage() {
    let Some(models) = infer_support::models() else { return };
    let (folder, root) = world();
    let links = folder.path().join("links");
    std::fs::create_dir_all(&links).expect("created");
    let put = |name: &str, family: &str| {
        let file: PathBuf = links.join(format!("{name}.onnx"));
        let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/gakp-gru.onnx");
        std::fs::copy(fixture, &file).expect("copied");
        let entry = format!(
            "[[model]]\nname = \"x\"\ntask = \"link\"\nfamily = \"{family}\"\nfile = \"{name}.onnx\"\n\
             sha256 = \"{}\"\nlicense = \"none\"\n",
            infer_support::sha256(&file)
        );
        std::fs::write(file.with_extension("toml"), entry).expect("written");
    };
    let run = || {
        let output = Command::new(env!("CARGO_BIN_EXE_gakp"))
            .args(["ablate", &root, "--json", "--links"])
            .arg(&links)
            .env("GAKP_MODELS", &models)
            .output();
        output.expect("run")
    };
    put("MOT17-92", "gru");
    let report: Value = serde_json::from_str(&stdout(&run())).expect("JSON");
    let implicit = |block| row(&report, block, "implicit").clone();
    assert!(implicit("B")["figures"]["HOTA"].as_f64().expect("a figure") > 50.0);
    assert_eq!(implicit("A")["missing"], "no network for this footage in 1 of 2 sequences");
    assert_eq!(row(&report, "B", "implicit + deep")["figures"]["IDs"], 0);
    put("MOT17-91", "explicit");
    // The first network of a folder says what all of them are.
    let message = refused(&run());
    assert!(message.contains("MOT17-92.onnx is of another kind (Implicit)"), "{message}");
    std::fs::remove_dir_all(&links).expect("removed");
    std::fs::create_dir_all(&links).expect("created");
    assert!(refused(&run()).contains("no network in"));
}

#[test]
fn the_core_is_timed_beside_peers() {
    let Some(models) = infer_support::models() else { return };
    let (folder, root) = world();
    let bench = |peer: &str, more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_gakp"))
            .args(["bench", "core", &root, "--det", "A", "--rounds", "2", "--peer", peer])
            .args(more)
            .env("GAKP_MODELS", &models)
            .output()
            .expect("run")
    };
    let svg = folder.path().join("core.svg").display().to_string();
    // The shell's comment swallows the root and the set that the command is given.
    let output = bench("echo 'slow one 1000000 us/frame' #", &["--json", "--plot", &svg]);
    let report: Value = serde_json::from_str(&stdout(&output)).expect("JSON");
    let set = &report["sets"][0];
    assert_eq!((&set["frames"], &set["densest"]["sequence"]), (&160.into(), &"MOT17-92-A".into()), "{set}");
    let us = |row: &Value| row["us"][0].as_f64().expect("a time");
    let ways: Vec<f64> = set["ways"].as_array().expect("ways").iter().map(us).collect();
    assert!(ways.iter().all(|us| (0.01..1e6).contains(us)), "{ways:?}");
    assert_eq!(set["peers"][0][0], "slow one");
    let ratio = set["fastest_peer_ratio"][1].as_f64().expect("the least ratio");
    let most = set["ways"][1]["us"][2].as_f64().expect("the slowest round");
    assert!((ratio * most / 1e6 - 1.0).abs() < 1e-9, "the peer over IOU + motion: {set}");
    let typo = refused(&bench("true #", &["--second-half", "B"]));
    assert!(typo.contains("--second-half B: it is not among the sets of --det"), "{typo}");
    assert_eq!(report["crowd"][7]["people"], 500);
    assert!(std::fs::read_to_string(svg).expect("a picture").contains("tracks, and detections a frame"));

    let silent = refused(&bench("true #", &[]));
    assert!(silent.contains("the peer printed no `NAME X us/frame`"), "{silent}");
    let failing = refused(&bench("echo broken >&2; exit 3 #", &[]));
    assert!(failing.contains("the peer failed") && failing.contains("broken"), "{failing}");
}
