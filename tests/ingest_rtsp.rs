//! Cameras over real RTSP on loopback, behaving and misbehaving.
#![cfg(all(feature = "ingest", feature = "testcam"))]

mod ingest_help;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

use gakp::ingest::testcam::{Codec, TestCamera, TestCameraConfig, TestCameraError};
use gakp::ingest::{Failure, SourceEvent, SourceSpec, Transport};
use gakp::types::Clock;
use ingest_help::{Clip, Live, Recorder, brightness_index};

fn spec(url: &str, transport: Transport) -> SourceSpec {
    let mut spec = SourceSpec::parse(url).unwrap();
    spec.transport = transport;
    spec
}

fn tcp(camera: &TestCamera) -> SourceSpec {
    spec(&camera.url(), Transport::Tcp)
}

/// Reads until the camera's stream ends, which for a camera is a loss.
fn until_lost(spec: SourceSpec) -> (Recorder, Failure) {
    let (mut live, mut seen) = (Live::start(spec), Recorder::default());
    loop {
        match live.next().expect("a camera is never finished") {
            SourceEvent::Lost { reason, .. } => {
                live.stop();
                return (seen, reason);
            }
            event => seen.add(event),
        }
    }
}

fn once(clip: &Clip) -> TestCameraConfig {
    TestCameraConfig { looped: false, ..TestCameraConfig::new(clip.path()) }
}

fn indices(count: usize) -> Vec<usize> {
    (0..count).map(brightness_index).collect()
}

/// Every frame from the first to the last. Over UDP the camera's goodbye has a socket of its own: on a busy machine it
/// overtakes what is still under way, and one of the last two frames is lost.
fn check_whole(seen: &Recorder, count: usize, transport: Transport, name: &str) {
    let (found, mut whole) = (seen.indices(), indices(count));
    if transport == Transport::Udp && found.len() == count - 1 {
        let differs = found.iter().zip(&whole).position(|(found, whole)| found != whole);
        whole.remove(differs.unwrap_or(count - 1).max(count - 2));
    }
    assert_eq!(found, whole, "{name} {transport:?}");
}

#[test]
fn every_frame_from_the_first_on_over_tcp_and_udp() {
    let clip = Clip::numbered(75, 25.0);
    let camera = TestCamera::start(once(&clip)).unwrap();
    assert_eq!((camera.frames(), camera.codec()), (75, Codec::H264));
    for transport in [Transport::Tcp, Transport::Udp, Transport::Auto] {
        let (seen, reason) = until_lost(spec(&camera.url(), transport));
        check_whole(&seen, 75, transport, "h264");
        assert_eq!(reason, Failure::Disconnected);
        assert_eq!((seen.opened().codec.as_str(), seen.opened().width), ("h264", 160));
        let times: Vec<f64> = seen.frames().map(|f| f.time.since(Default::default())).collect();
        assert!(times.windows(2).all(|w| w[1] > w[0]), "{times:?}");
        assert!((times[73] - 73.0 / 25.0).abs() < 0.2, "{times:?}");
    }
}

#[test]
fn h265_is_sent_and_decoded() {
    let clip = Clip::numbered(50, 25.0);
    let camera = TestCamera::start(TestCameraConfig { codec: Some(Codec::H265), ..once(&clip) }).unwrap();
    assert_eq!(camera.codec(), Codec::H265);
    let (seen, _) = until_lost(tcp(&camera));
    assert_eq!(seen.indices(), indices(50));
    assert_eq!(seen.opened().codec, "h265");
}

#[test]
fn other_codecs_are_transcoded_and_b_frames_kept_in_order() {
    let clip = Clip::numbered(50, 25.0);
    let jpeg = clip.through(".avi", "qtdemux ! avdec_h264 ! jpegenc quality=95 ! avimux");
    let b_frames = clip.through(
        ".mp4",
        "qtdemux ! avdec_h264 ! x264enc bframes=3 pass=qual quantizer=18 ! h264parse ! mp4mux",
    );
    for (name, clip) in [("jpeg", jpeg), ("b frames", b_frames)] {
        let camera = TestCamera::start(once(&clip)).unwrap();
        for transport in [Transport::Tcp, Transport::Udp] {
            let (seen, _) = until_lost(spec(&camera.url(), transport));
            check_whole(&seen, 50, transport, name);
        }
    }
}

