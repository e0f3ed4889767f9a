//! `gakp train` from folders to file, card and report; the shipped network.
#![cfg(all(feature = "learn", feature = "cli"))]

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use clap::Parser;
use gakp::cli::train;
use gakp::learn::onnx;
use gakp::mot::{Matrix, write_npy};
use gakp::track::Features;

#[derive(Parser)]
struct Command {
    #[command(flatten)]
    train: train::Args,
}

fn args(text: &str) -> train::Args {
    Command::try_parse_from(std::iter::once("train").chain(text.split(' '))).expect("arguments").train
}

/// People who walk to and fro past each other; every ninth detection is missing.
fn write_sequence(root: &Path, name: &str, pace: f64) {
    let folder = root.join(name);
    let (mut truth, mut detections) = (String::new(), String::new());
    for frame in 1..=60u32 {
        for person in 0..6u32 {
            let phase = f64::from(frame) * pace + f64::from(person) * 1.7;
            let (x, y) = (300.0 + 250.0 * phase.sin(), 100.0 + 12.0 * f64::from(person));
            writeln!(truth, "{frame},{person},{x:.2},{y:.2},40,100,1,1,1").expect("written");
            if (frame + 4 * person) % 9 != 0 {
                let noise = f64::from((frame * 7 + person * 3) % 5) - 2.0;
                writeln!(detections, "{frame},-1,{:.2},{y:.2},40,100,0.9", x + noise).expect("written");
            }
        }
    }
    for (file, text) in [("gt/gt.txt", &truth), ("det/det.txt", &detections)] {
        let path = folder.join(file);
        fs::create_dir_all(path.parent().expect("a folder")).expect("created");
        fs::write(path, text).expect("written");
    }
    let ini = format!("[Sequence]\nname={name}\nframeRate=25\nseqLength=60\nimWidth=640\nimHeight=480\n");
    fs::write(folder.join("seqinfo.ini"), ini).expect("written");
}

/// Gives a sequence of [`write_sequence`] embeddings, each person one of its own.
fn write_features(folder: &Path, width: usize) {
    let text = fs::read_to_string(folder.join("det/det.txt")).expect("detections");
    let mut values = vec![];
    for line in text.lines() {
        // Whom a row is of stands in its height on the picture.
        let y: f64 = line.split(',').nth(3).and_then(|y| y.parse().ok()).expect("a number");
        let person = ((y - 100.0) / 12.0).round() as usize;
        values.extend((0..width).map(|i| if i == person { 1.0 } else { 0.2 + 0.01 * (y - 100.0) }));
    }
    let matrix = Matrix { rows: values.len() / width, columns: width, values };
    fs::write(folder.join("det/det_features.npy"), write_npy(&matrix)).expect("written");
}

fn world() -> tempfile::TempDir {
    let root = tempfile::tempdir().expect("a folder");
    for (name, pace) in [("MOT17-01-A", 0.02), ("MOT17-01-B", 0.02), ("MOT17-02-A", 0.03), ("walk", 0.025)] {
        write_sequence(root.path(), name, pace);
    }
    root
}

#[test]
fn trains_the_same_file_twice_and_says_what_it_held_out() {
    let root = world();
    let at = |name: &str| -> PathBuf { root.path().join(name) };
    let run = |name: &str| {
        let (data, out, report) = (root.path().display(), at(name), at("report.json"));
        let text = format!(
            "{data} --out {} --exclude 01-B --examples 4000 --epochs 3 --report {}",
            out.display(),
            report.display()
        );
        train::run(args(&text)).expect("trained");
        fs::read(out).expect("a file")
    };
    let bytes = run("a.onnx");
    assert_eq!(bytes, run("b.onnx"), "the same input gives the same file");
    let (model, metadata) = onnx::read(&bytes).expect("a link model");
    assert_eq!(model.gru.shape.hidden, 32);
    // The copy by the other detector shows the same people: it is held out as well.
    assert_eq!(metadata["excluded"], "MOT17-01-A MOT17-01-B");
    assert_eq!(metadata["sequences"], "MOT17-02-A walk");
    let card = fs::read_to_string(at("a.md")).expect("a card");
    assert!(card.contains("CC BY-NC-SA 3.0") && card.contains("Held out: MOT17-01-A, MOT17-01-B."), "{card}");
    let report: train::Report =
        serde_json::from_str(&fs::read_to_string(at("report.json")).expect("a report")).expect("a report");
    assert_eq!(report.unseen.len(), 2);
    for found in &report.unseen {
        assert!(found.pairs > 100 && found.auc > 0.9 && found.idf1 > 50.0, "{found:?}");
    }
}

