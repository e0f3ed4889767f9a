//! Pictures: snapshots, MJPEG, the page's WebSocket; work only while somebody watches.

use gakp::publish::colour;
use gakp::types::{BBox, TrackId};
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;

use super::support::*;

const BOX: BBox = BBox::new(80.0, 60.0, 40.0, 100.0);

async fn gate() -> Server {
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/gate");
    server
}

fn show(server: &Server, seq: u64, size: (u32, u32)) {
    assert!(server.cameras.show(picture(tracks("gate", 1, seq, size, BOX))));
}

struct Decoded {
    size: (usize, usize),
    rgb: Vec<u8>,
}

impl Decoded {
    fn new(jpeg: &[u8]) -> Self {
        let mut decoder = JpegDecoder::new(ZCursor::new(jpeg));
        let rgb = decoder.decode().expect("a JPEG");
        Self { size: decoder.dimensions().unwrap(), rgb }
    }

    /// Whether the pixel at `(x, y)` is about `colour`: JPEG and halved chroma blur.
    fn is(&self, (x, y): (usize, usize), colour: [u8; 3]) -> bool {
        let at = (y * self.size.0 + x) * 3;
        self.rgb[at..at + 3].iter().zip(colour).all(|(a, b)| a.abs_diff(b) < 60)
    }
}

#[tokio::test]
async fn a_snapshot_shows_the_newest_picture_with_boxes_or_without() {
    let server = gate().await;
    for (seq, size, expected) in [(0, (1280, 960), (1280, 960)), (1, (3840, 2160), (1920, 1080))] {
        show(&server, seq, size);
        let annotated = server.get("/v1/cameras/gate/snapshot.jpg").await;
        assert!(annotated.head.contains("content-type: image/jpeg"), "{}", annotated.head);
        assert_eq!(Decoded::new(&annotated.body).size, expected);
        let plain = server.get("/v1/cameras/gate/snapshot.jpg?annotate=false").await;
        assert_eq!(Decoded::new(&plain.body).size, expected);
        if size == (1280, 960) {
            let (annotated, plain) = (Decoded::new(&annotated.body), Decoded::new(&plain.body));
            // The plate of id 7 above the box's upper left corner (24 by 36 pixels, the lower left of
            // the digit free); grey wall without it.
            let plate = (84, 50);
            assert!(annotated.is(plate, colour(TrackId(7))), "the plate");
            assert!(plain.is(plate, [51; 3]) && !plain.is(plate, colour(TrackId(7))), "no plate");
            assert!(
                plain.is((100, 110), [255; 3]) && annotated.is((100, 110), [255; 3]),
                "inside of the box"
            );
        }
    }
    server.stop().await;
}

/// Reads an MJPEG stream part by part.
struct Mjpeg {
    stream: TcpStream,
    buffer: Vec<u8>,
}

impl Mjpeg {
    async fn open(server: &Server, path: &str) -> Self {
        let mut this = Self { stream: server.open("GET", path, &[], b"").await, buffer: Vec::new() };
        let head = this.until(b"\r\n\r\n").await.to_ascii_lowercase();
        assert!(
            head.contains(" 200 ") && head.contains("multipart/x-mixed-replace; boundary=gakp-frame"),
            "{head}"
        );
        this
    }

    async fn more(&mut self) {
        let read = patiently("a part", self.stream.read_buf(&mut self.buffer)).await.unwrap();
        assert!(read > 0, "the stream ended");
    }

    async fn until(&mut self, end: &[u8]) -> String {
        loop {
            if let Some(at) = self.buffer.windows(end.len()).position(|w| w == end) {
                let rest = self.buffer.split_off(at + end.len());
                return String::from_utf8(std::mem::replace(&mut self.buffer, rest)).unwrap();
            }
            self.more().await;
        }
    }

    /// `seq` and JPEG of the next part.
    async fn part(&mut self) -> (u64, Vec<u8>) {
        let head = self.until(b"\r\n\r\n").await;
        assert!(head.starts_with("--gakp-frame\r\n"), "{head}");
        let number = |name: &str| -> u64 {
            let line = head.lines().find_map(|line| line.strip_prefix(name)).expect(name);
            line.trim().parse().unwrap()
        };
        let (length, seq) = (number("Content-Length:") as usize, number("X-Gakp-Seq:"));
        while self.buffer.len() < length + 2 {
            self.more().await;
        }
        let rest = self.buffer.split_off(length + 2);
        let mut jpeg = std::mem::replace(&mut self.buffer, rest);
        assert_eq!(jpeg.split_off(length), b"\r\n");
        (seq, jpeg)
    }
}

