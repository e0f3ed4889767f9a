//! The TCP connections that GStreamer holds to a camera, so that they can be cut.
//!
//! rtspsrc shows nobody its socket, and in the middle of a message it stops for nobody (see [`super::knock`]). So its
//! socket is looked for among this process's own at the moment when it is about to send its first request: then it is
//! there for certain, and if it is the only one that is new, no other camera's connection can be meant, however many
//! cameras one recorder has behind the same address.

use std::collections::BTreeSet;
use std::net::{Shutdown, SocketAddr};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gstreamer as gst;
use gstreamer::prelude::*;
use socket2::Socket;

/// Sockets that have an owner, by their inode.
static OWNED: Mutex<BTreeSet<u64>> = Mutex::new(BTreeSet::new());

/// The connection of one source.
#[derive(Debug)]
pub(crate) struct Line(Mutex<State>);

#[derive(Debug)]
enum State {
    /// Nothing was sent yet. To whom it will be, and the sockets to them that are another's.
    Before { peers: Vec<SocketAddr>, others: BTreeSet<u64> },
    /// Its socket; `None` where another source was connecting at the same time.
    Sent(Option<Owned>),
}

/// A socket that nobody takes for his own.
#[derive(Debug)]
pub(crate) struct Owned {
    socket: Option<Socket>,
    inode: u64,
}

impl Owned {
    /// Someone else closes it; until this is dropped it is known whose it is.
    pub fn mark(socket: &impl AsRawFd) -> Option<Self> {
        let inode = inode_of(socket.as_raw_fd())?;
        lock(&OWNED).insert(inode);
        Some(Self { socket: None, inode })
    }
}

impl Drop for Owned {
    fn drop(&mut self) {
        lock(&OWNED).remove(&self.inode);
    }
}

impl Line {
    /// Looks for the connection when rtspsrc, which has none yet, sends the first request to one of `peers`.
    pub fn of(source: &gst::Element, peers: Vec<SocketAddr>) -> Arc<Self> {
        let line = Arc::new(Self::before(peers));
        let finds = line.clone();
        source.connect("before-send", false, move |_| {
            finds.find();
            // The request is to be sent.
            Some(true.to_value())
        });
        line
    }

    fn before(peers: Vec<SocketAddr>) -> Self {
        let others = connections(&peers).into_iter().map(|(inode, _)| inode).collect();
        Self(Mutex::new(State::Before { peers, others }))
    }

    /// Ends the connection, whatever GStreamer does with it.
    pub fn cut(&self) {
        if let State::Sent(Some(Owned { socket: Some(socket), .. })) = &*lock(&self.0) {
            // Gone already, perhaps.
            let _ = socket.shutdown(Shutdown::Both);
        }
    }

    fn find(&self) {
        let mut state = lock(&self.0);
        let State::Before { peers, others } = &*state else { return };
        let mut owned = lock(&OWNED);
        let mut found = connections(peers);
        found.retain(|(inode, _)| !others.contains(inode) && !owned.contains(inode));
        // Where there are two, another source is about to find its own.
        let its = if found.len() == 1 { found.pop() } else { None };
        *state = State::Sent(its.map(|(inode, socket)| {
            owned.insert(inode);
            Owned { socket: Some(socket), inode }
        }));
    }
}

/// This process's connections to one of `peers`, duplicated.
fn connections(peers: &[SocketAddr]) -> Vec<(u64, Socket)> {
    let open = std::fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
    let numbers = open.filter_map(|entry| entry.file_name().to_str()?.parse::<RawFd>().ok());
    numbers
        .filter_map(|number| {
            let inode = inode_of(number)?;
            let socket = duplicate(number)?;
            // It may have been closed, and its number given to another, since it was looked at.
            let same = inode_of(socket.as_raw_fd()) == Some(inode);
            let peer = socket.peer_addr().ok()?.as_socket()?;
            (same && peers.contains(&peer)).then_some((inode, socket))
        })
        .collect()
}

/// Of a socket; nothing else is meant.
fn inode_of(number: RawFd) -> Option<u64> {
    let target = std::fs::read_link(format!("/proc/self/fd/{number}")).ok()?;
    target.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?.parse().ok()
}

fn duplicate(number: RawFd) -> Option<Socket> {
    // SAFETY: takes a number and gives a new descriptor or -1, whether or not the number is in use.
    let copy = unsafe { libc::fcntl(number, libc::F_DUPFD_CLOEXEC, 0) };
    // SAFETY: it was opened just now, for us alone.
    (copy >= 0).then(|| Socket::from(unsafe { OwnedFd::from_raw_fd(copy) }))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::io::{ErrorKind, Read};
    use std::net::{TcpListener, TcpStream};

    use super::*;

    #[test]
    fn finds_the_one_that_is_new_and_cuts_no_other() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let peers = vec![listener.local_addr().unwrap()];
        let connect = || (TcpStream::connect(peers[0]).unwrap(), listener.accept().unwrap().0);
        let is_open = |(stream, _): &mut (TcpStream, TcpStream)| {
            stream.set_nonblocking(true).unwrap();
            stream.read(&mut [0]).is_err_and(|error| error.kind() == ErrorKind::WouldBlock)
        };
        let found = |line: &Line| matches!(&*lock(&line.0), State::Sent(Some(_)));
        let mut healthy = connect();

        // A camera of the same recorder, whose connection comes and goes.
        let astray = Line::before(peers.clone());
        let mut its = connect();
        astray.find();
        assert!(found(&astray));
        astray.cut();
        assert!(!is_open(&mut its) && is_open(&mut healthy));
        drop((astray, its));

        // Two at the same time: either could be it, also when one of them has gone.
        let lines = [(); 2].map(|()| Line::before(peers.clone()));
        let (mut one, two) = (connect(), connect());
        lines.iter().for_each(Line::find);
        drop(two);
        lines.iter().for_each(Line::find);
        lines.iter().for_each(Line::cut);
        assert!(!lines.iter().any(found) && is_open(&mut one) && is_open(&mut healthy));

        // A connection that has an owner is nobody else's.
        let line = Line::before(peers.clone());
        let (mut knock, mut its) = (connect(), connect());
        let _mark = Owned::mark(&knock.0).unwrap();
        line.find();
        line.cut();
        assert!(is_open(&mut knock) && !is_open(&mut its) && is_open(&mut one));
    }
}