#[test]
fn a_killed_run_is_resumed_to_the_same_file() {
    let root = world();
    let at = |name: &str| root.path().join(name).display().to_string();
    let text = |out: &str, more: &str| {
        let data = root.path().display();
        format!("{data} --out {} --examples 4000 --epochs 25 --patience 0{more}", at(out))
    };
    train::run(args(&text("whole.onnx", ""))).expect("trained");

    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_gakp"))
        .arg("train")
        .args(text("cut.onnx", "").split(' '))
        .stdout(std::process::Stdio::null())
        .spawn()
        .expect("started");
    let checkpoint = PathBuf::from(at("cut.onnx.checkpoint"));
    while !checkpoint.exists() && child.try_wait().expect("a child").is_none() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    child.kill().expect("killed");
    child.wait().expect("ended");
    assert!(!PathBuf::from(at("cut.onnx")).exists(), "it was cut before its end");

    let other = train::run(args(&text("cut.onnx", " --resume --seed 2"))).expect_err("another seed");
    assert!(other.to_string().contains("is of other data or settings"), "{other}");
    let (svg, report) = (at("curves.svg"), at("curves.json"));
    let more = format!(" --resume --plot {svg} --report {report}");
    train::run(args(&text("cut.onnx", &more))).expect("resumed");
    let read = |name: &str| fs::read(at(name)).expect("a file");
    assert_eq!(read("cut.onnx"), read("whole.onnx"));
    assert!(!checkpoint.exists(), "nothing is left to resume");
    let report: train::Report = serde_json::from_slice(&read("curves.json")).expect("a report");
    let (name, epochs) = &report.epochs[0];
    assert_eq!((name.as_str(), epochs.len()), ("cut.onnx", 25));
    assert!(epochs[24].training < epochs[0].training && epochs[24].validation.is_some(), "{epochs:?}");
    let drawn = fs::read_to_string(svg).expect("a picture");
    assert!(drawn.contains("validation") && drawn.contains("training"));
}

#[test]
fn leaves_each_footage_out_once() {
    let root = world();
    let out = root.path().join("folds");
    let text = format!(
        "{} --out {} --loso MOT17 --examples 2000 --epochs 1 --second-half A",
        root.path().display(),
        out.display()
    );
    train::run(args(&text)).expect("trained");
    for (fold, seen) in [("MOT17-01", "MOT17-02-A walk"), ("MOT17-02", "MOT17-01-A MOT17-01-B walk")] {
        let bytes = fs::read(out.join(format!("{fold}.onnx"))).expect("a file");
        assert_eq!(onnx::read(&bytes).expect("a link model").1["sequences"], seen);
    }
    assert!(!out.join("walk.onnx").exists());
}

