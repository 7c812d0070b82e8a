//! A master and its line (docs/wire/modbus-rtu.md sections 4 and 5).
//!
//! In: a table of exchanges, received bytes, values to write, the time. Out: requests, the data of
//! replies, failures. Does not know what values mean.

use heapless::Vec;

use super::super::Exception;
use super::adu::{BROADCAST, MAX_ADU};
use super::exchange::{Exchange, TableError, When};
use super::operation::{Expected, Reply};
use super::receiver::{Found, Receiver};
use super::{Echo, Timing};
use crate::schedule::{Peer, Presence, Row, Taken, Turns};
use crate::time::{Duration, Instant};

/// A master with room for `N` exchanges.
///
/// To be called: [`Self::received`] with bytes, [`Self::request`] when something is to be asked at
/// once, and after each of them, and when [`Self::deadline`] has come, [`Self::poll`] until it
/// returns `None`. One request is on the line at a time. Polling early is harmless.
#[derive(Debug, Clone)]
pub struct Master<const N: usize> {
    timing: Timing,
    echo: Echo,
    table: Vec<Exchange, N>,
    /// Addresses and counters, in the order of the peers.
    slaves: Vec<Slave, { super::MAX_SLAVES + 1 }>,
    rows: Vec<Row, N>,
    peers: Vec<Peer, { super::MAX_SLAVES + 1 }>,
    run: u8,
    phase: Phase,
    receiver: Receiver,
    /// End of the newest own frame.
    sent: Instant,
    /// The newest byte.
    heard: Instant,
    /// The first byte since the line was silent.
    burst: Instant,
    deadline: Instant,
}

#[derive(Debug, Clone)]
struct Slave {
    address: u8,
    counters: SlaveCounters,
}

/// What the line is used for.
#[derive(Debug, Clone, Copy)]
enum Phase {
    Idle,
    /// A request is to be repeated.
    Repeat(Flight),
    /// The reply is awaited.
    Waiting(Flight),
    /// A broadcast was sent; the slaves have time until then.
    Turnaround {
        exchange: usize,
        until: Instant,
    },
}

/// A request on its way.
#[derive(Debug, Clone, Copy)]
struct Flight {
    exchange: usize,
    taken: Taken,
    /// Repetitions so far.
    repeated: u8,
    /// One of the requests had no reply in time.
    timed_out: bool,
    /// [`Receiver::stray`] when it was sent.
    stray: u32,
    until: Instant,
}

/// What a master wants or tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Output<'a> {
    /// Send so many bytes from the front of the buffer, now.
    Send(usize),
    /// The slave has done what was asked.
    Reply {
        /// The exchange, counted from 0.
        exchange: usize,
        /// Its data.
        reply: Reply<'a>,
    },
    /// A broadcast was sent, and the slaves had their time for it.
    Broadcast {
        /// The exchange, counted from 0.
        exchange: usize,
    },
    /// The slave refuses the request, or did not answer it properly, however often it was asked.
    Failed {
        /// The exchange, counted from 0.
        exchange: usize,
        /// Why.
        failure: Failure,
    },
}

/// Why a request failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Failure {
    /// No reply in time.
    Timeout,
    /// A reply with a wrong CRC.
    Checksum,
    /// The slave refuses the request. It is up, and the request is not repeated.
    Exception(Exception),
}

/// Counters of a slave since the start; they stop at their end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SlaveCounters {
    /// Requests that were sent, with repetitions.
    pub requests: u32,
    /// Good replies.
    pub replies: u32,
    /// Requests without any reply in time.
    pub timeouts: u32,
    /// Requests whose reply had a wrong CRC.
    pub checksums: u32,
    /// Refused requests.
    pub exceptions: u32,
    /// The newest refusal.
    pub newest_exception: Option<Exception>,
    /// Whole frames with the slave's address and the function, and other data than asked for.
    pub mismatched: u32,
    /// Repetitions.
    pub retries: u32,
    /// Times at which an exchange had nothing to send yet.
    pub unprepared: u32,
}

/// What a master knows of a slave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct SlaveStatus {
    /// Its address.
    pub address: u8,
    /// Whether it answers; [`Presence::Unknown`] for the broadcast.
    pub presence: Presence,
    /// Its counters.
    pub counters: SlaveCounters,
    /// Periods that went by while it was not down, because the line had too much to do.
    pub missed_periods: u32,
}

