//! `gakp tune`: from a wrong filter back to a consistent one, from folders to a file that is taken.
#![cfg(all(feature = "learn", feature = "cli"))]

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use clap::Parser;
use gakp::cli::tune as command;
use gakp::learn::tune::{
    Cost, Group, HORIZONS, Measured, Point, Settings, Statistic, World, measure, noise, scaled, tune,
};
use gakp::track::FilterConfig;
use gakp::tuning::Tuning;

#[derive(Parser)]
struct Command {
    #[command(flatten)]
    tune: command::Args,
}

fn args(text: &str) -> Result<command::Args, clap::Error> {
    Ok(Command::try_parse_from(std::iter::once("tune").chain(text.split(' ')))?.tune)
}

/// Mean NEES of the whole box at every horizon.
fn means(measured: &Measured) -> Vec<(f64, bool)> {
    let all = (0..HORIZONS.len()).filter_map(|h| measured.all(h, 0.0));
    all.map(|c| (c.mean, c.holds())).collect()
}

/// Issue 3, point e: a start ten times off in Q and in R, in each direction, ends within the bounds.
#[test]
fn ten_times_off_is_brought_back_within_its_bounds() {
    let world = World { people: 150, ..World::default() };
    let recording = world.record();
    for (q, r) in [(10.0, 10.0), (10.0, 0.1), (0.1, 10.0), (0.1, 0.1)] {
        let start = scaled(&world.filter, q, r);
        let before = measure(&start, &[&recording], Statistic::Nees);
        assert!(means(&before).iter().all(|(_, holds)| !holds), "Q x {q}, R x {r}: {:?}", means(&before));
        let tuned = tune(&start, &[&recording], &Settings::default(), |_, _| ()).expect("samples");
        let after = measure(&tuned.filter, &[&recording], Statistic::Nees);
        let found = means(&after);
        assert_eq!(found.len(), HORIZONS.len());
        assert!(found.iter().all(|(_, holds)| *holds), "Q x {q}, R x {r}: {found:?}");
        let state = after.state(0.0).expect("velocities are known");
        assert!(state.holds(), "Q x {q}, R x {r}: {state:?}");
        for group in Group::ALL {
            for (found, true_) in noise(&tuned.filter, group).iter().zip(noise(&world.filter, group)) {
                assert!((0.75..1.3).contains(&(found / true_)), "Q x {q}, R x {r}: {:?}", tuned.filter);
            }
        }
    }
}

#[test]
fn chen_s_cost_and_innovations_alone_find_the_noise_too() {
    let world = World { people: 100, seed: 3, ..World::default() };
    let mut recording = world.record();
    let start = scaled(&world.filter, 10.0, 0.1);
    let near = |settings: &Settings, recording: &_| {
        let tuned = tune(&start, &[recording], settings, |_, _| ()).expect("samples");
        let again = tune(&start, &[recording], settings, |_, _| ()).expect("samples");
        assert_eq!(tuned, again, "the same search goes the same way");
        let found = measure(&tuned.filter, &[recording], settings.statistic);
        for (h, (mean, _)) in HORIZONS.iter().zip(means(&found)) {
            assert!((mean / 4.0 - 1.0).abs() < 0.1, "{settings:?} {h:?}: {mean}");
        }
    };
    near(&Settings { cost: Cost::Consistency, ..Settings::default() }, &recording);
    for point in recording.people.iter_mut().flat_map(|p| &mut p.points) {
        *point = Point { measured: point.measured, ..Point::default() };
    }
    near(&Settings { statistic: Statistic::Nis, ..Settings::default() }, &recording);
    let nees = tune(&start, &[&recording], &Settings::default(), |_, _| ());
    assert!(nees.expect_err("no truth").to_string().contains("no sample"));
}

