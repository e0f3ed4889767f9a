//! HTTP sources: a file, HLS, a stream that has no end and breaks off.
#![cfg(feature = "ingest")]

mod ingest_help;

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use gakp::ingest::{Failure, Pacing, SourceEvent, SourceSpec};
use ingest_help::{Clip, Live, Recorder, brightness_index};

#[test]
fn a_file_and_hls_give_every_frame() {
    let clip = Clip::numbered(40, 25.0);
    let server = Server::start();
    std::fs::copy(clip.path(), server.path("clip.mp4")).unwrap();
    let ts = clip.through(".ts", "qtdemux ! h264parse config-interval=-1 ! mpegtsmux");
    std::fs::copy(ts.path(), server.path("part0.ts")).unwrap();
    let list = "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:2\n#EXTINF:1.6,\npart0.ts\n#EXT-X-ENDLIST\n";
    std::fs::write(server.path("list.m3u8"), list).unwrap();
    for name in ["clip.mp4", "list.m3u8"] {
        let mut spec = SourceSpec::parse(&server.url(name)).unwrap();
        spec.pacing = Pacing::AsFastAsPossible;
        let seen = Recorder::run_to_end(spec);
        assert_eq!(
            seen.indices(),
            (0..40).map(brightness_index).collect::<Vec<_>>(),
            "{name} {:?}",
            seen.events
        );
        assert!(matches!(seen.events.last(), Some(SourceEvent::Ended)), "{name}");
        assert_eq!(seen.opened().codec, "h264");
    }
}

#[test]
fn a_missing_page_is_tried_again_and_a_clip_that_is_played_once_is_not() {
    let server = Server::start();
    let spec = SourceSpec::parse(&server.url("nothing.mp4")).unwrap();
    let mut live = Live::start(spec.clone());
    for _ in 0..2 {
        let (reason, retry_in) = live.wait_lost();
        assert_eq!(reason, Failure::NotFound);
        assert!(retry_in.is_some());
    }
    live.stop();
    let seen = Recorder::run_to_end(SourceSpec { pacing: Pacing::AsFastAsPossible, ..spec });
    assert!(matches!(&seen.events[..], [SourceEvent::Lost { reason: Failure::NotFound, retry_in: None }]));
}

#[test]
fn an_endless_stream_that_breaks_off_is_lost_and_comes_back() {
    let clip = Clip::numbered(60, 25.0);
    let ts = clip.through(".ts", "qtdemux ! h264parse config-interval=-1 ! mpegtsmux");
    let server = Server::start();
    std::fs::copy(ts.path(), server.path("live.endless")).unwrap();
    let mut live = Live::start(SourceSpec::parse(&server.url("live.endless")).unwrap());
    let first = live.wait_frame();
    let (reason, retry_in) = live.wait_lost();
    assert_eq!(reason, Failure::Disconnected);
    assert!(retry_in.unwrap() < Duration::from_secs(1));
    assert!(live.wait_frame().time > first.time);
    live.stop();
}

/// Serves a folder: ranges, 404, and `*.endless` without a length.
struct Server {
    dir: tempfile::TempDir,
    address: std::net::SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    fn start() -> Self {
        let (dir, stop) = (tempfile::tempdir().unwrap(), Arc::new(AtomicBool::new(false)));
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let (root, told) = (dir.path().to_owned(), stop.clone());
        let thread = std::thread::Builder::new()
            .name("http".into())
            .spawn(move || {
                for stream in listener.incoming().map_while(Result::ok) {
                    if told.load(Ordering::Relaxed) {
                        return;
                    }
                    let root = root.clone();
                    // A client that hangs up is no matter.
                    let serve = move || drop(serve(stream, &root));
                    std::thread::Builder::new().name("http-client".into()).spawn(serve).unwrap();
                }
            })
            .unwrap();
        Self { dir, address, stop, thread: Some(thread) }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn url(&self, name: &str) -> String {
        format!("http://{}/{name}", self.address)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ = TcpStream::connect(self.address);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn serve(mut stream: TcpStream, root: &Path) -> std::io::Result<()> {
    stream.set_read_timeout(Some(Duration::from_secs(20)))?;
    let mut lines = BufReader::new(stream.try_clone()?).lines();
    let request = lines.next().unwrap_or_else(|| Ok(String::new()))?;
    let mut from = 0;
    for line in lines.map_while(Result::ok).take_while(|line| !line.is_empty()) {
        if let Some(range) = line.to_ascii_lowercase().strip_prefix("range: bytes=") {
            from = range.split('-').next().and_then(|n| n.parse().ok()).unwrap_or(0);
        }
    }
    let name = request.split(' ').nth(1).unwrap_or("/").trim_start_matches('/').to_owned();
    let Ok(bytes) = std::fs::read(root.join(&name)) else {
        return stream.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    };
    if name.ends_with(".endless") {
        stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Type: video/mp2t\r\nConnection: close\r\n\r\n")?;
        return stream.write_all(&bytes);
    }
    let (total, body) = (bytes.len(), &bytes[from.min(bytes.len())..]);
    let status = if from > 0 { "206 Partial Content" } else { "200 OK" };
    write!(
        stream,
        "HTTP/1.1 {status}\r\nContent-Length: {}\r\nContent-Range: bytes {from}-{}/{total}\r\n\
         Accept-Ranges: bytes\r\nConnection: close\r\n\r\n",
        body.len(),
        total.saturating_sub(1)
    )?;
    stream.write_all(body)
}
