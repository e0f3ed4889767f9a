//! Files, the test pattern and the writer, through real GStreamer pipelines.
#![cfg(feature = "ingest")]

mod ingest_help;

use std::time::Duration;

use gakp::ingest::{Failure, Pacing, Pixels, SourceError, SourceEvent, SourceSpec, VideoWriter, start};
use gakp::types::{Clock, MediaTime};
use ingest_help::{Clip, Recorder, brightness_index, id};

fn offline(path: &std::path::Path) -> SourceSpec {
    let mut spec = SourceSpec::parse(path.to_str().unwrap()).unwrap();
    spec.pacing = Pacing::AsFastAsPossible;
    spec
}

#[test]
fn a_file_gives_every_frame_once_in_order_then_ends() {
    let clip = Clip::numbered(179, 25.0);
    let seen = Recorder::run_to_end(offline(clip.path()));
    let opened = seen.opened();
    assert_eq!((opened.width, opened.height, opened.codec.as_str()), (160, 120, "h264"));
    assert_eq!(opened.fps, Some(25.0));
    assert!((opened.duration.unwrap().as_secs_f64() - 179.0 / 25.0).abs() < 0.1, "{opened:?}");
    assert_eq!(seen.indices(), (0..179).map(brightness_index).collect::<Vec<_>>());
    for (n, frame) in seen.frames().enumerate() {
        assert_eq!(frame.time, MediaTime(n as i64 * 40_000_000));
        assert_eq!((frame.capture.unix_ns, frame.capture.clock), (frame.time.0, Clock::Media));
    }
    assert!(matches!(seen.events.last(), Some(SourceEvent::Ended)), "{:?}", seen.events.last());
}

#[test]
fn a_slow_sink_loses_nothing() {
    let clip = Clip::numbered(60, 25.0);
    let seen = Recorder::run_to_end_slowly(offline(clip.path()), Duration::from_millis(15));
    assert_eq!(seen.indices(), (0..60).map(brightness_index).collect::<Vec<_>>());
}

#[test]
fn a_looped_file_goes_on_by_one_frame() {
    let clip = Clip::numbered(20, 25.0);
    let mut spec = offline(clip.path());
    spec.looped = true;
    let seen = Recorder::run_for_frames(spec, 70);
    for (n, (frame, index)) in seen.frames().zip(seen.indices()).enumerate() {
        assert_eq!(frame.time.0, n as i64 * 40_000_000);
        assert_eq!(index, brightness_index(n % 20));
    }
}

#[test]
fn real_time_pacing_follows_the_clock() {
    let clip = Clip::numbered(25, 25.0);
    let mut spec = offline(clip.path());
    spec.pacing = Pacing::Realtime;
    let seen = Recorder::run_to_end(spec);
    assert_eq!(seen.frames().count(), 25);
    let (first, last) = (seen.frames().next().unwrap(), seen.frames().last().unwrap());
    // 24 steps of 40 ms; a loaded machine may be late, never early.
    assert!(last.decoded.duration_since(first.decoded) > Duration::from_millis(800));
    assert!(seen.frames().all(|f| f.capture.clock == Clock::Arrival));
}

#[test]
fn a_missing_file_is_refused_before_anything_starts() {
    let error = start(&id("a"), offline("/nowhere/a.mp4".as_ref()), |_| panic!("called")).unwrap_err();
    assert!(matches!(&error, SourceError::File { path, .. } if path == "/nowhere/a.mp4"), "{error}");
    let error = start(&id("a"), offline("/".as_ref()), |_| panic!("called")).unwrap_err();
    assert!(error.to_string().contains("directory"), "{error}");
}

#[test]
fn not_a_video_is_said_once() {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in [
        ("text.mp4", b"this is no video at all, only a text that goes on for a while\n".repeat(50)),
        ("zeros.mp4", vec![0; 20_000]),
        ("empty.mp4", Vec::new()),
        ("sound.wav", wav()),
    ] {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let seen = Recorder::run_to_end(offline(&path));
        assert_eq!(seen.events.len(), 1, "{name}: {:?}", seen.events);
        let SourceEvent::Lost { reason, retry_in: None } = &seen.events[0] else {
            panic!("{name}: {:?}", seen.events)
        };
        assert!(
            matches!(reason, Failure::Unsupported(_) | Failure::Garbage(_) | Failure::Other(_)),
            "{name}: {reason}"
        );
    }
}