/// A sequence folder of the simulated world, boxes laid out so that they do not overlap.
fn write_sequence(root: &Path, name: &str, seed: u64) {
    let world = World {
        people: 12,
        seed,
        filter: FilterConfig { birth_centre_velocity: 0.1, ..World::default().filter },
        ..World::default()
    };
    let (mut truth, mut detections) = (String::new(), String::new());
    let recording = world.record();
    for (id, person) in recording.people.iter().enumerate() {
        let at = |[cx, cy, w, h]: [f64; 4]| {
            let (x, y) = (cx - w / 2.0 + 2000.0 * id as f64, cy - h / 2.0);
            format!("{x:.3},{y:.3},{w:.3},{h:.3}")
        };
        for (i, point) in person.points.iter().enumerate() {
            let frame = person.first + i + 1;
            // A file has no boxes without an area.
            let drawn = |bbox: &[f64; 4]| bbox[2] > 1.0 && bbox[3] > 1.0;
            if let Some(bbox) = point.truth.filter(drawn) {
                writeln!(truth, "{frame},{},{},1,1,1", id + 1, at(bbox)).expect("written");
            }
            if let Some(bbox) = point.measured.filter(drawn) {
                writeln!(detections, "{frame},-1,{},0.9", at(bbox)).expect("written");
            }
        }
    }
    let folder = root.join(name);
    for (file, text) in [("gt/gt.txt", &truth), ("det/det.txt", &detections)] {
        let path = folder.join(file);
        fs::create_dir_all(path.parent().expect("a folder")).expect("created");
        fs::write(path, text).expect("written");
    }
    let length = recording.times.len();
    let ini =
        format!("[Sequence]\nname={name}\nframeRate=25\nseqLength={length}\nimWidth=30000\nimHeight=2000\n");
    fs::write(folder.join("seqinfo.ini"), ini).expect("written");
}

#[test]
fn folders_to_a_file_and_a_plot() {
    let root = tempfile::tempdir().expect("a folder");
    for (name, seed) in [("MOT17-01-A", 1), ("MOT17-02-A", 2), ("MOT17-02-B", 3)] {
        write_sequence(&root.path().join("data"), name, seed);
    }
    let dir = root.path().display();
    let run = |text: &str| command::run(args(text).expect("arguments"));
    let plain = format!("{dir}/data --evaluations 30 --plot {dir}/c.svg --out {dir}/t.toml");
    run(&plain).expect("tuned");
    let written = fs::read_to_string(root.path().join("t.toml")).expect("a file");
    let tuning = Tuning::read(&root.path().join("t.toml")).expect("a tuning");
    let origin = tuning.origin.expect("says where it comes from");
    assert_eq!((origin.statistic.as_str(), origin.data.len(), origin.evaluations), ("NEES", 3, 30));
    assert!(origin.cost_after[0] < origin.cost_before[0] && origin.cost_after[1] < origin.cost_before[1]);
    assert_ne!(tuning.filter.apply(FilterConfig::default()), FilterConfig::default());
    assert!(fs::read_to_string(root.path().join("c.svg")).expect("a plot").contains("NEES after 1 frame"));
    run(&plain).expect("tuned");
    assert_eq!(fs::read_to_string(root.path().join("t.toml")).expect("a file"), written, "the same file");

    // Copies of a footage are left out together.
    run(&format!("{dir}/data --evaluations 10 --loso MOT17 --out {dir}/loso")).expect("tuned");
    let left = Tuning::read(&root.path().join("loso/MOT17-02.toml")).expect("a tuning").origin;
    assert_eq!(left.expect("an origin").data, ["MOT17-01-A"]);

    // Without truth.
    for name in ["MOT17-01-A", "MOT17-02-A", "MOT17-02-B"] {
        fs::remove_dir_all(root.path().join("data").join(name).join("gt")).expect("removed");
    }
    let wrong = run(&plain).expect_err("no truth").to_string();
    assert!(wrong.contains("gt/gt.txt"), "{wrong}");
    run(&format!("{dir}/data --nis --evaluations 10 --out {dir}/nis.toml")).expect("tuned");
    let nis = Tuning::read(&root.path().join("nis.toml")).expect("a tuning").origin.expect("an origin");
    assert!(nis.statistic == "NIS" && nis.cost_after[0] < nis.cost_before[0], "{nis:?}");
}

#[test]
fn mistakes_are_named() {
    for (text, expected) in [
        ("", "required"),
        ("data", "--out"),
        ("data --out x --evaluations 3", "3 is not in 10..=10000"),
        ("data --out x --cost nees", "expected likelihood or consistency"),
        ("data --simulated", "cannot be used with"),
    ] {
        let message = args(text).expect_err(text).to_string();
        assert!(message.contains(expected), "{text:?} gave {message:?}");
    }
    for (text, expected) in [
        ("no/such/folder --out x", "no/such/folder"),
        ("no/such/folder --out x --trim 0.5", "--trim 0.5: must be from 0 to less than 0.5"),
    ] {
        let message = format!("{:#}", command::run(args(text).expect("arguments")).expect_err(text));
        assert!(message.contains(expected), "{text:?} gave {message:?}");
    }
}
