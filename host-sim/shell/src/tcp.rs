//! One TCP connection: bytes are sent at once where the transport takes them, and kept, up to a bound,
//! where it does not.

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

use recipe_net::timer::now;
use recipe_net::turns::give_way;

/// The sending side of a connection.
#[derive(Debug)]
pub(super) struct Connection {
    write: OwnedWriteHalf,
    out: RefCell<Vec<u8>>,
    blocked_since: Cell<Option<Instant>>,
    end: Cell<End>,
    /// Of the task that runs it; one task does, so this is cheaper than a [`tokio::sync::Notify`].
    runner: RefCell<Option<Waker>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// Not yet.
    Open,
    /// When everything has been sent.
    Flush,
    /// Now.
    Abort,
}

/// What became of bytes to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// The transport took all of them.
    All,
    /// Some are kept; [`Event::Drained`] tells when they are gone.
    Later,
    /// The connection has failed, or the peer has left more unread than is kept.
    Failed,
}

/// What a connection did.
#[derive(Debug)]
pub(super) enum Event<'a> {
    /// Bytes arrived.
    Bytes(&'a [u8]),
    /// What was kept is gone.
    Drained,
}

impl Connection {
    /// Splits a connected stream into what sends and what [`Connection::run`] reads from.
    pub(super) fn split(stream: TcpStream) -> (Rc<Self>, OwnedReadHalf) {
        let (read, write) = stream.into_split();
        let connection = Self {
            write,
            out: RefCell::default(),
            blocked_since: Cell::new(None),
            end: Cell::new(End::Open),
            runner: RefCell::default(),
        };
        (Rc::new(connection), read)
    }

    /// Sends bytes; at most [`MAX_KEPT`] are kept.
    pub(super) fn send(&self, bytes: &[u8]) -> Taken {
        if self.end.get() != End::Open {
            return Taken::Failed;
        }
        let mut out = self.out.borrow_mut();
        let mut rest = bytes;
        while out.is_empty() && !rest.is_empty() {
            match self.write.try_write(rest) {
                Ok(count) => rest = &rest[count..],
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(_) => {
                    self.abort();
                    return Taken::Failed;
                }
            }
        }
        if rest.is_empty() {
            return Taken::All;
        }
        if out.len() + rest.len() > MAX_KEPT {
            self.abort();
            return Taken::Failed;
        }
        if out.is_empty() {
            self.blocked_since.set(Some(now()));
            self.wake();
        }
        out.extend_from_slice(rest);
        Taken::Later
    }

    /// Since when bytes have been kept, if any are.
    pub(super) fn blocked_since(&self) -> Option<Instant> {
        self.blocked_since.get()
    }

    /// Closes when everything has been sent, or the peer takes nothing for [`LINGER`].
    pub(super) fn close(&self) {
        if self.end.get() == End::Open {
            self.end.set(End::Flush);
            self.wake();
        }
    }

    /// Closes at once.
    pub(super) fn abort(&self) {
        self.end.set(End::Abort);
        self.wake();
    }

    /// Whether bytes are kept.
    pub(super) fn has_kept(&self) -> bool {
        !self.out.borrow().is_empty()
    }

    /// Whether it was closed from this side.
    pub(super) fn is_closed(&self) -> bool {
        self.end.get() != End::Open
    }

    /// Reads and sends until either side closes. While bytes are kept nothing more is read: who does
    /// not take answers gets to ask no more.
    pub(super) async fn run(
        &self,
        mut read: OwnedReadHalf,
        mut event: impl FnMut(Event<'_>),
    ) -> io::Result<()> {
        let mut buf = [0; CHUNK];
        loop {
            match self.end.get() {
                End::Open => {}
                End::Abort => return Ok(()),
                End::Flush => return self.linger().await,
            }
            if self.out.borrow().is_empty() {
                match poll_fn(|cx| self.poll_received(cx, &mut read, &mut buf)).await {
                    None => {}
                    Some(received) => match received? {
                        0 => return Ok(()),
                        count => {
                            event(Event::Bytes(&buf[..count]));
                            if count == CHUNK {
                                give_way().await;
                            }
                        }
                    },
                }
            } else {
                poll_fn(|cx| self.poll_room(cx)).await?;
                self.flush()?;
                if self.out.borrow().is_empty() {
                    event(Event::Drained);
                }
            }
        }
    }

    /// Bytes, or `None` when there is something else to do first.
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

    /// Room to send in, or a reason to look at the end.
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
                    // Progress starts the peer's patience anew.
                    self.blocked_since.set(Some(now()));
                    return Ok(());
                }
                Err(error) => return Err(error),
            }
        }
        // What was once needed for a slow peer is not held for ever.
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

/// Most bytes read at once: their requests are carried out before anybody else has a turn. The longest
/// Modbus request.
const CHUNK: usize = 260;
/// Most bytes kept for a peer that does not take them. More than one read's requests are answered with.
const MAX_KEPT: usize = 64 * 1_024;
/// How long a closed connection may take to send what it has.
const LINGER: std::time::Duration = std::time::Duration::from_secs(2);