#[test]
fn auto_finds_the_transport_and_a_fixed_one_is_kept() {
    let clip = Clip::numbered(50, 25.0);
    for offered in [Transport::Tcp, Transport::Udp] {
        let camera =
            TestCamera::start(TestCameraConfig { transport: offered, ..TestCameraConfig::new(clip.path()) })
                .unwrap();
        let mut live = Live::start(spec(&camera.url(), Transport::Auto));
        let opened = live.wait("opening", |e| match e {
            SourceEvent::Opened(opened) => Some(opened.clone()),
            _ => None,
        });
        assert_eq!(opened.transport, Some(offered));
        live.stop();
        let other = if offered == Transport::Tcp { Transport::Udp } else { Transport::Tcp };
        let mut live = Live::start(spec(&camera.url(), other));
        for _ in 0..2 {
            assert_eq!(live.wait_lost().0, Failure::Transport, "{offered:?}");
        }
        live.stop();
    }
}

#[test]
fn when_decoding_falls_behind_whole_groups_are_skipped_and_counted() {
    let clip = Clip::numbered(240, 60.0).through(
        ".mp4",
        "qtdemux ! avdec_h264 ! x264enc key-int-max=20 bframes=0 pass=qual quantizer=18 ! h264parse ! mp4mux",
    );
    let camera = TestCamera::start(once(&clip)).unwrap();
    // 10 frames a second of 60; the queue of decoded frames is full at once, then the decoder waits.
    let (mut live, mut seen, mut skipped) =
        (Live::start_slow(tcp(&camera), Duration::from_millis(100)), Recorder::default(), 0);
    let reason = loop {
        match live.next().unwrap() {
            SourceEvent::Skipped { frames } => skipped += frames,
            SourceEvent::Lost { reason, .. } => break reason,
            event => seen.add(event),
        }
    };
    live.stop();
    assert_eq!(reason, Failure::Disconnected);
    assert!(skipped > 50, "{skipped}");
    assert_eq!(seen.events.iter().filter(|e| matches!(e, SourceEvent::Corrupt)).count(), 0);
    assert_eq!(seen.indices().len() as u64 + skipped, 240);
    // After a hole comes a key frame: every 20th.
    let times: Vec<f64> = seen.frames().map(|f| f.time.since(Default::default())).collect();
    for (pair, index) in times.windows(2).zip(&seen.indices()[1..]) {
        assert!(pair[1] - pair[0] < 0.1 || index % 10 == 0, "{index} after {} s", pair[1] - pair[0]);
    }
    for frame in seen.frames().filter(|f| f.capture.clock == Clock::Arrival) {
        let wall = std::time::SystemTime::now() - frame.decoded.elapsed();
        let age =
            wall.duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos() as i64 - frame.capture.unix_ns;
        // 2 s in the queue, the frames that were decoded already, and a loaded machine.
        assert!(age < 4_000_000_000, "{age} ns old");
    }
}

#[test]
fn a_looping_camera_goes_on_and_its_clock_is_told() {
    let clip = Clip::numbered(10, 25.0);
    let camera =
        TestCamera::start(TestCameraConfig { fps: Some(50.0), ..TestCameraConfig::new(clip.path()) })
            .unwrap();
    let mut live = Live::start(tcp(&camera));
    let mut seen = Recorder::default();
    let begun = Instant::now();
    // Sender reports come within some seconds; until then it is the arrival that counts.
    while !seen.frames().last().is_some_and(|f| f.capture.clock == Clock::Rtcp) {
        seen.add(live.next().unwrap());
        assert!(begun.elapsed() < ingest_help::PATIENCE, "no RTCP time");
    }
    live.stop();
    let expected: Vec<usize> = (0..seen.indices().len()).map(|n| n % 10).collect();
    assert_eq!(seen.indices(), expected);
    assert_eq!(seen.frames().next().unwrap().capture.clock, Clock::Arrival);
    let last = seen.frames().last().unwrap();
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos() as i64;
    let age = (now - last.capture.unix_ns) as f64 * 1e-9;
    assert!((-1.0..20.0).contains(&age), "captured {age} s ago");
    let steps: Vec<f64> = seen.frames().map(|f| f.time.0 as f64 * 1e-6).collect();
    let mean = (steps[steps.len() - 1] - steps[0]) / (steps.len() - 1) as f64;
    assert!((mean - 20.0).abs() < 2.0, "{mean} ms a frame");
}

#[test]
fn credentials_decide() {
    let clip = Clip::numbered(100, 25.0);
    let password = "p@ss/w:rd %41";
    let login = Some(("viewer".to_owned(), password.to_owned()));
    let camera = TestCamera::start(TestCameraConfig { login, ..TestCameraConfig::new(clip.path()) }).unwrap();
    assert!(camera.url().contains("viewer:***@"), "{}", camera.url());
    let mut good = Live::start(spec(&camera.url_with("viewer:p%40ss%2Fw%3Ard%20%2541@"), Transport::Tcp));
    good.wait_frame();
    good.stop();
    for bad in ["", "viewer:wrongsecret@", "nobody:p%40ss%2Fw%3Ard%20%2541@", "viewer@"] {
        let mut live = Live::start(spec(&camera.url_with(bad), Transport::Tcp));
        let (reason, retry_in) = live.wait_lost();
        assert_eq!(reason, Failure::Unauthorized, "{bad}");
        assert!(retry_in.unwrap() < Duration::from_secs(1));
        live.stop();
    }
}