impl<const N: usize> Master<N> {
    /// A master that begins at `now` with the exchanges of `table`, which keep their numbers.
    ///
    /// # Errors
    /// More exchanges than `N`, more than 32 slaves, a row that cannot be asked.
    pub fn new(timing: Timing, echo: Echo, table: &[Exchange], now: Instant) -> Result<Self, TableError> {
        let no_room = TableError::TooManyExchanges { needed: table.len(), available: N };
        let mut master = Self {
            timing,
            echo,
            table: Vec::from_slice(table).map_err(|_| no_room)?,
            slaves: Vec::new(),
            rows: Vec::new(),
            peers: Vec::new(),
            run: 0,
            phase: Phase::Idle,
            receiver: Receiver::new(),
            sent: now,
            heard: now,
            burst: now,
            deadline: now,
        };
        for (nth, exchange) in table.iter().enumerate() {
            exchange.check(nth)?;
            let peer = master.peer(exchange.slave).ok_or(TableError::TooManySlaves)?;
            let cost = master.cost(exchange);
            let When { every, start } = exchange.when;
            let row = Row::new(peer, (every, start), (cost, exchange.timeout), now);
            master.rows.push(row).map_err(|_| no_room)?;
        }
        Ok(master)
    }

    /// Takes bytes that came from the line by `now`. Bytes are to be handed over before the line's
    /// silence has passed after them, or what they belong to is taken for two frames.
    pub fn received(&mut self, bytes: &[u8], now: Instant) {
        if bytes.is_empty() {
            return;
        }
        let began = now - self.timing.of(bytes.len());
        if began >= self.heard + self.timing.silence() {
            self.end_burst();
            self.burst = began;
        }
        self.heard = now;
        self.receiver.take(bytes);
        self.deadline = now;
    }

    /// Asks an exchange as soon as the line is free, because its values have changed or a command
    /// wants it. A request for an exchange that is already requested changes nothing; one for an
    /// exchange that is on the line has it asked once more. False if there is no such exchange.
    pub fn request(&mut self, exchange: usize, now: Instant) -> bool {
        if matches!(self.phase, Phase::Idle) {
            self.deadline = self.deadline.min(now);
        }
        self.turns().request(exchange, now)
    }

