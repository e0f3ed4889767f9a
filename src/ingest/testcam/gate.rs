//! The way into a test camera that can go wrong: it stands between the clients and the RTSP server.

use std::io::{self, BufReader, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use super::fault::Fault;
use super::wire::{self, Piece};

/// How often the listener looks whether it is to listen.
const TICK: Duration = Duration::from_millis(5);
/// Bytes of rubbish that are sent at once, and how often.
const RUBBISH: (usize, Duration) = (16 << 10, Duration::from_millis(20));

/// A listener whose connections lead to the server, as far as the fault of the moment lets them.
pub(super) struct Gate {
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    server: SocketAddr,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    fault: Option<Fault>,
    stopped: bool,
    links: Vec<Arc<Link>>,
}

/// Both ends of a client's connection; the server's only if it leads there.
struct Link {
    client: TcpStream,
    server: Option<TcpStream>,
}

impl Link {
    fn cut(&self) {
        for end in [Some(&self.client), self.server.as_ref()].into_iter().flatten() {
            // Gone already, perhaps.
            let _ = end.shutdown(Shutdown::Both);
        }
    }
}

impl Gate {
    /// Listens for the clients of the server at `server`.
    pub fn open(listen: SocketAddr, server: SocketAddr) -> io::Result<Self> {
        let listener = TcpListener::bind(listen)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let shared = Shared { server, state: Mutex::default(), changed: Condvar::new() };
        let shared = Arc::new(shared);
        let all = shared.clone();
        let thread =
            std::thread::Builder::new().name("camera-gate".into()).spawn(move || all.listen(listener))?;
        Ok(Self { address, shared, thread: Some(thread) })
    }

    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// From now on it is this one, or none.
    pub fn set(&self, fault: Option<Fault>) {
        let mut state = self.shared.lock();
        let before = std::mem::replace(&mut state.fault, fault.filter(|fault| !fault.happens()));
        if fault.is_some_and(Fault::cuts_off) || before.is_some_and(Fault::spoils) {
            state.links.drain(..).for_each(|link| link.cut());
        }
        if fault == Some(Fault::Garbage) {
            // Over UDP the server itself says nothing for a long time.
            let mut bytes = [0; 500];
            fastrand::Rng::with_seed(3).fill(&mut bytes);
            for link in &state.links {
                // A client that is gone needs none.
                let _ = (&link.client).write_all(&bytes);
            }
        }
        drop(state);
        self.shared.changed.notify_all();
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        self.shared.lock().stopped = true;
        self.set(Some(Fault::HangUp));
        if let Some(thread) = self.thread.take() {
            // A panic there was already reported.
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    fn fault(&self) -> Option<Fault> {
        self.lock().fault
    }

    fn listen(self: Arc<Self>, listener: TcpListener) {
        let Ok(address) = listener.local_addr() else { return };
        let mut listening = Some(listener);
        while !self.lock().stopped {
            if self.fault() == Some(Fault::Refuse) {
                listening = None;
            } else if listening.is_none() {
                // The port may take a moment to be free again.
                listening = TcpListener::bind(address).ok().filter(|l| l.set_nonblocking(true).is_ok());
            }
            match listening.as_ref().map(TcpListener::accept) {
                Some(Ok((client, _))) => {
                    let all = self.clone();
                    let serve = move || {
                        if let Err(error) = all.serve(client) {
                            tracing::debug!("a client of the test camera: {error}");
                        }
                    };
                    // Without a thread the client is hung up on.
                    let _ = std::thread::Builder::new().name("camera-client".into()).spawn(serve);
                }
                _ => std::thread::sleep(TICK),
            }
        }
    }

    /// One client, to its end.
    fn serve(&self, client: TcpStream) -> io::Result<()> {
        client.set_nonblocking(false)?;
        client.set_nodelay(true)?;
        let fault = self.fault();
        let leads_in = !matches!(
            fault,
            Some(
                Fault::Refuse | Fault::HalfOpen | Fault::Unauthorized | Fault::Garbage | Fault::EndlessHeader
            )
        );
        let server = leads_in.then(|| TcpStream::connect(self.server)).transpose()?;
        if let Some(server) = &server {
            server.set_nodelay(true)?;
        }
        let link = Arc::new(Link { client, server });
        {
            let mut state = self.lock();
            if state.stopped || state.fault != fault {
                return Ok(());
            }
            state.links.push(link.clone());
        }
        let served = match fault {
            Some(Fault::HalfOpen) => {
                self.while_half_open(&link);
                Ok(())
            }
            Some(Fault::Unauthorized) => refuse_login(&link.client),
            Some(Fault::Garbage) => garbage(&link.client),
            Some(Fault::EndlessHeader) => endless_header(&link.client),
            _ => self.relay(&link),
        };
        self.lock().links.retain(|other| !Arc::ptr_eq(other, &link));
        link.cut();
        served
    }

    /// Until the fault is over or the link is no longer one of ours.
    fn while_half_open(&self, link: &Arc<Link>) {
        let waits = |state: &mut State| {
            state.fault == Some(Fault::HalfOpen) && state.links.iter().any(|other| Arc::ptr_eq(other, link))
        };
        // Either outcome ends the wait.
        drop(self.changed.wait_while(self.lock(), waits));
    }

    fn relay(&self, link: &Arc<Link>) -> io::Result<()> {
        let Some(server) = &link.server else { return Ok(()) };
        std::thread::scope(|scope| {
            let back = std::thread::Builder::new().name("camera-answers".into());
            back.spawn_scoped(scope, || {
                let relayed = self.answers(link, server, &link.client);
                link.cut();
                relayed
            })?;
            let relayed = self.requests(link, &link.client, server);
            link.cut();
            relayed
        })
    }

    fn requests(&self, link: &Arc<Link>, from: &TcpStream, mut to: &TcpStream) -> io::Result<()> {
        let mut from = BufReader::new(from);
        while let Some(piece) = wire::next(&mut from)? {
            match (self.fault(), piece) {
                (Some(Fault::HalfOpen), _) => self.while_half_open(link),
                (Some(Fault::MuteTeardown), Piece::Message(bytes)) if bytes.starts_with(b"TEARDOWN ") => {}
                (_, Piece::Message(bytes) | Piece::Packet(bytes)) => to.write_all(&bytes)?,
            }
        }
        Ok(())
    }

    fn answers(&self, link: &Arc<Link>, from: &TcpStream, mut to: &TcpStream) -> io::Result<()> {
        let (mut from, mut random) = (BufReader::new(from), fastrand::Rng::with_seed(1));
        while let Some(piece) = wire::next(&mut from)? {
            match (self.fault(), piece) {
                (Some(Fault::HalfOpen), _) => self.while_half_open(link),
                (Some(Fault::Garbage), Piece::Message(mut bytes) | Piece::Packet(mut bytes)) => {
                    random.fill(&mut bytes);
                    to.write_all(&bytes)?;
                }
                (Some(Fault::WrongCodec), Piece::Message(mut bytes)) => {
                    rename_encoding(&mut bytes);
                    to.write_all(&bytes)?;
                }
                (_, Piece::Message(bytes) | Piece::Packet(bytes)) => to.write_all(&bytes)?,
            }
        }
        Ok(())
    }
}

/// Of a session description: `a=rtpmap:96 H264/90000` becomes `a=rtpmap:96 XXXX/90000`, as long as it was.
fn rename_encoding(answer: &mut [u8]) {
    let name = b"a=rtpmap:";
    let mut at = 0;
    while let Some(found) = answer[at..].windows(name.len()).position(|bytes| bytes == name) {
        at += found + name.len();
        let rest = &mut answer[at..];
        let begin = rest.iter().position(|&byte| byte == b' ').map_or(0, |space| space + 1);
        rest[begin..].iter_mut().take_while(|byte| **byte != b'/').for_each(|byte| *byte = b'X');
    }
}

fn refuse_login(mut client: &TcpStream) -> io::Result<()> {
    let mut from = BufReader::new(client);
    while let Some(piece) = wire::next(&mut from)? {
        let Piece::Message(request) = piece else { continue };
        let number = wire::header(&request, "CSeq").unwrap_or("0");
        let challenge = "WWW-Authenticate: Digest realm=\"camera\", nonce=\"1f6a2c9e\"";
        write!(client, "RTSP/1.0 401 Unauthorized\r\nCSeq: {number}\r\n{challenge}\r\n\r\n")?;
    }
    Ok(())
}

/// Until the client has enough.
fn garbage(mut client: &TcpStream) -> io::Result<()> {
    let (mut bytes, mut random) = (vec![0; RUBBISH.0], fastrand::Rng::with_seed(2));
    loop {
        random.fill(&mut bytes);
        client.write_all(&bytes)?;
        std::thread::sleep(RUBBISH.1);
    }
}

/// Until the client has enough.
fn endless_header(mut client: &TcpStream) -> io::Result<()> {
    let mut from = BufReader::new(client);
    while let Some(piece) = wire::next(&mut from)? {
        let Piece::Message(request) = piece else { continue };
        let number = wire::header(&request, "CSeq").unwrap_or("0");
        write!(client, "RTSP/1.0 200 OK\r\nCSeq: {number}\r\n")?;
        if request.starts_with(b"OPTIONS ") {
            write!(client, "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n\r\n")?;
            continue;
        }
        let lines =
            "X-More: and so on, and so on, and so on, and so on, and so on\r\n".repeat(RUBBISH.0 / 63);
        loop {
            client.write_all(lines.as_bytes())?;
            std::thread::sleep(RUBBISH.1);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_encoding_gets_a_name_that_nobody_knows() {
        let mut answer =
            b"RTSP/1.0 200 OK\r\n\r\nm=video 0 RTP/AVP 96\r\na=rtpmap:96 H265/90000\r\n".to_vec();
        rename_encoding(&mut answer);
        let text = String::from_utf8(answer).unwrap();
        assert!(text.ends_with("\r\n\r\nm=video 0 RTP/AVP 96\r\na=rtpmap:96 XXXX/90000\r\n"), "{text}");
        rename_encoding(&mut b"a=rtpmap:".to_vec());
    }
}