#[test]
fn trains_every_kind_of_features() {
    let root = world();
    for name in ["MOT17-01-A", "MOT17-02-A"] {
        write_features(&root.path().join(name), 8);
    }
    let at = |name: &str| root.path().join(name).display().to_string();
    let [first, second] = ["MOT17-01-A", "MOT17-02-A"].map(at);
    let run =
        |text: &str| train::run(args(&format!("{text} --out {} --examples 2000 --epochs 1", at("x.onnx"))));
    let trained = |text: &str| {
        run(text).expect("trained");
        onnx::read(&fs::read(at("x.onnx")).expect("a file")).expect("a link model")
    };
    for (name, features, hidden) in [
        ("relative", Features::Relative, 32),
        ("appearance", Features::Appearance { embedding: 8 }, 32),
        ("literal", Features::Literal { embedding: 8 }, 134),
        ("spatial", Features::Literal { embedding: 0 }, 134),
    ] {
        let (model, _) = trained(&format!("{first} {second} --exclude MOT17-02 --features {name}"));
        assert_eq!((model.features(), model.gru.shape.hidden), (features, hidden));
        let card = fs::read_to_string(at("x.md")).expect("a card");
        let width = format!("`candidates` | f32 `[P, {}]`", features.candidate());
        assert!(card.contains(&width), "{width:?} is not in\n{card}");
    }
    // Without looks of its own, a sequence is given simulated ones, or the run is refused.
    let walk = at("walk");
    let refused = |text: &str| format!("{:#}", run(text).expect_err("refused"));
    let message = refused(&format!("{first} {walk} --features appearance"));
    assert!(
        message.contains("walk/det/det_features.npy") && message.contains("--simulate-looks"),
        "{message}"
    );
    let (_, metadata) = trained(&format!("{first} {walk} --features appearance --simulate-looks"));
    assert_eq!(metadata["embeddings"], "simulated for sequences that have none");
    let (_, metadata) = trained(&format!("{first} {second} --features appearance --simulate-looks"));
    assert!(!metadata.contains_key("embeddings"), "none had to be simulated");
    let message = refused(&format!("{walk} --features literal --simulate-looks"));
    assert!(message.contains("no sequence has a usable embedding"), "{message}");
    let message = refused(&format!("{first} {walk} --features relative --simulate-looks"));
    assert!(message.contains("--features relative does not look at embeddings"), "{message}");
    let message = refused(&format!("{first} {walk} --features appearance --simulate-looks --loso"));
    assert!(message.contains("without MOT17-01: --loso TEXT"), "{message}");
    let message = refused(&format!("{first} --features literal --association explicit"));
    assert!(message.contains("--features relative or appearance, not literal"), "{message}");
    write_features(&root.path().join("MOT17-02-A"), 9);
    let message = refused(&format!("{first} {second} --features literal"));
    assert!(message.contains("MOT17-02-A: embeddings of 9 numbers, those before it have 8"), "{message}");
    run(&format!("{first} {walk} --features appearance --simulate-looks --association explicit"))
        .expect("trained");
}

#[test]
fn refuses_what_it_cannot_use() {
    let root = world();
    write_sequence(&root.path().join("halves"), "MOT17-02a-A", 0.03);
    let data = root.path().display().to_string();
    let refused = |text: &str| format!("{:#}", train::run(args(text)).expect_err("refused"));
    let out = format!("--out {data}/x.onnx");
    for (text, expected) in [
        (format!("{data}/nowhere {out}"), "nowhere"),
        (format!("{data}/walk/gt {out}"), "expected folders SEQ/"),
        (format!("{data} {out} --exclude MOT99"), "no sequence has that in its name"),
        (format!("{data} {data}/walk {out}"), "walk is given twice"),
        (format!("{data} {data}/halves/MOT17-02a-A {out}"), "MOT17-02a-A is half of the footage of"),
        (format!("{data} --out {data}/no/folder/x.onnx --examples 1000 --epochs 1"), "cannot write"),
    ] {
        let message = refused(&text);
        assert!(message.contains(expected), "{message:?} lacks {expected:?}");
    }
    fs::write(root.path().join("walk/det/det.txt"), "1,-1,a,2,3,4,1\n").expect("written");
    let message = refused(&format!("{data} {out}"));
    assert!(message.contains("det.txt: line 1"), "{message}");
}

#[test]
fn the_shipped_network_is_a_link_model_that_names_its_licence() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/gakp-gru.onnx");
    let (model, metadata) = onnx::read(&fs::read(&file).expect("a file")).expect("a link model");
    assert!(model.gru.theta.iter().all(|v| v.is_finite()));
    assert!(metadata["licence"].contains("CC BY-NC-SA 3.0"));
    assert!(!metadata["sequences"].contains("TUD-"), "the demo footage is for testing");
}

#[test]
fn the_other_shipped_network_has_seen_simulated_people_alone() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/gakp-gru-sim.onnx");
    let (_, metadata) = onnx::read(&fs::read(&file).expect("a file")).expect("a link model");
    assert!(metadata["sequences"].split(' ').all(|name| name.starts_with("SIM-1-")), "{metadata:?}");
    assert!(metadata["licence"].starts_with("none: simulated"));
    assert!(metadata["filter"].contains("centre_walk") && metadata.contains_key("existence"));
}