#[test]
fn a_wrong_path_and_a_refused_port_are_told_apart() {
    let clip = Clip::numbered(10, 25.0);
    let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    for (url, expected) in [
        (format!("rtsp://{}/other", camera.address()), Failure::NotFound),
        (format!("rtsp://{free}/live"), Failure::Refused),
        (format!("rtsps://{free}/live"), Failure::Refused),
        (format!("http://{free}/live.mjpg"), Failure::Refused),
        ("rtsp://no-such-host.invalid/live".to_owned(), Failure::UnknownHost),
    ] {
        let mut live = Live::start(SourceSpec { insecure_tls: true, ..spec(&url, Transport::Auto) });
        let (reason, retry_in) = live.wait_lost();
        assert_eq!(reason, expected, "{url}");
        assert!(retry_in.unwrap() < Duration::from_secs(1), "{url}: {retry_in:?}");
        // It goes on trying.
        assert_eq!(live.wait_lost().0, expected, "{url}");
        live.stop();
    }
}

/// As the channels of a recorder: behind one address, one of them not there.
#[test]
fn a_wrong_path_costs_no_other_camera_of_the_same_server() {
    let clip = Clip::numbered(50, 25.0);
    let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
    let astray = format!("rtsp://{}/other", camera.address());
    for _ in 0..6 {
        let start = |url: &str| [(); 3].map(|()| Live::start(spec(url, Transport::Tcp)));
        let (mut healthy, astray) = (start(&camera.url()), start(&astray));
        for mut live in astray {
            assert_eq!(live.wait_lost().0, Failure::NotFound);
            live.stop();
        }
        for live in &mut healthy {
            for _ in 0..10 {
                live.wait("frame", |event| match event {
                    SourceEvent::Frame(_) => Some(()),
                    SourceEvent::Lost { reason, .. } => panic!("{reason}"),
                    _ => None,
                });
            }
        }
        healthy.into_iter().for_each(Live::stop);
    }
}

#[test]
fn a_camera_that_dies_and_comes_back_is_seen_again() {
    let clip = Clip::numbered(100, 25.0);
    for transport in [Transport::Tcp, Transport::Udp] {
        let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
        let address = camera.address();
        let mut live = Live::start(spec(&camera.url(), transport));
        let mut last = live.wait_frame();
        for round in 0..2 {
            if round == 0 {
                camera.kill_clients();
            }
            let (reason, _) = live.wait_lost();
            assert!(
                matches!(reason, Failure::Disconnected | Failure::Other(_) | Failure::Silent(_)),
                "{transport:?} {reason}"
            );
            let frame = live.wait_frame();
            assert!(frame.time > last.time);
            let (wall, media) = (frame.decoded - last.decoded, frame.time.since(last.time));
            // Frames seen between `last` and the loss make the media time the longer one by little.
            assert!((media - wall.as_secs_f64()).abs() < 0.5, "{media} s of media in {wall:?}");
            last = frame;
            if round == 0 {
                break;
            }
        }
        camera.stop();
        live.wait_lost();
        let camera =
            TestCamera::start(TestCameraConfig { listen: address, ..TestCameraConfig::new(clip.path()) })
                .unwrap();
        assert!(live.wait_frame().time > last.time, "{transport:?}");
        live.stop();
        camera.stop();
    }
}

#[test]
fn silence_is_noticed_and_survived() {
    let clip = Clip::numbered(50, 25.0);
    let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
    let mut settings = tcp(&camera);
    settings.silence = Duration::from_secs(1);
    let mut live = Live::start(settings);
    let before = live.wait_frame();
    camera.freeze(true);
    let frozen = Instant::now();
    let (reason, _) = live.wait_lost();
    assert_eq!(reason, Failure::Silent(Duration::from_secs(1)));
    assert!(frozen.elapsed() < Duration::from_secs(5));
    camera.freeze(false);
    assert!(live.wait_frame().time > before.time);
    live.stop();
}

