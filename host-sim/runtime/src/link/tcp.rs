//! Links over TCP.
//!
//! A connection reports what the kernel has accepted and what the peer has acknowledged. However the connection ends,
//! data that was not acknowledged by then is never delivered.

use std::io;
use std::net::IpAddr;
use std::pin::pin;
use std::time::Duration;

use rustix::io::Errno;
use rustix::net::{SocketFlags, acceptfrom_with};
use tokio::io::AsyncReadExt;
use tokio::net::tcp::{ReadHalf, WriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, sleep};
use tracing::info;

use super::outbox::DirectSocket;
use super::{Lent, LinkEvent, LinkSession, LinkTask, Refusals};
use recipe_io::connect::connect;
use recipe_io::fairness::yield_fairly;
use recipe_io::tcp_options;

impl LinkTask<'_> {
    pub(super) async fn connect_tcp(
        &self,
        session: LinkSession,
        host: &str,
        port: u16,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let Some(mut stream) = self.while_open(session, connect((host, port))).await? else { return Ok(()) };
        let (connection, reader) = LinkConnection::new(self, session, &mut stream)?;
        connection.carry(reader, None, events).await
    }

    /// Accepts the next connection of the controller's client.
    pub(super) async fn accept_tcp(
        &self,
        session: LinkSession,
        listener: &TcpListener,
        controller: &str,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let accepted = self.while_open(session, self.accept(session, listener, controller)).await?;
        let Some((mut stream, known)) = accepted else { return Ok(()) };
        let (connection, reader) = LinkConnection::new(self, session, &mut stream)?;
        connection.carry(reader, Some((listener, &known)), events).await
    }

    /// The next connection of the controller, and the controller's addresses.
    async fn accept(
        &self,
        session: LinkSession,
        listener: &TcpListener,
        controller: &str,
    ) -> io::Result<(TcpStream, Vec<IpAddr>)> {
        let (known, is_late) = self.look_up(session, controller).await?;
        if is_late {
            self.refuse_waiting(listener, &known).await;
        }
        loop {
            let (stream, peer) = listener.accept().await?;
            if self.control.is_controller(self.name, &known, peer) {
                info!(link = self.name, %peer, "the controller connected");
                return Ok((stream, known));
            }
            drop(stream);
            yield_fairly().await;
        }
    }

    /// Closes connections that waited while the link was closed, because the age of their data is unknown. A
    /// client that still runs connects again.
    async fn refuse_waiting(&self, listener: &TcpListener, known: &[IpAddr]) {
        for nth in 1..=MAX_WAITING {
            // A system call, because the reactor may not have polled the socket yet.
            let (stream, peer) = match acceptfrom_with(listener, SocketFlags::CLOEXEC) {
                Ok((stream, peer)) => (stream, peer.and_then(|peer| peer.try_into().ok())),
                Err(Errno::CONNABORTED | Errno::INTR) => continue,
                Err(_) => return,
            };
            drop(stream);
            if let Some(peer) = peer
                && self.control.is_controller(self.name, known, peer)
            {
                let count = |refusals: &mut Refusals| refusals.refused += 1;
                self.control.refuse(self.name, peer, "the link is closed", count);
            }
            // Yields only after several: a client that reconnects at once must not be closed again.
            if nth.is_multiple_of(CLOSED_AT_ONCE) {
                yield_fairly().await;
            }
        }
    }

    /// Refuses further clients of a listening link: one connection carries one recipe.
    async fn refuse_others(&self, others: Option<(&TcpListener, &[IpAddr])>) {
        let Some((listener, known)) = others else { return std::future::pending().await };
        loop {
            // It is closed at once, so failures are ignored.
            let (stream, peer) = tcp_options::accept(listener, |_| {}).await;
            drop(stream);
            if self.control.is_controller(self.name, known, peer) {
                let count = |refusals: &mut Refusals| refusals.refused += 1;
                self.control.refuse(self.name, peer, "there is already a connection", count);
            }
            yield_fairly().await;
        }
    }
}

/// A connection of one session.
struct LinkConnection<'a> {
    link: &'a LinkTask<'a>,
    session: LinkSession,
    writer: WriteHalf<'a>,
    /// Allows direct writes while this task waits.
    _lent: Lent<'a>,
    /// Number of bytes that the peer is known to have acknowledged.
    acked: u64,
    watch: AckWatch,
    reads: u64,
}

/// How acknowledgements are monitored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AckWatch {
    /// Not monitored, and the kernel has no time limit either.
    Off,
    /// Some acknowledgements are missing; they are polled.
    Missing,
    /// None has been missing for less than [`QUIET`]. The kernel keeps its time limit; otherwise a transmission every
    /// few milliseconds would set and remove it each time.
    Quiet,
}

