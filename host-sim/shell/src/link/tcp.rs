//! Links over TCP.
//!
//! Handed over is not delivered: beside what the system has taken, a connection reports what the peer's
//! system has acknowledged. However it ends, what was not acknowledged by then is never delivered.

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

use super::{Link, LinkEvent, Turn, TurnedAway};
use recipe_net::connect::connect;
use recipe_net::peer;
use recipe_net::turns::give_way;

impl Link<'_> {
    /// A connection to the controller's server.
    pub(super) async fn connect_tcp(
        &self,
        turn: Turn,
        host: &str,
        port: u16,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let Some(mut stream) = self.while_open(turn, connect((host, port))).await? else { return Ok(()) };
        let (connection, reader) = Connection::new(self, turn, &mut stream)?;
        connection.carry(reader, None, events).await
    }

    /// The next connection of the controller's client.
    pub(super) async fn accept_tcp(
        &self,
        turn: Turn,
        listener: &TcpListener,
        controller: &str,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let accepted = self.while_open(turn, self.accept(turn, listener, controller)).await?;
        let Some((mut stream, known)) = accepted else { return Ok(()) };
        let (connection, reader) = Connection::new(self, turn, &mut stream)?;
        connection.carry(reader, Some((listener, &known)), events).await
    }

    /// The next connection of the controller, and its addresses.
    async fn accept(
        &self,
        turn: Turn,
        listener: &TcpListener,
        controller: &str,
    ) -> io::Result<(TcpStream, Vec<IpAddr>)> {
        let (known, is_late) = self.look_up(turn, controller).await?;
        if is_late {
            self.turn_away_waiting(listener, &known).await;
        }
        loop {
            let (stream, peer) = listener.accept().await?;
            if self.control.knows(self.name, &known, peer) {
                info!(link = self.name, %peer, "the controller connected");
                return Ok((stream, known));
            }
            drop(stream);
            give_way().await;
        }
    }

    /// Ends the connections that were made while nobody took them, and with them what was sent there: its
    /// age is not known. Who still wants to be connected tries again.
    async fn turn_away_waiting(&self, listener: &TcpListener, known: &[IpAddr]) {
        for nth in 1..=MOST_WAITING {
            // Asked of the system, since the reactor may not have looked yet.
            let (stream, peer) = match acceptfrom_with(listener, SocketFlags::CLOEXEC) {
                Ok((stream, peer)) => (stream, peer.and_then(|peer| peer.try_into().ok())),
                Err(Errno::CONNABORTED | Errno::INTR) => continue,
                Err(_) => return,
            };
            drop(stream);
            if let Some(peer) = peer
                && self.control.knows(self.name, known, peer)
            {
                let count = |turned_away: &mut TurnedAway| turned_away.refused += 1;
                self.control.turn_away(self.name, peer, "the link is closed", count);
            }
            // Not each time: who comes back at once comes in time.
            if nth.is_multiple_of(ENDED_AT_ONCE) {
                give_way().await;
            }
        }
    }

    /// A second client of a listening link is turned away: one connection carries one recipe.
    async fn refuse_others(&self, others: Option<(&TcpListener, &[IpAddr])>) {
        let Some((listener, known)) = others else { return std::future::pending().await };
        loop {
            match listener.accept().await {
                Ok((stream, peer)) => {
                    drop(stream);
                    if self.control.knows(self.name, known, peer) {
                        let count = |turned_away: &mut TurnedAway| turned_away.refused += 1;
                        self.control.turn_away(self.name, peer, "there is already a connection", count);
                    }
                    give_way().await;
                }
                // Out of descriptors, most likely: they come back when connections end.
                Err(_) => sleep(Duration::from_millis(100)).await,
            }
        }
    }
}

/// A connection while its turn lasts.
struct Connection<'a> {
    link: &'a Link<'a>,
    turn: Turn,
    writer: WriteHalf<'a>,
    /// What the system has not taken of the transmission under way.
    unwritten: Vec<u8>,
    /// How many of the bytes handed over the peer is known to have acknowledged.
    acked: u64,
    /// Whether that is looked at again and again, since some are not.
    is_watched: bool,
    reads: u64,
}

impl<'a> Connection<'a> {
    fn new(link: &'a Link<'a>, turn: Turn, stream: &'a mut TcpStream) -> io::Result<(Self, ReadHalf<'a>)> {
        peer::abandon_at_end(stream)?;
        peer::watch(stream);
        let (reader, writer) = stream.split();
        let own = Self { link, turn, writer, unwritten: Vec::new(), acked: 0, is_watched: false, reads: 0 };
        Ok((own, reader))
    }

