//! The TCP connections that GStreamer holds to a camera, so that they can be cut.
//!
//! rtspsrc shows nobody its socket, and in the middle of a message it stops for nobody (see [`super::knock`]). So its
//! socket is looked for among this process's own at the moment when it is about to send a request.

use std::collections::BTreeSet;
use std::net::{Shutdown, SocketAddr};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gstreamer as gst;
use gstreamer::prelude::*;
use socket2::Socket;

/// Sockets that have an owner, by their inode.
static OWNED: Mutex<BTreeSet<u64>> = Mutex::new(BTreeSet::new());

/// The connections of one source.
#[derive(Debug, Default)]
pub(crate) struct Line(Mutex<Vec<Owned>>);

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
    /// Looks for the connection whenever rtspsrc is about to send a request to one of `peers`.
    pub fn of(source: &gst::Element, peers: Vec<SocketAddr>) -> Arc<Self> {
        let line = Arc::new(Self::default());
        let finds = line.clone();
        source.connect("before-send", false, move |_| {
            finds.find(&peers);
            // The request is to be sent.
            Some(true.to_value())
        });
        line
    }

    /// Ends the connections, whatever GStreamer does with them.
    pub fn cut(&self) {
        for owned in lock(&self.0).drain(..) {
            // Gone already, most of the time.
            let _ = owned.socket.as_ref().map(|socket| socket.shutdown(Shutdown::Both));
        }
    }

    /// Where more than one connection could be it, another source is about to find its own: the next request tells.
    fn find(&self, peers: &[SocketAddr]) {
        let mut owned = lock(&OWNED);
        let mut found = connections(&owned, peers);
        if let (Some((inode, socket)), true) = (found.pop(), found.is_empty()) {
            owned.insert(inode);
            lock(&self.0).push(Owned { socket: Some(socket), inode });
        }
    }
}

/// This process's connections to one of `peers` that nobody owns, duplicated.
fn connections(owned: &BTreeSet<u64>, peers: &[SocketAddr]) -> Vec<(u64, Socket)> {
    let open = std::fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
    let numbers = open.filter_map(|entry| entry.file_name().to_str()?.parse::<RawFd>().ok());
    numbers
        .filter_map(|number| {
            let inode = inode_of(number).filter(|inode| !owned.contains(inode))?;
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
    use std::io::Read;
    use std::net::{TcpListener, TcpStream};

    use super::*;

    #[test]
    fn finds_the_one_that_nobody_owns_and_cuts_it() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let peers = [listener.local_addr().unwrap()];
        let connect = || (TcpStream::connect(peers[0]).unwrap(), listener.accept().unwrap().0);
        let (first, second) = (Line::default(), Line::default());
        let ((mut one, _here), (mut two, _there)) = (connect(), connect());

        // Either could be it.
        first.find(&peers);
        first.cut();
        two.set_nonblocking(true).unwrap();
        assert_eq!(two.read(&mut [0]).unwrap_err().kind(), std::io::ErrorKind::WouldBlock);

        let mark = Owned::mark(&two).unwrap();
        first.find(&peers);
        drop(mark);
        second.find(&peers);
        // It is found once only, and by one only.
        second.find(&peers);
        assert_eq!([&first, &second].map(|line| lock(&line.0).len()), [1, 1]);
        first.cut();
        assert_eq!(one.read(&mut [0]).unwrap(), 0);
        assert_eq!(two.read(&mut [0]).unwrap_err().kind(), std::io::ErrorKind::WouldBlock);
        second.cut();
        assert_eq!(two.read(&mut [0]).unwrap(), 0);
    }
}
