//! The byte stream of a serial port or an slcan client: a pseudoterminal, a serial device or a TCP connection. Also
//! accepts TCP clients.

use std::io;
use std::time::Duration as StdDuration;

use rustix::io::ioctl_fionread;
use tokio::net::{TcpListener, TcpStream};
use tracing::warn;

use super::bind::HostPort;
use super::exchange::PortTx;
use crate::tcp_options;
use crate::timer::now;
use crate::tty::Tty;

/// A connected device or client of any of the three kinds.
pub(super) trait ByteStream {
    /// Whether bytes that cannot be written at once are lost, as on a line, instead of waiting.
    const LOSSY: bool;
    /// Whether the kernel may deliver received bytes late unless they are requested.
    const LATE: bool = false;

    /// Waits for bytes. Cancel safe.
    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize>;
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize>;
    async fn writable(&self) -> io::Result<()>;
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize>;

    /// Whether the system holds unread bytes, even if the runtime does not know of them yet; `true` if the system does
    /// not say.
    fn has_unread(&self) -> bool;

    /// Drops bytes that have arrived and were not read, if the system can.
    fn discard_unread(&self) {}

    /// Whether the device has not yet sent all written bytes.
    fn is_draining(&self) -> bool {
        false
    }

    /// Whether a client can receive.
    fn has_client(&self) -> bool {
        true
    }

    /// Whether a client may have left bytes unread. If so, `has_client` must be called from time to time to drop them.
    fn may_hold_unread(&self) -> bool {
        false
    }
}

impl ByteStream for Tty {
    const LOSSY: bool = false;

    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize> {
        Self::receive(self, buf).await
    }
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        Self::try_read(self, buf)
    }
    async fn writable(&self) -> io::Result<()> {
        // A frame usually fits the system's buffer; if not, the buffer empties at the baud rate.
        tokio::time::sleep(StdDuration::from_millis(1)).await;
        Ok(())
    }
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        Self::try_write(self, bytes)
    }
    fn has_unread(&self) -> bool {
        Self::has_unread(self)
    }
    fn discard_unread(&self) {
        Self::discard_unread(self);
    }
    fn is_draining(&self) -> bool {
        Self::is_draining(self)
    }
}

impl ByteStream for TcpStream {
    const LOSSY: bool = false;

    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize> {
        read_ready(|| self.readable(), || self.try_read(buf)).await
    }
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        Self::try_read(self, buf)
    }
    async fn writable(&self) -> io::Result<()> {
        Self::writable(self).await
    }
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        Self::try_write(self, bytes)
    }
    fn has_unread(&self) -> bool {
        ioctl_fionread(self) != Ok(0)
    }
}

/// Reads as soon as bytes are available. Cancel safe, as `readable` is.
pub(super) async fn read_ready(
    readable: impl AsyncFn() -> io::Result<()>,
    mut try_read: impl FnMut() -> io::Result<usize>,
) -> io::Result<usize> {
    loop {
        readable().await?;
        match try_read() {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            read => return read,
        }
    }
}

/// Listens at `at`, with limited buffers for each client: data that waits in the kernel becomes old, and nothing counts
/// it.
pub(super) async fn listen(at: &HostPort) -> io::Result<TcpListener> {
    let listener = TcpListener::bind((at.host.as_str(), at.port)).await;
    let listener = listener.map_err(|error| io::Error::new(error.kind(), format!("{at}: {error}")))?;
    tcp_options::limit_buffers(&listener);
    Ok(listener)
}

/// The address of a listening socket, as text; empty if the system does not say.
pub(super) fn address_of(listener: &TcpListener) -> String {
    listener.local_addr().map_or_else(|_| String::new(), |at| at.to_string())
}

/// The address of a client, as text; empty if it has gone.
pub(super) fn peer_of(stream: &TcpStream) -> String {
    stream.peer_addr().map_or_else(|_| String::new(), |at| at.to_string())
}

/// Accepts one client. Waits out errors of the system, such as too few descriptors.
pub(super) async fn accept(listener: &TcpListener, tx: &PortTx) -> (TcpStream, std::net::SocketAddr) {
    let failed = |error: &io::Error| {
        tx.count(|counters| counters.accept_failures += 1);
        if let Some(more) = tx.log_limit.allow(now()) {
            warn!(%error, more, "cannot accept a client");
        }
    };
    tcp_options::accept(listener, failed).await
}
