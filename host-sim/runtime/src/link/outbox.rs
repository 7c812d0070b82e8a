//! What a link has to send, and a short socket to its socket.
//!
//! Between a field frame and its request should be as little as possible: a task that is woken and looks at all it waits
//! for takes longer than the engine. So what is handed over goes to the socket at once. The link's task has the rest of
//! the work: it reports what was sent, and sends what the system did not take.

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{SendFlags, send, sendto};

/// A socket of its own descriptor, because a task has the other one.
#[derive(Debug)]
pub(super) struct DirectSocket {
    socket: OwnedFd,
    /// The receiver of datagrams, if the socket is not connected.
    peer: Option<SocketAddr>,
}

impl DirectSocket {
    /// To `peer`, or to where the socket is connected.
    pub(super) fn new(socket: &impl AsFd, peer: Option<SocketAddr>) -> io::Result<Self> {
        Ok(Self { socket: rustix::io::fcntl_dupfd_cloexec(socket, 0)?, peer })
    }

    fn send(&self, bytes: &[u8]) -> Result<usize, Errno> {
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        match &self.peer {
            None => send(&self.socket, bytes, flags),
            Some(peer) => sendto(&self.socket, bytes, flags, peer),
        }
    }
}

/// Transmissions that were handed over and that the system has not accepted.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    /// The first one is what is left of a transmission that the system has taken a part of.
    queue: VecDeque<Vec<u8>>,
    /// `None` if the session has no socket yet.
    socket: Option<DirectSocket>,
    /// The system has accepted a transmission, and that is not reported yet.
    is_sent: bool,
    failed: Option<Errno>,
}

/// The engine has one transmission in flight at a time, so a working link never reaches this.
const MAX_QUEUED: usize = 8;

impl Outbox {
    /// Transmissions may go to this socket at once.
    pub(super) fn open(&mut self, socket: DirectSocket) {
        self.socket = Some(socket);
    }

    /// They may not any more.
    pub(super) fn close(&mut self) {
        self.socket = None;
    }

    /// Datagrams go to this peer from now on.
    pub(super) fn answer(&mut self, peer: SocketAddr) {
        if let Some(socket) = &mut self.socket {
            socket.peer = Some(peer);
        }
    }

    /// Takes a transmission; false if too many wait.
    pub(super) fn take(&mut self, bytes: &[u8]) -> bool {
        let mut rest = bytes;
        if self.queue.is_empty()
            && self.failed.is_none()
            && let Some(socket) = &self.socket
        {
            match socket.send(bytes) {
                Ok(len) => rest = bytes.get(len..).unwrap_or_default(),
                Err(Errno::AGAIN | Errno::INTR) => {}
                // A socket tells an error once. The task that ends the session has to know it.
                Err(error) => self.failed = Some(error),
            }
        }
        if rest.is_empty() {
            self.is_sent = true;
            return true;
        }
        let has_room = self.queue.len() < MAX_QUEUED;
        if has_room {
            self.queue.push_back(rest.to_vec());
        }
        has_room
    }

    /// Writes what waits. True if now nothing does, and something was accepted since this was last said.
    ///
    /// # Errors
    /// That of `write`, or of an earlier transmission; it is not an error if the system takes nothing at the moment.
    pub(super) fn flush(&mut self, mut write: impl FnMut(&[u8]) -> io::Result<usize>) -> io::Result<bool> {
        if let Some(error) = self.failed.take() {
            return Err(error.into());
        }
        while let Some(first) = self.queue.front_mut() {
            match write(first) {
                Ok(len) if len < first.len() => drop(first.drain(..len)),
                Ok(_) => {
                    self.queue.pop_front();
                    self.is_sent = true;
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(false),
                Err(error) => return Err(error),
            }
        }
        Ok(std::mem::take(&mut self.is_sent))
    }

    /// Number of bytes that the system has not accepted.
    pub(super) fn waiting(&self) -> usize {
        self.queue.iter().map(Vec::len).sum()
    }
}