    /// The next thing to do or to know; `None` if there is nothing until [`Self::deadline`].
    ///
    /// `values` writes the data of an exchange, whose number it gets, into a slice of zeros of
    /// [`Operation::written_len`](super::Operation::written_len), and returns false if it has none
    /// yet: the exchange is not asked then until its next period or request. It is called for each
    /// request that writes, just before it is sent, and again for a repetition.
    pub fn poll(
        &mut self,
        now: Instant,
        mut values: impl FnMut(usize, &mut [u8]) -> bool,
        out: &mut [u8; MAX_ADU],
    ) -> Option<Output<'_>> {
        if self.receiver.in_burst() && now >= self.heard + self.timing.silence() {
            self.end_burst();
        }
        if let Phase::Waiting(flight) = self.phase {
            match self.receiver.found() {
                Some(Found::Reply { at, len }) => return Some(self.answered(flight, at, len, now)),
                Some(Found::Refused(exception)) => return Some(self.refused(flight, exception, now)),
                None => {}
            }
            let Some(failure) = self.failure(flight, now) else {
                self.deadline = self.waiting_deadline(flight);
                return None;
            };
            if let Some(failed) = self.failed(flight, failure, now) {
                return Some(failed);
            }
        }
        if let Phase::Turnaround { exchange, until } = self.phase {
            if now < until {
                self.deadline = until;
                return None;
            }
            self.phase = Phase::Idle;
            return Some(Output::Broadcast { exchange });
        }
        let free = self.free_at();
        if now < free {
            self.deadline = free;
            return None;
        }
        self.next_request(now, &mut values, out).map(Output::Send)
    }

    /// When to call [`Self::poll`] at the latest, after it has returned `None`.
    pub const fn deadline(&self) -> Instant {
        self.deadline
    }

    /// The slaves of the table in its order; among them 0 if there is a broadcast.
    pub fn slaves(&self) -> impl ExactSizeIterator<Item = SlaveStatus> {
        self.slaves.iter().enumerate().map(|(peer, slave)| SlaveStatus {
            address: slave.address,
            presence: self.presence(peer),
            counters: slave.counters,
            missed_periods: self.peers.get(peer).map_or(0, Peer::missed),
        })
    }

    /// Received bytes that belong to no reply that was awaited: late replies, noise, echoes that
    /// were not expected.
    pub const fn stray_bytes(&self) -> u32 {
        self.receiver.stray()
    }

    fn turns(&mut self) -> Turns<'_> {
        Turns { rows: &mut self.rows, peers: &mut self.peers, run: &mut self.run }
    }

    fn presence(&self, peer: usize) -> Presence {
        self.peers.get(peer).map_or(Presence::Unknown, Peer::presence)
    }

    /// The peer with this address, new if there is none yet.
    fn peer(&mut self, address: u8) -> Option<u8> {
        if let Some(at) = self.slaves.iter().position(|slave| slave.address == address) {
            return Some(at as u8);
        }
        self.slaves.push(Slave { address, counters: SlaveCounters::default() }).ok()?;
        let is_broadcast = usize::from(self.slaves.iter().any(|slave| slave.address == BROADCAST));
        if self.slaves.len().saturating_sub(is_broadcast) > super::MAX_SLAVES {
            return None;
        }
        self.peers.push(Peer::NEW).ok()?;
        Some(self.peers.len().saturating_sub(1) as u8)
    }

    /// How long an exchange has the line if no reply comes.
    fn cost(&self, exchange: &Exchange) -> Duration {
        let request = self.timing.of(exchange.operation.request_len());
        request + exchange.timeout + self.timing.silence()
    }

    /// The first instant at which a request may be sent. A line that is never silent is sent on
    /// nevertheless after twice the longest frame: so what it makes of requests is counted.
    fn free_at(&self) -> Instant {
        let noise = self.burst + self.timing.of(2 * MAX_ADU);
        (self.heard.min(noise).max(self.sent)) + self.timing.silence()
    }

    fn next_request(
        &mut self,
        now: Instant,
        values: &mut impl FnMut(usize, &mut [u8]) -> bool,
        out: &mut [u8; MAX_ADU],
    ) -> Option<usize> {
        if let Phase::Repeat(flight) = self.phase {
            self.phase = Phase::Idle;
            if let Some(len) = self.send(flight, now, values, out) {
                return Some(len);
            }
        }
        // Each exchange that has no values yet is passed over once.
        for _ in 0..=self.table.len() {
            let exchange = match self.turns().choose(now) {
                Ok(exchange) => exchange,
                Err(later) => {
                    self.deadline = later;
                    return None;
                }
            };
            let taken = self.turns().take(exchange, now);
            let flight =
                Flight { exchange, taken, repeated: 0, timed_out: false, stray: 0, until: Instant::NEVER };
            if let Some(len) = self.send(flight, now, values, out) {
                return Some(len);
            }
        }
        self.deadline = now + self.timing.silence();
        None
    }

    /// Writes the request and returns its length; `None` if there are no values for it.
    fn send(
        &mut self,
        flight: Flight,
        now: Instant,
        values: &mut impl FnMut(usize, &mut [u8]) -> bool,
        out: &mut [u8; MAX_ADU],
    ) -> Option<usize> {
        let number = flight.exchange;
        let exchange = *self.table.get(number)?;
        let Some(len) = exchange.operation.encode(exchange.slave, out, |data| values(number, data)) else {
            self.count(number, |counters| &mut counters.unprepared);
            return None;
        };
        self.count(number, |counters| &mut counters.requests);
        let frame = out.get(..len)?;
        let crc = frame.last_chunk().copied()?;
        self.sent = now + self.timing.of(len);
        let expected = Expected::of(&exchange.operation, frame);
        let echo = (self.echo == Echo::Heard && expected.is_some()).then_some((len, crc));
        self.receiver.begin(expected, echo);
        self.phase = if expected.is_some() {
            let stray = self.receiver.stray();
            Phase::Waiting(Flight { stray, until: self.sent + exchange.timeout, ..flight })
        } else {
            Phase::Turnaround { exchange: number, until: self.sent + self.timing.turnaround() }
        };
        self.deadline = now;
        Some(len)
    }

    fn answered(&mut self, flight: Flight, at: usize, len: usize, now: Instant) -> Output<'_> {
        let exchange = flight.exchange;
        self.present(flight, now);
        self.count(exchange, |counters| &mut counters.replies);
        let reply =
            self.table.get(exchange).and_then(|row| row.operation.reply(self.receiver.frame(at, len)));
        // A reply that was found has as much data as its operation asks for.
        Output::Reply { exchange, reply: reply.unwrap_or(Reply::Written) }
    }

    fn refused(&mut self, flight: Flight, exception: Exception, now: Instant) -> Output<'_> {
        let exchange = flight.exchange;
        self.present(flight, now);
        self.count(exchange, |counters| {
            counters.newest_exception = Some(exception);
            &mut counters.exceptions
        });
        Output::Failed { exchange, failure: Failure::Exception(exception) }
    }

    /// The slave has answered.
    fn present(&mut self, flight: Flight, now: Instant) {
        let timeout = self.table.get(flight.exchange).map_or(Duration::ZERO, |row| row.timeout);
        // The reply may be a late one to the first of the requests. Then that to the repetition is
        // still to come, and must not be taken for one to another exchange. If a damaged one was the reason,
        // that costs a slave with a single exchange more than it is worth.
        let is_late = flight.timed_out || flight.repeated > 0 && !self.is_alone(flight.exchange);
        let not_before = if is_late { self.sent + timeout.saturating_mul(2) } else { Instant::ZERO };
        self.turns().answered(flight.exchange, now, not_before);
        self.phase = Phase::Idle;
        self.receiver.end();
    }

    /// Whether its slave has no other exchange.
    fn is_alone(&self, exchange: usize) -> bool {
        let slave = self.slave_of(exchange);
        self.table.iter().filter(|row| Some(row.slave) == slave).nth(1).is_none()
    }

    fn failure(&self, flight: Flight, now: Instant) -> Option<Failure> {
        if self.receiver.is_wrong() && now >= self.heard + self.timing.silence() {
            Some(Failure::Checksum)
        } else if now >= flight.until {
            Some(if self.receiver.is_wrong() { Failure::Checksum } else { Failure::Timeout })
        } else {
            None
        }
    }

    /// Repeats the request, or gives it up and says so.
    fn failed(&mut self, flight: Flight, failure: Failure, now: Instant) -> Option<Output<'static>> {
        let exchange = flight.exchange;
        self.end_burst();
        self.receiver.end();
        self.count(exchange, |counters| match failure {
            Failure::Checksum => &mut counters.checksums,
            _ => &mut counters.timeouts,
        });
        let is_up = self.presence(self.peer_of(exchange)) == Presence::Up;
        let retries = if is_up { self.table.get(exchange)?.retries } else { 0 };
        // The late reply of another slave may have destroyed the request.
        let disturbed = self.receiver.stray() != flight.stray;
        if flight.repeated < retries.max(u8::from(disturbed)) {
            self.count(exchange, |counters| &mut counters.retries);
            let repeated = flight.repeated.saturating_add(1);
            let timed_out = flight.timed_out || failure == Failure::Timeout;
            self.phase = Phase::Repeat(Flight { repeated, timed_out, ..flight });
            return None;
        }
        let sent = self.sent;
        self.turns().failed(exchange, flight.taken, now, sent);
        self.phase = Phase::Idle;
        Some(Output::Failed { exchange, failure })
    }

    fn waiting_deadline(&self, flight: Flight) -> Instant {
        if self.receiver.in_burst() || self.receiver.is_wrong() {
            flight.until.min(self.heard + self.timing.silence())
        } else {
            flight.until
        }
    }

    fn end_burst(&mut self) {
        if self.receiver.end_burst()
            && let Phase::Waiting(flight) = self.phase
        {
            self.count(flight.exchange, |counters| &mut counters.mismatched);
        }
    }

    fn peer_of(&self, exchange: usize) -> usize {
        let address = self.slave_of(exchange);
        self.slaves.iter().position(|slave| Some(slave.address) == address).unwrap_or(usize::MAX)
    }

    fn slave_of(&self, exchange: usize) -> Option<u8> {
        self.table.get(exchange).map(|row| row.slave)
    }

    fn count(&mut self, exchange: usize, counter: impl FnOnce(&mut SlaveCounters) -> &mut u32) {
        let peer = self.peer_of(exchange);
        if let Some(slave) = self.slaves.get_mut(peer) {
            let counter = counter(&mut slave.counters);
            *counter = counter.saturating_add(1);
        }
    }
}
