//! A TCP connection of the simulated controller. Bytes are sent at once as far as the socket accepts them;
//! the rest waits, up to a bound.

use std::cell::{Cell, RefCell};
use std::future::poll_fn;
use std::io;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};

use proto_core::time::Instant;
use tokio::io::{AsyncRead, ReadBuf};
use tokio::net::TcpStream;
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};

use recipe_io::fairness::yield_fairly;
use recipe_io::timer::now;

#[derive(Debug)]
pub(super) struct Connection {
    write: OwnedWriteHalf,
    out: RefCell<Vec<u8>>,
    blocked_since: Cell<Option<Instant>>,
    end: Cell<ConnectionEnd>,
    /// Waker of the only task in [`Connection::run`]; cheaper than a [`tokio::sync::Notify`].
    runner: RefCell<Option<Waker>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ConnectionEnd {
    Open,
    /// Close when everything was sent.
    Flush,
    Abort,
}

/// The result of [`Connection::send`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Accepted {
    /// The socket accepted all bytes.
    All,
    /// Some wait; [`ConnectionEvent::Drained`] reports when they were sent.
    Later,
    Failed,
}

#[derive(Debug)]
pub(super) enum ConnectionEvent<'a> {
    /// Bytes arrived.
    Bytes(&'a [u8]),
    /// No bytes wait any more.
    Drained,
}

impl Connection {
    /// Splits a connected stream into the sending side and the side that [`Connection::run`] reads from.
    pub(super) fn split(stream: TcpStream) -> (Rc<Self>, OwnedReadHalf) {
        let (read, write) = stream.into_split();
        let connection = Self {
            write,
            out: RefCell::default(),
            blocked_since: Cell::new(None),
            end: Cell::new(ConnectionEnd::Open),
            runner: RefCell::default(),
        };
        (Rc::new(connection), read)
    }

    /// Sends bytes; at most [`MAX_UNSENT`] wait.
    pub(super) fn send(&self, bytes: &[u8]) -> Accepted {
        if self.end.get() != ConnectionEnd::Open {
            return Accepted::Failed;
        }
        let mut out = self.out.borrow_mut();
        let mut rest = bytes;
        while out.is_empty() && !rest.is_empty() {
            match self.write.try_write(rest) {
                Ok(count) => rest = &rest[count..],
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(_) => {
                    self.abort();
                    return Accepted::Failed;
                }
            }
        }
        if rest.is_empty() {
            return Accepted::All;
        }
        if out.len() + rest.len() > MAX_UNSENT {
            self.abort();
            return Accepted::Failed;
        }
        if out.is_empty() {
            self.blocked_since.set(Some(now()));
            self.wake();
        }
        out.extend_from_slice(rest);
        Accepted::Later
    }

    /// Since when the socket has accepted none of the waiting bytes; `None` if none wait.
    pub(super) fn blocked_since(&self) -> Option<Instant> {
        self.blocked_since.get()
    }

    /// Closes when everything was sent, but after [`LINGER`] at the latest.
    pub(super) fn close(&self) {
        if self.end.get() == ConnectionEnd::Open {
            self.end.set(ConnectionEnd::Flush);
            self.wake();
        }
    }

    pub(super) fn abort(&self) {
        self.end.set(ConnectionEnd::Abort);
        self.wake();
    }

    /// Whether bytes wait.
    pub(super) fn has_unsent(&self) -> bool {
        !self.out.borrow().is_empty()
    }

    pub(super) fn is_closed(&self) -> bool {
        self.end.get() != ConnectionEnd::Open
    }

    /// Reads and sends until either side closes. While bytes wait, nothing is read: a client that does not
    /// read its answers cannot send more requests.
    pub(super) async fn run(
        &self,
        mut read: OwnedReadHalf,
        mut event: impl FnMut(ConnectionEvent<'_>),
    ) -> io::Result<()> {
        let mut buf = [0; CHUNK];
        loop {
            match self.end.get() {
                ConnectionEnd::Open => {}
                ConnectionEnd::Abort => return Ok(()),
                ConnectionEnd::Flush => return self.linger().await,
            }
            if self.out.borrow().is_empty() {
                match poll_fn(|cx| self.poll_received(cx, &mut read, &mut buf)).await {
                    None => {}
                    Some(received) => match received? {
                        0 => return Ok(()),
                        count => {
                            event(ConnectionEvent::Bytes(&buf[..count]));
                            if count == CHUNK {
                                yield_fairly().await;
                            }
                        }
                    },
                }
            } else {
                poll_fn(|cx| self.poll_room(cx)).await?;
                self.flush()?;
                if self.out.borrow().is_empty() {
                    event(ConnectionEvent::Drained);
                }
            }
        }
    }

    /// Received bytes, or `None` if there is something else to do first.
    fn poll_received(
        &self,
        cx: &mut Context<'_>,
        read: &mut OwnedReadHalf,
        buf: &mut [u8],
    ) -> Poll<Option<io::Result<usize>>> {
        if self.is_closed() || !self.out.borrow().is_empty() {
            return Poll::Ready(None);
        }
        let mut buf = ReadBuf::new(buf);
        match Pin::new(read).poll_read(cx, &mut buf) {
            Poll::Ready(done) => Poll::Ready(Some(done.map(|()| buf.filled().len()))),
            Poll::Pending => {
                self.wake_me(cx);
                Poll::Pending
            }
        }
    }

    /// Ready when there is room to send, or the connection was closed.
    fn poll_room(&self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.is_closed() {
            return Poll::Ready(Ok(()));
        }
        self.wake_me(cx);
        self.write.as_ref().poll_write_ready(cx)
    }

    fn wake_me(&self, cx: &Context<'_>) {
        let mut runner = self.runner.borrow_mut();
        if !runner.as_ref().is_some_and(|runner| runner.will_wake(cx.waker())) {
            *runner = Some(cx.waker().clone());
        }
    }

    fn wake(&self) {
        if let Some(runner) = self.runner.borrow().as_ref() {
            runner.wake_by_ref();
        }
    }

    fn flush(&self) -> io::Result<()> {
        let mut out = self.out.borrow_mut();
        while !out.is_empty() {
            match self.write.try_write(&out) {
                Ok(count) => drop(out.drain(..count)),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    // The peer has read something.
                    self.blocked_since.set(Some(now()));
                    return Ok(());
                }
                Err(error) => return Err(error),
            }
        }
        // Releases the memory that a slow peer needed.
        *out = Vec::new();
        self.blocked_since.set(None);
        Ok(())
    }

    async fn linger(&self) -> io::Result<()> {
        let flushed = async {
            while !self.out.borrow().is_empty() {
                self.write.writable().await?;
                self.flush()?;
            }
            Ok(())
        };
        tokio::time::timeout(LINGER, flushed).await.unwrap_or(Ok(()))
    }
}

/// Maximum number of bytes per read, which is the longest Modbus request. Its requests are executed before other tasks
/// run.
const CHUNK: usize = 260;
/// Maximum number of bytes that wait for a peer; more than the answers to the requests of one read.
const MAX_UNSENT: usize = 64 * 1_024;
/// How long a closed connection may take to send the rest.
const LINGER: std::time::Duration = std::time::Duration::from_secs(2);