#[tokio::test]
async fn mjpeg_shows_each_new_picture_and_stops_with_its_watcher() {
    let server = gate().await;
    show(&server, 0, (1920, 1080));
    let mut first = Mjpeg::open(&server, "/v1/cameras/gate/stream.mjpeg").await;
    let mut second = Mjpeg::open(&server, "/v1/cameras/gate/stream.mjpeg").await;
    for seq in 0..4 {
        show(&server, seq, (1920, 1080));
        for stream in [&mut first, &mut second] {
            // A picture may come twice when a watcher joins, never an older one.
            let (got, jpeg) = loop {
                let (got, jpeg) = stream.part().await;
                if got >= seq {
                    break (got, jpeg);
                }
            };
            assert_eq!(got, seq);
            assert_eq!(Decoded::new(&jpeg).size, (960, 540));
        }
    }
    assert_eq!(server.cameras.watchers("gate"), 1, "two who watch the same share one encoder");
    drop(first);
    show(&server, 4, (1920, 1080));
    while second.part().await.0 < 4 {}
    drop(second);
    // No further picture comes: even so nobody goes on watching.
    eventually("the encoder to stop", || server.cameras.watchers("gate") == 0).await;
    let mut again = Mjpeg::open(&server, "/v1/cameras/gate/stream.mjpeg").await;
    assert_eq!(again.part().await.0, 4, "who comes later sees the picture that is there");
    server.stop().await;
}

#[tokio::test]
async fn the_live_socket_sends_each_picture_with_its_own_tracks() {
    let server = gate().await;
    let mut socket = server.socket("/v1/cameras/gate/live", &[]).await.ok().unwrap();
    for seq in 0..5 {
        show(&server, seq, (320, 240));
        let message = loop {
            let message = socket.binary().await;
            if header(&message)["seq"].as_u64().unwrap() >= seq {
                break message;
            }
        };
        let header = header(&message);
        assert_eq!((&header["camera"], &header["epoch"]), (&"gate".into(), &1.into()));
        assert_eq!((header["seq"].as_u64(), header["frame"].as_u64()), (Some(seq), Some(seq * 2)));
        assert_eq!(header["tracks"][0]["box"], serde_json::json!([80.0, 60.0, 40.0, 100.0]));
        let length = u32::from_be_bytes(message[..4].try_into().unwrap()) as usize;
        let decoded = Decoded::new(&message[4 + length..]);
        assert_eq!(decoded.size, (320, 240));
        assert!(decoded.is((83, 53), [51; 3]) && decoded.is((100, 110), [255; 3]), "no boxes drawn in");
    }
    server.stop().await;
}

fn header(message: &[u8]) -> serde_json::Value {
    let length = u32::from_be_bytes(message[..4].try_into().unwrap()) as usize;
    serde_json::from_slice(&message[4..4 + length]).unwrap()
}

#[tokio::test]
async fn streams_end_with_their_camera() {
    let server = gate().await;
    show(&server, 0, (320, 240));
    let mut socket = server.socket("/v1/cameras/gate/live", &[]).await.ok().unwrap();
    let mut mjpeg = Mjpeg::open(&server, "/v1/cameras/gate/stream.mjpeg").await;
    mjpeg.part().await;
    assert_eq!(server.request("DELETE", "/v1/cameras/gate", &[], b"").await.status, 204);
    assert_eq!(socket.closed().await, 1000);
    let mut rest = Vec::new();
    patiently("the MJPEG stream to end", mjpeg.stream.read_to_end(&mut rest)).await.unwrap();
    // The same name again is another camera with pictures of its own.
    server.cameras.put("gate", "rtsp://host/other");
    show(&server, 9, (320, 240));
    let mut socket = server.socket("/v1/cameras/gate/live", &[]).await.ok().unwrap();
    assert_eq!(header(&socket.binary().await)["seq"], 9);
    server.stop().await;
}

#[tokio::test]
async fn video_does_not_hold_up_the_end() {
    let server = gate().await;
    show(&server, 0, (320, 240));
    let mut mjpeg = Mjpeg::open(&server, "/v1/cameras/gate/stream.mjpeg").await;
    mjpeg.part().await;
    let mut socket = server.socket("/v1/cameras/gate/live", &[]).await.ok().unwrap();
    socket.binary().await;
    let code = tokio::spawn(async move { socket.closed().await });
    let took = server.stop().await;
    assert_eq!(code.await.unwrap(), 1001);
    assert!(took.as_secs_f64() < 2.0, "{took:?}");
}
