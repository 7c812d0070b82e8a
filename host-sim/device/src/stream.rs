//! Byte streams that a line or an slcan client is connected by: a pseudoterminal, a serial device, a TCP
//! connection; and how TCP clients are taken.

use std::cell::RefCell;
use std::future::poll_fn;
use std::io;
use std::pin::Pin;
use std::time::Duration as StdDuration;

use tokio::io::{AsyncRead, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio_serial::{ClearBuffer, SerialPort, SerialStream};
use tracing::warn;

use super::exchange::PortTx;
use super::pty::Pty;
use recipe_net::timer::now;

/// A connected device or client: what tells the three kinds apart while bytes flow.
pub(super) trait ByteStream {
    /// Whether what cannot be written at once is lost, as on a wire, instead of waiting.
    const LOSSY: bool;

    /// Waits for bytes. Cancel safe.
    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize>;
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize>;
    async fn writable(&self) -> io::Result<()>;
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize>;

    /// Throws away what has arrived and was not read, if the system can.
    fn discard_unread(&self) {}

    /// Whether the device still holds bytes that were written.
    fn is_draining(&self) -> bool {
        false
    }

    /// Whether anybody listens.
    fn is_heard(&self) -> bool {
        true
    }

    /// Whether `is_heard` should be asked now and then, even if nothing is to be sent.
    fn may_be_stale(&self) -> bool {
        false
    }
}

impl ByteStream for Pty {
    const LOSSY: bool = true;

    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize> {
        loop {
            self.readable().await?;
            match self.try_read(buf) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                read => return read,
            }
        }
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
    fn discard_unread(&self) {
        Self::discard_unread(self);
    }
    fn is_heard(&self) -> bool {
        Self::is_heard(self)
    }
    fn may_be_stale(&self) -> bool {
        Self::may_be_stale(self)
    }
}

impl ByteStream for RefCell<SerialStream> {
    const LOSSY: bool = false;

    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize> {
        // The stream's own `readable` and `try_read` never take the readiness back.
        let mut buf = ReadBuf::new(buf);
        poll_fn(|cx| Pin::new(&mut *self.borrow_mut()).poll_read(cx, &mut buf)).await?;
        Ok(buf.filled().len())
    }
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        self.borrow_mut().try_read(buf)
    }
    async fn writable(&self) -> io::Result<()> {
        // A frame fits the system's buffer; when it does not, it empties at the line's speed.
        tokio::time::sleep(StdDuration::from_millis(1)).await;
        Ok(())
    }
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        self.borrow_mut().try_write(bytes)
    }
    fn discard_unread(&self) {
        let _ = self.borrow().clear(ClearBuffer::Input);
    }
    fn is_draining(&self) -> bool {
        self.borrow().bytes_to_write().is_ok_and(|left| left > 0)
    }
}

impl ByteStream for TcpStream {
    const LOSSY: bool = false;

    async fn receive(&self, buf: &mut [u8]) -> io::Result<usize> {
        loop {
            self.readable().await?;
            match self.try_read(buf) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                read => return read,
            }
        }
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
}

/// Accepts one client, waiting out what is wrong with the system for the moment.
pub(super) async fn accept(listener: &TcpListener, tx: &PortTx) -> (TcpStream, std::net::SocketAddr) {
    loop {
        match listener.accept().await {
            Ok(accepted) => return accepted,
            Err(error) => {
                tx.count(|counters| counters.accept_failures += 1);
                if let Some(more) = tx.complaints.take(now()) {
                    warn!(%error, more, "cannot accept a client");
                }
                tokio::time::sleep(StdDuration::from_millis(50)).await;
            }
        }
    }
}
