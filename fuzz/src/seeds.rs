//! Inputs to begin with: what people write, from the repository's own files.

use gakp::api::RIGHTS;
use gakp::mot;

const CONFIG: &str = include_str!("../../deploy/compose/gakp.example.toml");
const MANIFEST: &str = include_str!("../../models/manifest.toml");
const TRUTH: &str = include_str!("../../tests/fixtures/mot/mot15/gt/SEQ-01/gt/gt.txt");
const RESULTS: &str = include_str!("../../tests/fixtures/mot/mot15/results/SEQ-02.txt");
const INFO: &str = include_str!("../../tests/fixtures/mot/mot15/gt/SEQ-01/seqinfo.ini");
const ADDRESSES: [&str; 9] = [
    "rtsp://user:pass%20word@camera.example:8554/live?token=abc&channel=1",
    "rtsps://[fe80::1%25eth0]:322/Streaming/Channels/101",
    "rtsp://u:p@ss#?1@cam/user=u_password=x_channel=1/y",
    "http://user:pass@camera/video.m3u8?signature=abc;key=d",
    "https://camera.example/mjpg/video.mjpg",
    "file://localhost/a%20b.mp4",
    "v4l2:///dev/video0",
    "test:?size=320x240&fps=10&pattern=ball",
    "12:30.mp4",
];
/// Bodies of requests that change something.
const BODIES: [&str; 9] = [
    r#"{"id":"door","url":"rtsp://user:secret@192.0.2.1/live","min_score":0.3,"classes":["person"]}"#,
    r#"{"paused":true,"min_score":null,"fps":5,"transport":"tcp"}"#,
    r#"{"name":"entry","from":[0.1,0.2],"to":[0.9,0.8],"classes":["person"]}"#,
    r#"{"name":"shop","polygon":[[0.1,0.1],[0.9,0.1],[0.5,0.9]],"loiter_after_s":10,"crowd_above":3}"#,
    r#"{"name":"wall","polygon":[[0,0],[1,0],[1,1]],"how":"blur"}"#,
    r#"{"name":"hook","url":"http://127.0.0.1:9/x","secret":"whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"}"#,
    r#"{"token":"gakp_00000000000000000000000000000000"}"#,
    r#"{"filter":"info,gakp=debug"}"#,
    "{}",
];
const QUERIES: [&str; 6] = [
    "",
    "limit=2&cursor=eyJhIjoxfQ&camera=gate&from=2026-01-02T03:04:05Z&to=2026-01-03T00:00:00%2B01:00",
    "format=json&camera=gate&class=person&state=confirmed&min_confidence=0.5&max_fps=2",
    "format=protobuf&camera=gate&camera=door",
    "kind=crossing&line=entry&zone=shop&order=desc&bucket=hour&after=9",
    "size=16x12&class=person&from=-PT1H",
];

/// The seeds of a target.
pub fn of(target: &str) -> Vec<Vec<u8>> {
    match target {
        "config" => pieces(CONFIG),
        "manifest" => vec![MANIFEST.into()],
        "mot" => mot_files(),
        "url" => ADDRESSES.map(Into::into).to_vec(),
        "tracker" => (1..=32).map(|step: u16| bytes(step, 64 * usize::from(step))).collect(),
        _ => requests(),
    }
}

/// The whole and each of its tables.
fn pieces(text: &str) -> Vec<Vec<u8>> {
    let tables = text.split("\n[").map(|table| format!("[{table}").into_bytes());
    std::iter::once(text.into()).chain(tables).collect()
}

fn mot_files() -> Vec<Vec<u8>> {
    let rows = |text: &str| text.lines().take(20).map(|line| format!("{line}\n")).collect::<String>();
    let rows = [rows(TRUTH), rows(RESULTS)];
    let matrix = mot::Matrix { rows: 2, columns: 3, values: vec![0.5; 6] };
    let array = mot::write_npy(&matrix);
    let mut seeds: Vec<Vec<u8>> = vec![];
    for kind in (0..3).chain(8..11) {
        seeds.extend(rows.iter().map(|rows| [&[kind], rows.as_bytes()].concat()));
    }
    seeds.push([&[3], INFO.as_bytes()].concat());
    seeds.push([&[4], &array[..]].concat());
    let detections =
        format!("{:width$}", "1,-1,10,20,30,40,0.9\n2,-1,11,20,30,40,0.8\n", width = array.len());
    seeds.push([&[5], &array[..], detections.as_bytes()].concat());
    seeds
}

/// Bytes without a pattern (a linear congruential generator, Numerical Recipes), the same each time.
fn bytes(seed: u16, count: usize) -> Vec<u8> {
    let mut state = u32::from(seed);
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    (0..count).map(|_| next()).collect()
}

fn requests() -> Vec<Vec<u8>> {
    let mut seeds = vec![b"\0GET /v1/cameras HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\n\r\n".to_vec()];
    for which in 0..RIGHTS.len() {
        for query in QUERIES {
            let body = BODIES[which % BODIES.len()];
            seeds
                .push([&[1, which as u8], &b"gate\0"[..], query.as_bytes(), b"\0", body.as_bytes()].concat());
        }
        let all = |body: &str| [&[1, which as u8], &b"\0\0"[..], body.as_bytes()].concat();
        if !RIGHTS[which].0.starts_with('G') {
            seeds.extend(BODIES.map(all));
        }
    }
    for path in 0..3 {
        for query in QUERIES {
            // Text, binary, ping and close, masked with zeros.
            let frames = b"\x81\x82\0\0\0\0{}\x82\x81\0\0\0\0\x01\x89\x80\0\0\0\0\x88\x82\0\0\0\0\x03\xe8";
            seeds.push([&[2 + 4 * path], query.as_bytes(), b"\0", frames].concat());
        }
    }
    // SETTINGS, then HEADERS of a gRPC request (literals without indexing, RFC 7541), then an empty message.
    let mut block = vec![0x83, 0x86];
    for (name, value) in [
        (":path", "/gakp.v1.Tracks/Subscribe"),
        (":authority", "localhost"),
        ("content-type", "application/grpc"),
        ("te", "trailers"),
    ] {
        block.extend([0, name.len() as u8]);
        block.extend(name.bytes());
        block.push(value.len() as u8);
        block.extend(value.bytes());
    }
    let settings = [0, 0, 0, 4, 0, 0, 0, 0, 0];
    let headers = [0, 0, block.len() as u8, 1, 4, 0, 0, 0, 1];
    let message = [0, 0, 5, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0];
    seeds.push([&[3], &settings[..], &headers, &block, &message].concat());
    seeds
}
