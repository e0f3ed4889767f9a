//! Requests, WebSockets and gRPC to a running server, over a real connection: whatever comes, the answer is no error of the
//! server's own.

#[path = "../../tests/api/support.rs"]
mod support;

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::OnceLock;
use std::time::Duration;

use gakp::api::RIGHTS;
use support::Server;
use tokio::runtime::Runtime;

/// Streams have no end; this much of the silence of one is enough.
const SILENCE: Duration = Duration::from_millis(5);

fn server() -> SocketAddr {
    static SERVER: OnceLock<(Runtime, Server)> = OnceLock::new();
    let (_, server) = SERVER.get_or_init(|| {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.expect("a runtime");
        let server = runtime.block_on(Server::start());
        server.cameras.put("gate", "rtsp://192.0.2.1/live");
        (runtime, server)
    });
    server.addr
}

/// The first byte says what of: raw bytes, a request to a known path, a WebSocket, HTTP/2.
pub fn requests(data: &[u8]) {
    let Some((kind, data)) = data.split_first() else { return };
    let address = server();
    let raw = match kind % 4 {
        0 => data.to_vec(),
        1 => request(data),
        2 => {
            let (query, frames) = halves(data);
            let path = ["/v1/tracks", "/v1/events/live", "/v1/cameras/gate/live"][usize::from(*kind / 4) % 3];
            let mut raw = format!(
                "GET {path}?{} HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
                 Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n",
                escaped(query)
            )
            .into_bytes();
            raw.extend(frames);
            raw
        }
        _ => [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", data].concat(),
    };
    let answer = talk(address, &raw);
    let failed = answer.starts_with(b"HTTP/1.1 5") || answer.starts_with(b"HTTP/1.0 5");
    // There is no history here: 503 says so.
    let known = answer.get(9..12) == Some(b"503");
    assert!(!failed || known, "{:?} is answered {:?}", Lossy(&raw), Lossy(&answer));
}

struct Lossy<'a>(&'a [u8]);

impl std::fmt::Debug for Lossy<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        String::from_utf8_lossy(self.0).fmt(f)
    }
}

/// One of the routes; then, with a zero byte in between, its names, query and body.
fn request(data: &[u8]) -> Vec<u8> {
    let Some((which, data)) = data.split_first() else { return vec![] };
    let (method, path, _) = RIGHTS[usize::from(*which) % RIGHTS.len()];
    let (name, rest) = halves(data);
    let (query, body) = halves(rest);
    let name = if name.is_empty() { "gate".into() } else { escaped(name) };
    let mut path = path.to_owned();
    while let (Some(begin), Some(end)) = (path.find('{'), path.find('}')) {
        path.replace_range(begin..=end, &name);
    }
    let head = format!(
        "{method} {path}?{} HTTP/1.0\r\nHost: {}\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n",
        escaped(query),
        server(),
        body.len()
    );
    [head.as_bytes(), body].concat()
}

/// At the first zero byte.
fn halves(data: &[u8]) -> (&[u8], &[u8]) {
    let middle = data.iter().position(|&byte| byte == 0);
    middle.map_or((data, &[]), |at| (&data[..at], &data[at + 1..]))
}

/// What a request line takes; the rest percent-encoded.
fn escaped(bytes: &[u8]) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"=&-_.~%+:,".contains(&byte);
    let one = |&byte: &u8| if plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") };
    bytes.iter().map(one).collect()
}

/// What is answered until the server falls silent or hangs up.
fn talk(address: SocketAddr, raw: &[u8]) -> Vec<u8> {
    let mut stream = TcpStream::connect(address).expect("the server is there");
    stream.set_read_timeout(Some(Duration::from_secs(5))).expect("a time out");
    // A server that has seen enough hangs up.
    let _ = stream.write_all(raw);
    let _ = stream.shutdown(Shutdown::Write);
    let (mut answer, mut chunk) = (vec![], [0; 4096]);
    while let Ok(n @ 1..) = stream.read(&mut chunk) {
        answer.extend_from_slice(&chunk[..n]);
        if answer.len() > 1 << 16 {
            break;
        }
        stream.set_read_timeout(Some(SILENCE)).expect("a time out");
    }
    answer
}
