//! A knock at a camera's door before GStreamer goes in: who does not answer sensibly costs no pipeline.
//!
//! GStreamer reads a header to its end, however long it is, and cannot be stopped meanwhile (1.22, its
//! `gst_rtsp_connection_receive`); and of a refused or unreachable host it says the same as of any other error.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use super::failure::{Failure, RTSP_TIMEOUT};
use super::line::Owned;

/// No sensible answer to OPTIONS is longer.
const MOST: usize = 16 << 10;

/// Whom to ask.
#[derive(Clone, Debug)]
pub(crate) struct Door {
    pub host: String,
    pub port: u16,
    /// What OPTIONS is asked of, without a login; `None` where the talk is encrypted, and connecting has to do.
    pub uri: Option<String>,
}

/// Connects and asks an RTSP server for OPTIONS (RFC 2326, section 10.1), for 4 s at most; name resolution takes the
/// time that it takes. Any RTSP answer will do, also a refusal. Gives the addresses of the host.
pub(crate) fn knock(door: &Door) -> Result<Vec<SocketAddr>, Failure> {
    let addresses = (door.host.as_str(), door.port).to_socket_addrs().map_err(|_| Failure::UnknownHost)?;
    let addresses: Vec<SocketAddr> = addresses.collect();
    let until = Instant::now() + RTSP_TIMEOUT;
    let stream = connect(&addresses, until)?;
    let _mark = Owned::mark(&stream);
    let Some(uri) = &door.uri else { return Ok(addresses) };
    let agent = concat!("gakp/", env!("CARGO_PKG_VERSION"));
    let request = format!("OPTIONS {uri} RTSP/1.0\r\nCSeq: 1\r\nUser-Agent: {agent}\r\n\r\n");
    talk(&stream, &request, until)?;
    Ok(addresses)
}

fn connect(addresses: &[SocketAddr], until: Instant) -> Result<TcpStream, Failure> {
    let mut failure = Failure::UnknownHost;
    for address in addresses {
        match connect_to(address, until) {
            Ok(stream) => return Ok(stream),
            Err(other) => failure = other,
        }
    }
    Err(failure)
}

/// Whether someone listens there.
pub(super) fn connect_to(address: &SocketAddr, until: Instant) -> Result<TcpStream, Failure> {
    TcpStream::connect_timeout(address, left(until)).map_err(|error| match error.kind() {
        ErrorKind::ConnectionRefused => Failure::Refused,
        _ => Failure::Unreachable,
    })
}

fn talk(mut stream: &TcpStream, request: &str, until: Instant) -> Result<(), Failure> {
    let failed = |error: std::io::Error| match error.kind() {
        ErrorKind::WouldBlock | ErrorKind::TimedOut => Failure::Silent(RTSP_TIMEOUT),
        _ => Failure::Disconnected,
    };
    stream.set_write_timeout(Some(left(until))).map_err(failed)?;
    stream.write_all(request.as_bytes()).map_err(failed)?;
    let (mut answer, mut chunk) = (Vec::new(), [0; 1024]);
    loop {
        stream.set_read_timeout(Some(left(until))).map_err(failed)?;
        match stream.read(&mut chunk).map_err(failed)? {
            0 => return Err(Failure::Disconnected),
            n => answer.extend_from_slice(&chunk[..n]),
        }
        let begin = b"RTSP/".len().min(answer.len());
        if answer[..begin] != b"RTSP/"[..begin] {
            return Err(Failure::Garbage("the answer is not RTSP".into()));
        }
        if answer.windows(4).any(|bytes| bytes == b"\r\n\r\n") {
            return Ok(());
        }
        if answer.len() > MOST {
            return Err(Failure::Garbage("the header of its answer has no end".into()));
        }
    }
}

/// Sockets take no time out of 0.
fn left(until: Instant) -> Duration {
    until.saturating_duration_since(Instant::now()).max(Duration::from_millis(1))
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    /// What a knock says of one who answers so and then hangs up.
    #[track_caller]
    fn check(answer: &[u8], expected: Result<(), &str>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let seen = std::thread::scope(|scope| {
            scope.spawn(|| {
                let (mut stream, _) = listener.accept().unwrap();
                let mut request = [0; 500];
                let n = stream.read(&mut request).unwrap();
                assert!(request[..n].starts_with(b"OPTIONS rtsp://x/live RTSP/1.0\r\nCSeq: 1\r\n"));
                // Who has heard enough hangs up.
                let _ = stream.write_all(answer);
            });
            let uri = Some("rtsp://x/live".to_owned());
            knock(&Door { host: "127.0.0.1".into(), port: address.port(), uri })
        });
        assert_eq!(seen.as_ref().map(|_| ()).map_err(Failure::label), expected, "{seen:?}");
    }

    #[test]
    fn any_rtsp_answer_will_do() {
        check(b"RTSP/1.0 200 OK\r\nCSeq: 1\r\nPublic: DESCRIBE\r\n\r\n", Ok(()));
        check(b"RTSP/1.0 401 Unauthorized\r\nCSeq: 1\r\n\r\n", Ok(()));
    }

    #[test]
    fn nonsense_will_not() {
        check(b"HTTP/1.1 200 OK\r\n\r\n", Err("garbage"));
        check(b"220 mail.example ESMTP\r\n", Err("garbage"));
        check(b"R", Err("disconnected"));
        check(b"", Err("disconnected"));
        check(b"RTSP/1.0 200 OK\r\n", Err("disconnected"));
        let endless = [&b"RTSP/1.0 200 OK\r\n"[..], &b"X-More: and so on\r\n".repeat(100_000)].concat();
        check(&endless, Err("garbage"));
    }

    #[test]
    fn nobody_there() {
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let door = |host: &str| Door { host: host.into(), port: free.port(), uri: None };
        assert_eq!(knock(&door("127.0.0.1")), Err(Failure::Refused));
        assert_eq!(knock(&door("no-such-host.invalid")), Err(Failure::UnknownHost));
    }
}
