//! A link's send queue, with direct access to its socket.
//!
//! Bytes are written to the socket at once, because waking the link's task takes longer than the engine needs for a
//! field frame. The task does the rest: it reports completed transmissions, and sends what the kernel did not accept.

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{SendFlags, send, sendto};

/// A duplicate of the socket's descriptor; the link's task owns the original.
#[derive(Debug)]
pub(super) struct DirectSocket {
    socket: OwnedFd,
    /// The receiver of datagrams, if the socket is not connected.
    peer: Option<SocketAddr>,
}

impl DirectSocket {
    /// Sends to `peer`, or to the connected peer if `None`.
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

/// Transmissions that the kernel has not accepted yet.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    /// The first entry may be the rest of a partly accepted transmission.
    queue: VecDeque<Vec<u8>>,
    /// `None` if the session has no socket yet.
    socket: Option<DirectSocket>,
    is_sent: bool,
    failed: Option<Errno>,
}

/// The engine has one transmission in flight at a time, so a working link never reaches this.
const MAX_QUEUED: usize = 8;

impl Outbox {
    /// Enables direct writes to this socket.
    pub(super) fn open(&mut self, socket: DirectSocket) {
        self.socket = Some(socket);
    }

    pub(super) fn close(&mut self) {
        self.socket = None;
    }

    /// Datagrams go to this peer from now on.
    pub(super) fn answer(&mut self, peer: SocketAddr) {
        if let Some(socket) = &mut self.socket {
            socket.peer = Some(peer);
        }
    }

    /// Accepts a transmission; false if too many are queued.
    pub(super) fn take(&mut self, bytes: &[u8]) -> bool {
        let mut rest = bytes;
        if self.queue.is_empty()
            && self.failed.is_none()
            && let Some(socket) = &self.socket
        {
            match socket.send(bytes) {
                Ok(len) => rest = bytes.get(len..).unwrap_or_default(),
                Err(Errno::AGAIN | Errno::INTR) => {}
                // A socket reports an error only once; keep it for the task, which ends the session.
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

    /// Writes queued bytes. True if the queue is empty and something was accepted since this last returned true.
    ///
    /// # Errors
    /// That of `write` or of an earlier transmission, except `WouldBlock`.
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