#[test]
fn a_truncated_file_gives_what_it_has() {
    let clip = Clip::numbered(60, 25.0);
    let raw = clip.as_byte_stream();
    let bytes = std::fs::read(raw.path()).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let half = dir.path().join("half.h264");
    std::fs::write(&half, &bytes[..bytes.len() / 2]).unwrap();
    let seen = Recorder::run_to_end(offline(&half));
    let count = seen.frames().count();
    assert!((5..60).contains(&count), "{count}");
}

#[test]
fn the_test_pattern_runs_and_ends() {
    let mut spec = SourceSpec::parse("test:?pattern=ball&width=320&height=240&fps=50&frames=30").unwrap();
    for pacing in [Pacing::AsFastAsPossible, Pacing::Realtime] {
        spec.pacing = pacing;
        let seen = Recorder::run_to_end(spec.clone());
        assert_eq!(seen.frames().count(), 30);
        assert!(seen.frames().all(|f| (f.image.width, f.image.height) == (320, 240)));
        assert!(matches!(seen.events.last(), Some(SourceEvent::Ended)));
    }
}

#[test]
fn a_change_of_resolution_reaches_the_frames() {
    let (small, large) = (Clip::numbered(10, 25.0), Clip::numbered_sized(10, 25.0, (320, 240)));
    let dir = tempfile::tempdir().unwrap();
    let both = dir.path().join("both.h264");
    let mut bytes = std::fs::read(small.as_byte_stream().path()).unwrap();
    bytes.extend(std::fs::read(large.as_byte_stream().path()).unwrap());
    std::fs::write(&both, bytes).unwrap();
    let seen = Recorder::run_to_end(offline(&both));
    let sizes: Vec<_> = seen.frames().map(|f| (f.image.width, f.image.height)).collect();
    assert_eq!(sizes, [vec![(160, 120); 10], vec![(320, 240); 10]].concat());
}

#[test]
fn stopping_is_prompt_even_while_frames_flow() {
    let (name, spec) = (id("stop"), SourceSpec::parse("test:").unwrap());
    let handle = start(&name, spec, |_| std::ops::ControlFlow::Continue(())).unwrap();
    let begun = std::time::Instant::now();
    handle.stop();
    assert!(begun.elapsed() < Duration::from_secs(5));
}

#[test]
fn the_writer_keeps_frames_times_and_colours() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("rgb.mp4");
    let mut writer = VideoWriter::create(&path, (65, 49), 10.0, Pixels::Rgb).unwrap();
    let red = [200u8, 30, 30].repeat(65 * 49);
    for n in 0..12 {
        writer.write_rgb(&red, MediaTime(5_000_000_000 + n * 100_000_000)).unwrap();
    }
    assert!(writer.write_rgb(&red, MediaTime(0)).is_err());
    assert!(writer.write_rgb(&red[1..], MediaTime(9_000_000_000)).is_err());
    writer.finish().unwrap();
    let seen = Recorder::run_to_end(offline(&path));
    assert_eq!(seen.frames().count(), 12);
    let frame = seen.frames().last().unwrap();
    assert_eq!((frame.image.width, frame.image.height), (64, 48));
    assert_eq!(frame.time, MediaTime(1_100_000_000));
    let mean = |i: usize| {
        let ((bytes, stride), (w, h)) = (frame.image.plane(i), frame.image.plane_size(i));
        bytes.chunks(stride).take(h).flat_map(|row| &row[..w]).map(|&b| b as f64).sum::<f64>()
            / (w * h) as f64
    };
    // (200, 30, 30) in BT.601 limited range.
    for (i, expected) in [84.0, 103.0, 202.0].into_iter().enumerate() {
        assert!((mean(i) - expected).abs() < 6.0, "plane {i}: {}", mean(i));
    }
    assert!(VideoWriter::create("/nowhere/a.mp4".as_ref(), (64, 48), 10.0, Pixels::Rgb).is_err());
    let empty = VideoWriter::create(&dir.path().join("e.mp4"), (64, 48), 10.0, Pixels::Rgb).unwrap();
    assert!(empty.finish().is_err());
}

/// A second of silence.
fn wav() -> Vec<u8> {
    let mut bytes =
        b"RIFF\x64\x1f\x00\x00WAVEfmt \x10\0\0\0\x01\0\x01\0\x40\x1f\0\0\x40\x1f\0\0\x01\0\x08\0data"
            .to_vec();
    bytes.extend(8000u32.to_le_bytes());
    bytes.extend([128; 8000]);
    bytes
}
