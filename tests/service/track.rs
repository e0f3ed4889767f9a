//! `gakp track`: every frame in order, the same bytes every time.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::ops::ControlFlow;
use std::path::Path;
use std::process::Output;
use std::sync::mpsc;
use std::time::Duration;

use gakp::ingest::{Pacing, SourceEvent, SourceSpec};
use gakp::mot::{Row, parse_results};
use gakp::types::CameraId;

use super::support::*;

/// Runs `gakp track`, which must go well.
fn track(args: &[&str]) -> Output {
    let output = run_to_end(&[&["track", "--provider", "cpu"], args].concat(), &[]);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

fn rows(path: &Path, frames: usize) -> Vec<Row> {
    let rows = parse_results(&fs::read_to_string(path).unwrap(), Some(frames as u32)).unwrap();
    assert!(rows.is_sorted_by_key(|row| row.frame), "rows are in the order of the frames");
    rows
}

/// How many frames the library's own source decodes from a file, and their size.
fn decoded(path: &Path) -> (usize, (u32, u32)) {
    let mut spec = SourceSpec::parse(path.to_str().unwrap()).unwrap();
    spec.pacing = Pacing::AsFastAsPossible;
    let (events, seen) = mpsc::sync_channel(4);
    let source =
        gakp::ingest::start(&CameraId::new("copy").unwrap(), spec, move |event| match events.send(event) {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        });
    let (mut frames, mut size) = (0, (0, 0));
    loop {
        match seen.recv_timeout(PATIENCE).expect("the file goes on or ends") {
            SourceEvent::Frame(frame) => {
                (frames, size) = (frames + 1, (frame.image.width, frame.image.height))
            }
            SourceEvent::Ended => break,
            SourceEvent::Opened(_) => {}
            other => panic!("{other:?}"),
        }
    }
    source.unwrap().stop();
    (frames, size)
}

#[test]
fn a_video_gives_the_same_rows_every_time_and_an_annotated_copy() {
    let Some(clip) = clip() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let text = |name: &str| path(name).to_str().unwrap().to_owned();
    let input = clip.to_str().unwrap();

    track(&[input, "--out", &text("first.txt"), "--video", &text("copy.mp4")]);
    let rows = rows(&path("first.txt"), CLIP_FRAMES);
    let mut frames_of: BTreeMap<i64, usize> = BTreeMap::new();
    for row in &rows {
        *frames_of.entry(row.id).or_default() += 1;
        assert!(row.bbox.is_valid() && row.bbox.x < 768.0 && row.bbox.y < 576.0, "{row:?}");
    }
    let longest = frames_of.values().max().copied().unwrap_or(0);
    assert!(longest >= CLIP_FRAMES / 2, "someone is tracked for half of the clip: {frames_of:?}");
    assert_eq!(rows.last().unwrap().frame as usize, CLIP_FRAMES, "there are people in the last frame");
    assert_eq!(decoded(&path("copy.mp4")), (CLIP_FRAMES, (768, 576)));

    // Without the copy, on another number of cores, to standard output: the same bytes.
    track(&[input, "--out", &text("second.txt"), "--threads", "1"]);
    let first = fs::read(path("first.txt")).unwrap();
    assert_eq!(fs::read(path("second.txt")).unwrap(), first);
    assert_eq!(track(&[input, "--out", "-"]).stdout, first);

    track(&[input, "--out", &text("part.txt"), "--frames", "30"]);
    let part = fs::read(path("part.txt")).unwrap();
    assert!(!part.is_empty() && first.starts_with(&part), "the first frames' rows");
    assert!(parse_results(std::str::from_utf8(&part).unwrap(), Some(30)).is_ok());
}

/// A live camera has no end: a signal ends the run, and what was written is complete.
#[test]
fn a_signal_ends_the_tracking_of_a_live_camera() {
    let Some(clip) = clip() else { return };
    let camera = CameraProcess::start(&clip, &[]);
    let folder = tempfile::tempdir().unwrap();
    for signal in ["INT", "TERM"] {
        let path = |kind: &str| folder.path().join(format!("{signal}.{kind}"));
        let (out, copy) = (path("txt"), path("mp4"));
        let args = ["--out", out.to_str().unwrap(), "--video", copy.to_str().unwrap()];
        let mut process = Process::start(&[&["track", &camera.url], &args[..]].concat());
        // The copy gets its first bytes late; the rows' file is there once a frame was tracked.
        eventually("the first frame", || out.exists().then_some(()));
        std::thread::sleep(Duration::from_secs(1));
        process.signal(signal);
        assert_eq!(process.wait().code(), Some(0), "{}", process.log());
        let (frames, size) = decoded(&copy);
        assert!(frames > 0 && size == (768, 576), "{frames} of {size:?}");
        assert!(rows(&out, 10 * CLIP_FRAMES).iter().all(|row| row.bbox.is_valid()));
    }
}

/// A sequence of two people who walk past each other, seen in every frame.
fn sequence(folder: &Path, name: &str, frames: usize) -> String {
    let folder = folder.join(name);
    fs::create_dir_all(folder.join("det")).unwrap();
    let ini = format!(
        "[Sequence]\nname={name}\nimDir=img1\nframeRate=25\nseqLength={frames}\nimWidth=640\nimHeight=480\nimExt=.jpg\n"
    );
    fs::write(folder.join("seqinfo.ini"), ini).unwrap();
    let mut det = String::new();
    for frame in 1..=frames {
        let step = frame as f64 * 3.0;
        writeln!(det, "{frame},-1,{:.1},100,40,100,0.95,-1,-1,-1", 20.0 + step).unwrap();
        writeln!(det, "{frame},-1,{:.1},260,45,110,0.9,-1,-1,-1", 560.0 - step).unwrap();
    }
    fs::write(folder.join("det/det.txt"), det).unwrap();
    folder.to_str().unwrap().to_owned()
}

#[test]
fn a_sequence_folder_needs_no_video() {
    if models().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (one, two) = (sequence(folder.path(), "ONE", 60), sequence(folder.path(), "TWO", 40));
    let out = folder.path().join("one.txt");
    let home = tempfile::tempdir().unwrap();
    let env = [("HOME", home.path().to_str().unwrap()), ("XDG_CACHE_HOME", "")];
    let ended = run_to_end(&["track", &one, "--out", out.to_str().unwrap()], &env);
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    // ONNX Runtime's telemetry keeps an identity there.
    assert!(!home.path().join(".cache/Microsoft").exists(), "nothing is prepared to be told to others");
    let rows = rows(&out, 60);
    for frame in 10..=60 {
        let ids: Vec<_> = rows.iter().filter(|row| row.frame == frame).map(|row| row.id).collect();
        assert_eq!(ids, [1, 2], "frame {frame}");
    }
    let first = fs::read(&out).unwrap();
    assert_eq!(track(&[&one, "--out", "-"]).stdout, first);

    let many = folder.path().join("many");
    track(&[&one, &two, "--out", many.to_str().unwrap()]);
    assert_eq!(fs::read(many.join("ONE.txt")).unwrap(), first);
    assert!(fs::read_to_string(many.join("TWO.txt")).unwrap().contains("\n40,"));

    let half = folder.path().join("half.txt");
    track(&[&one, "--out", half.to_str().unwrap(), "--second-half"]);
    let half = parse_results(&fs::read_to_string(half).unwrap(), Some(29)).unwrap();
    assert_eq!(half.last().unwrap().frame, 29, "frames after 60 / 2 + 1, renumbered");
}