impl<'a> LinkConnection<'a> {
    fn new(
        link: &'a LinkTask<'a>,
        session: LinkSession,
        stream: &'a mut TcpStream,
    ) -> io::Result<(Self, ReadHalf<'a>)> {
        tcp_options::reset_on_close(stream)?;
        tcp_options::enable_keepalive(stream);
        let lent = link.control.lend(DirectSocket::new(stream, None)?);
        let (reader, writer) = stream.split();
        let own = Self { link, session, writer, _lent: lent, acked: 0, watch: AckWatch::Off, reads: 0 };
        Ok((own, reader))
    }

    /// Moves bytes in both directions until the peer closes, an error, or the end of the session.
    async fn carry(
        mut self,
        mut reader: ReadHalf<'_>,
        others: Option<(&TcpListener, &[IpAddr])>,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        events(LinkEvent::Up);
        let changed = &self.link.control.changed;
        let mut refusing = pin!(self.link.refuse_others(others));
        let mut poll = pin!(sleep(ACK_POLL));
        let mut chunk = vec![0; CHUNK];
        while !self.is_over() {
            self.write(events)?;
            if self.is_over() {
                break;
            }
            match (self.watch, self.is_outstanding()) {
                (AckWatch::Off | AckWatch::Quiet, true) => {
                    if self.watch == AckWatch::Off {
                        tcp_options::set_user_timeout(self.writer.as_ref(), USER_TIMEOUT);
                    }
                    self.watch = AckWatch::Missing;
                    poll.as_mut().reset(Instant::now() + ACK_POLL);
                }
                (AckWatch::Missing, false) => {
                    self.watch = AckWatch::Quiet;
                    poll.as_mut().reset(Instant::now() + QUIET);
                }
                _ => {}
            }
            tokio::select! {
                read = reader.read(&mut chunk) => match read? {
                    0 => return Ok(()),
                    len => self.take(&chunk[..len], events).await?,
                },
                ready = self.writer.writable(), if self.link.control.waiting() > 0 => ready?,
                () = changed.notified() => {}
                () = &mut poll, if self.watch != AckWatch::Off => if self.watch == AckWatch::Missing {
                    self.poll_acked(events)?;
                    poll.as_mut().reset(Instant::now() + ACK_POLL);
                } else {
                    self.watch = AckWatch::Off;
                    tcp_options::clear_user_timeout(self.writer.as_ref());
                },
                () = &mut refusing => {}
            }
        }
        Ok(())
    }

    fn is_over(&self) -> bool {
        self.link.control.is_over(self.session)
    }

    /// Reports received bytes, after the acknowledgements before them.
    async fn take(&mut self, bytes: &[u8], events: &mut impl FnMut(LinkEvent<'_>)) -> io::Result<()> {
        self.poll_acked(events)?;
        if self.is_over() {
            return Ok(());
        }
        events(LinkEvent::Bytes(bytes));
        self.reads += 1;
        if bytes.len() == CHUNK || self.reads.is_multiple_of(READS_AT_ONCE) {
            // The engine's answers are sent before other tasks run.
            self.write(events)?;
            yield_fairly().await;
        }
        Ok(())
    }

    /// Writes as much as the system accepts.
    fn write(&mut self, events: &mut impl FnMut(LinkEvent<'_>)) -> io::Result<()> {
        while !self.is_over() && self.link.control.flush(|bytes| self.writer.try_write(bytes))? {
            events(LinkEvent::Sent);
        }
        Ok(())
    }

    /// Whether sent bytes are not known to be acknowledged.
    fn is_outstanding(&self) -> bool {
        self.link.control.sent.get() != self.acked
    }

    /// Reports new acknowledgements.
    fn poll_acked(&mut self, events: &mut impl FnMut(LinkEvent<'_>)) -> io::Result<()> {
        if self.is_over() || !self.is_outstanding() {
            return Ok(());
        }
        let control = self.link.control;
        let left = tcp_options::unacknowledged(self.writer.as_ref())? + control.waiting();
        let acked = control.sent.get().saturating_sub(left as u64);
        if acked != self.acked {
            self.acked = acked;
            events(LinkEvent::Acked(u32::try_from(left).unwrap_or(u32::MAX)));
        }
        Ok(())
    }
}

/// Interval at which acknowledgements are polled, while some are missing.
const ACK_POLL: Duration = Duration::from_millis(10);
/// After this time without acknowledgement the kernel ends the connection, in case this process cannot.
const USER_TIMEOUT: Duration = Duration::from_secs(2);
const CHUNK: usize = 2_048;
/// Time without missing acknowledgements after which the kernel's time limit is removed. Far below the time of the
/// first keepalive probe, whose loss would end the connection while the limit is set.
const QUIET: Duration = Duration::from_millis(100);
/// Number of reads before other tasks run.
const READS_AT_ONCE: u64 = 16;
/// More than the backlog of a listening socket: connections after these are not old.
const MAX_WAITING: usize = 2_048;
/// Number of connections closed before other tasks run.
const CLOSED_AT_ONCE: usize = 16;

#[cfg(test)]
#[path = "tcp_tests.rs"]
mod tests;