    /// Moves bytes both ways until the peer closes, an error, or the turn is over.
    async fn carry(
        mut self,
        mut reader: ReadHalf<'_>,
        others: Option<(&TcpListener, &[IpAddr])>,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        events(LinkEvent::Up);
        let changed = &self.link.control.changed;
        let mut refusing = pin!(self.link.refuse_others(others));
        let mut look = pin!(sleep(LOOK));
        let mut chunk = vec![0; CHUNK];
        while !self.is_over() {
            self.write(events)?;
            if self.is_over() {
                break;
            }
            if self.is_outstanding() && !self.is_watched {
                self.is_watched = true;
                peer::give_up_after(self.writer.as_ref(), PATIENCE);
                look.as_mut().reset(Instant::now() + LOOK);
            }
            tokio::select! {
                read = reader.read(&mut chunk) => match read? {
                    0 => return Ok(()),
                    len => self.take(&chunk[..len], events).await?,
                },
                ready = self.writer.writable(), if !self.unwritten.is_empty() => ready?,
                () = changed.notified() => {}
                () = &mut look, if self.is_watched => {
                    self.look(events)?;
                    self.is_watched = self.is_outstanding();
                    if self.is_watched {
                        look.as_mut().reset(Instant::now() + LOOK);
                    } else {
                        peer::be_patient(self.writer.as_ref());
                    }
                }
                () = &mut refusing => {}
            }
        }
        Ok(())
    }

    fn is_over(&self) -> bool {
        self.link.control.is_over(self.turn)
    }

    /// Bytes that arrived; what was acknowledged before them is told first.
    async fn take(&mut self, bytes: &[u8], events: &mut impl FnMut(LinkEvent<'_>)) -> io::Result<()> {
        self.look(events)?;
        if self.is_over() {
            return Ok(());
        }
        events(LinkEvent::Bytes(bytes));
        self.reads += 1;
        if bytes.len() == CHUNK || self.reads.is_multiple_of(READS_AT_ONCE) {
            // What the engine answered goes before the others have their turn.
            self.write(events)?;
            give_way().await;
        }
        Ok(())
    }

    /// Gives the system what it takes.
    fn write(&mut self, events: &mut impl FnMut(LinkEvent<'_>)) -> io::Result<()> {
        while !self.is_over() {
            if self.unwritten.is_empty() {
                match self.link.control.next() {
                    Some(bytes) => self.unwritten = bytes,
                    None => return Ok(()),
                }
            }
            match self.writer.try_write(&self.unwritten) {
                Ok(len) => drop(self.unwritten.drain(..len)),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(()),
                Err(error) => return Err(error),
            }
            if self.unwritten.is_empty() && self.link.control.waiting() == 0 {
                events(LinkEvent::Sent);
            }
        }
        Ok(())
    }

    /// Whether something that was handed over is not known to be acknowledged.
    fn is_outstanding(&self) -> bool {
        self.link.control.handed.get() != self.acked
    }

    /// Tells how much the peer has acknowledged, if that has changed.
    fn look(&mut self, events: &mut impl FnMut(LinkEvent<'_>)) -> io::Result<()> {
        if self.is_over() || !self.is_outstanding() {
            return Ok(());
        }
        let control = self.link.control;
        let left = peer::unacknowledged(self.writer.as_ref())? + self.unwritten.len() + control.waiting();
        let acked = control.handed.get().saturating_sub(left as u64);
        if acked != self.acked {
            self.acked = acked;
            events(LinkEvent::Acked(u32::try_from(left).unwrap_or(u32::MAX)));
        }
        Ok(())
    }
}

/// Between two looks at what is acknowledged, while something is not.
const LOOK: Duration = Duration::from_millis(10);
/// After this the system itself ends a connection whose peer acknowledges nothing, should this process be
/// kept from it.
const PATIENCE: Duration = Duration::from_secs(2);
/// Most bytes read at once.
const CHUNK: usize = 2_048;
/// Most reads before the others have a turn.
const READS_AT_ONCE: u64 = 16;
/// Our listening sockets let fewer wait: those behind them are not old.
const MOST_WAITING: usize = 2_048;
/// Connections turned away before the others have a turn.
const ENDED_AT_ONCE: usize = 16;

#[cfg(test)]
#[path = "tcp_tests.rs"]
mod tests;
