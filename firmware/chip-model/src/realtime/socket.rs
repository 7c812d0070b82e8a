//! Non-blocking sockets that clients connect to as devices, with a buffer for unsent bytes.

use std::io;
use std::net::TcpListener;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};

use rustix::event::{PollFd, PollFlags};

/// Bytes buffered for a client that does not read; more are lost, as on a line.
const MAX_UNSENT: usize = 1 << 20;

/// A listening socket: `HOST:PORT`, or a path.
#[derive(Debug)]
pub(super) struct Listener {
    fd: OwnedFd,
    path: Option<PathBuf>,
}

impl Listener {
    /// Listens.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub(super) fn new(place: &str) -> Result<Self, String> {
        let listener = if place.contains(':') && !place.contains('/') {
            TcpListener::bind(place).and_then(|listener| {
                listener.set_nonblocking(true)?;
                Ok(Self { fd: listener.into(), path: None })
            })
        } else {
            UnixListener::bind(place).and_then(|listener| {
                listener.set_nonblocking(true)?;
                Ok(Self { fd: listener.into(), path: Some(Path::new(place).to_owned()) })
            })
        };
        listener.map_err(|error| format!("{place}: {error}"))
    }

    /// The next client that has connected.
    pub(super) fn accept(&self) -> Option<Client> {
        use rustix::net::SocketFlags;
        let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
        let fd = rustix::net::accept_with(&self.fd, flags).ok()?;
        let _ = rustix::net::sockopt::set_tcp_nodelay(&fd, true);
        Some(Client::new(fd))
    }

    pub(super) fn poll(&self) -> PollFd<'_> {
        PollFd::new(&self.fd, PollFlags::IN)
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        if let Some(path) = &self.path {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// A non-blocking connection.
#[derive(Debug)]
pub(super) struct Client {
    fd: OwnedFd,
    unsent: Vec<u8>,
    is_gone: bool,
}

impl Client {
    /// A client on a non-blocking socket.
    pub(super) fn new(fd: OwnedFd) -> Self {
        Self { fd, unsent: Vec::new(), is_gone: false }
    }

    /// Whether the peer has closed it.
    pub(super) fn is_gone(&self) -> bool {
        self.is_gone
    }

    /// Reads what has arrived, at most `most` bytes.
    pub(super) fn read(&mut self, most: usize) -> Vec<u8> {
        let mut bytes = vec![0; most];
        let len = match rustix::io::read(&self.fd, &mut bytes) {
            Ok(0) if most > 0 => {
                self.is_gone = true;
                0
            }
            Ok(len) => len,
            Err(error) => {
                self.is_gone |= !is_for_later(error);
                0
            }
        };
        bytes.truncate(len);
        bytes
    }

    /// Whether a write fits into the queue.
    pub(super) fn has_room(&self) -> bool {
        self.unsent.len() < MAX_UNSENT
    }

    /// Writes; bytes that the socket does not accept now are queued.
    pub(super) fn write(&mut self, bytes: &[u8]) {
        if self.has_room() {
            self.unsent.extend_from_slice(bytes);
        }
        self.flush();
    }

    /// Writes queued bytes.
    pub(super) fn flush(&mut self) {
        while !self.unsent.is_empty() && !self.is_gone {
            match rustix::net::send(&self.fd, &self.unsent, rustix::net::SendFlags::NOSIGNAL) {
                Ok(len) => drop(self.unsent.drain(..len)),
                Err(error) if is_for_later(error) => return,
                Err(_) => self.is_gone = true,
            }
        }
    }

    pub(super) fn poll(&self, reads: bool) -> PollFd<'_> {
        let mut flags = if reads { PollFlags::IN } else { PollFlags::empty() };
        if !self.unsent.is_empty() {
            flags |= PollFlags::OUT;
        }
        PollFd::new(&self.fd, flags)
    }
}

impl AsFd for Client {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

fn is_for_later(error: rustix::io::Errno) -> bool {
    matches!(io::Error::from(error).kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted)
}