#[test]
fn a_freeze_shorter_than_the_limit_is_a_gap_only() {
    let clip = Clip::numbered(50, 25.0);
    let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
    let mut live = Live::start(tcp(&camera));
    live.wait_frame();
    camera.freeze(true);
    std::thread::sleep(Duration::from_millis(1200));
    camera.freeze(false);
    let (mut seen, mut last) = (Vec::new(), None);
    for _ in 0..100 {
        let event = live.next().unwrap();
        assert!(!matches!(event, SourceEvent::Lost { .. }), "{event:?}");
        if let SourceEvent::Frame(frame) = event {
            seen.push(ingest_help::index_of(&frame.image));
            last = Some(frame.time).max(last);
        }
    }
    assert!(seen.windows(2).all(|w| w[1] == (w[0] + 1) % 50), "{seen:?}");
    live.stop();
}

#[test]
fn rubbish_is_called_rubbish() {
    for (name, bytes) in [
        ("noise", (0..4000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 11) as u8).collect::<Vec<u8>>()),
        ("http", b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n<html>no camera</html>".to_vec()),
        ("nothing", Vec::new()),
    ] {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        listener.set_nonblocking(true).unwrap();
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        let server = std::thread::Builder::new()
            .name("rubbish".into())
            .spawn(move || {
                while stopped.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {
                    match listener.accept() {
                        Ok((stream, _)) => answer(stream, &bytes),
                        Err(_) => std::thread::sleep(Duration::from_millis(5)),
                    }
                }
            })
            .unwrap();
        let mut live = Live::start(spec(&format!("rtsp://u:hunter2@{address}/live"), Transport::Tcp));
        let (reason, retry_in) = live.wait_lost();
        assert!(retry_in.is_some());
        let label = reason.label();
        assert!(["garbage", "other", "disconnected"].contains(&label), "{name}: {label} {reason}");
        assert!(!format!("{reason} {reason:?}").contains("hunter2"));
        live.stop();
        drop(stop);
        server.join().unwrap();
    }
}

fn answer(mut stream: TcpStream, bytes: &[u8]) {
    // The client may hang up at any time: what it does not read is no matter.
    let _ = stream.set_nonblocking(false);
    let _ = stream.set_read_timeout(Some(Duration::from_millis(500)));
    let _ = stream.read(&mut [0; 1000]);
    let _ = stream.write_all(bytes);
}

#[test]
fn a_change_of_resolution_in_mid_stream() {
    let (small, large) = (Clip::numbered(25, 25.0), Clip::numbered_sized(25, 25.0, (320, 240)));
    let dir = tempfile::tempdir().unwrap();
    let both = dir.path().join("both.h264");
    let mut bytes = std::fs::read(small.as_byte_stream().path()).unwrap();
    bytes.extend(std::fs::read(large.as_byte_stream().path()).unwrap());
    std::fs::write(&both, bytes).unwrap();
    let camera =
        TestCamera::start(TestCameraConfig { looped: false, ..TestCameraConfig::new(&both) }).unwrap();
    let (seen, _) = until_lost(tcp(&camera));
    let sizes: Vec<_> = seen.frames().map(|f| (f.image.width, f.image.height)).collect();
    assert_eq!(sizes, [vec![(160, 120); 25], vec![(320, 240); 25]].concat());
}

#[test]
fn two_clients_each_get_the_video_from_its_start() {
    let clip = Clip::numbered(100, 25.0);
    let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
    let mut one = Live::start(tcp(&camera));
    for _ in 0..10 {
        one.wait_frame();
    }
    let mut two = Live::start(tcp(&camera));
    assert_eq!(ingest_help::index_of(&two.wait_frame().image), 0);
    one.wait_frame();
    one.stop();
    two.wait_frame();
    two.stop();
}

#[test]
fn a_camera_says_why_it_does_not_start() {
    let clip = Clip::numbered(10, 25.0);
    let camera = TestCamera::start(TestCameraConfig::new(clip.path())).unwrap();
    let again = TestCamera::start(TestCameraConfig {
        listen: camera.address(),
        ..TestCameraConfig::new(clip.path())
    });
    let error = again.err().unwrap();
    assert!(matches!(&error, TestCameraError::Listen { .. }), "{error}");
    assert!(error.to_string().contains(&camera.address().to_string()), "{error}");
    let error = TestCamera::start(TestCameraConfig::new("/nowhere.mp4")).err().unwrap();
    assert!(matches!(&error, TestCameraError::File { .. }), "{error}");
    let text = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(text.path(), "no video\n".repeat(500)).unwrap();
    let error = TestCamera::start(TestCameraConfig::new(text.path())).err().unwrap();
    assert!(matches!(&error, TestCameraError::Video { .. }), "{error}");
    let error =
        TestCamera::start(TestCameraConfig { path: "live".into(), ..TestCameraConfig::new(clip.path()) });
    assert!(matches!(error.err().unwrap(), TestCameraError::Setting(_)));
}
