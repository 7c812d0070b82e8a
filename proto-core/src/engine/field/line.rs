//! The exchanges of one line: which one occupies it, and what the line waits for.
//!
//! In: requests handed over and sent, replies, the time. Out: the next exchange, and when to check again. Does not know
//! frames.

use super::line_timing::LineTiming;
use super::modbus_tcp::Transactions;
use super::sender::{DIGEST_SEED, digest};
use super::turns::{Cause, Ended, PeerChange, PeerState, Row, Turns};
use crate::config::{Echo, Span};
use crate::device::Probe;
use crate::modbus::rtu::Expected;
use crate::schedule::{Grid, Presence};
use crate::time::{Duration, Instant};

/// The state of a line.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Phase {
    /// Free for the next exchange.
    Idle,
    /// A request is to be repeated.
    Repeat(Flight),
    /// A request has been handed over.
    Sending(Flight),
    /// A request has been sent, and its reply is pending.
    Waiting(Flight),
    /// Pausing until this instant.
    Resting(Instant),
}

/// A request in flight.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Flight {
    /// The index of the exchange on the port.
    pub exchange: u8,
    pub cause: Cause,
    /// Repetitions so far.
    repeated: u8,
    /// When the first transmission without a timely reply left; [`Instant::NEVER`] if there is none.
    unanswered: Instant,
    /// A reply with a wrong checksum arrived.
    pub is_wrong: bool,
    /// A reply to an earlier transmission had a wrong checksum, or there was noise.
    was_wrong: bool,
    /// A frame arrived that is either the reply or the request's echo.
    pub may_be_echo: bool,
    /// The peer reported that it is still processing the request.
    is_pending: bool,
    /// Its reply could be mistaken for the reply to another request.
    is_ambiguous: bool,
    /// The expected reply of a Modbus slave.
    pub expected: Option<Expected>,
    /// Index and subindex of an SDO request.
    pub sdo: Option<[u8; 3]>,
    /// Digest of the request.
    digest: u64,
    until: Instant,
    /// Pending answers do not extend the timeout beyond this.
    latest: Instant,
}

/// Why a request has failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Failure {
    Timeout,
    Checksum,
    /// Only a frame that may be the request's own echo arrived.
    Echo,
    /// The peer only reported that it is still processing the request, or a write that stops takes precedence.
    Pending,
}

/// The consequence of a failed request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Over {
    /// It is repeated.
    Repeated,
    /// It is given up.
    GivenUp(PeerChange),
    /// It may have been executed: see [`Failure::Echo`].
    Unconfirmed,
}

/// The state of one port's exchanges.
#[derive(Debug, Clone)]
pub(crate) struct Line {
    /// The port's ranges of the exchanges and of the peers.
    pub exchanges: Span,
    pub peers: Span,
    pub phase: Phase,
    run: u8,
    /// The grid on which values that trigger requests are checked, if there are any.
    pub looks: Option<Grid>,
    /// No exchange is due before this.
    look_at: Instant,
    /// No event expires before this.
    pub expires_at: Instant,
    /// When the newest request left.
    sent: Instant,
    /// The configuration's `echo`: whether the line echoes the gateway's own bytes.
    echo_setting: Echo,
    /// Whether the line echoes, as configured or as learned; `None` if unknown.
    pub has_echo: Option<bool>,
    /// The echo that is expected, or possible.
    pub echo: Option<OwnRequest>,
    /// Unsolicited frames may arrive.
    pub hears_unasked: bool,
    /// On Modbus TCP: assigns replies to requests.
    pub transactions: Option<Transactions>,
}

/// Identifies the echo of a request.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OwnRequest {
    len: u16,
    first: u8,
    hash: u64,
}

impl OwnRequest {
    fn new(request: &[u8]) -> Option<Self> {
        let first = *request.first()?;
        Some(Self { len: request.len() as u16, first, hash: digest(DIGEST_SEED, request) })
    }

    /// Whether bytes begin with the echo. Nothing can come before it: a late reply would have been on the line while
    /// the request was sent.
    pub(crate) fn probe(&self, bytes: &[u8]) -> Probe {
        let len = usize::from(self.len);
        match bytes.get(..len) {
            _ if bytes.first() != Some(&self.first) => Probe::No(1),
            Some(own) if digest(DIGEST_SEED, own) == self.hash => Probe::Frame(len),
            Some(_) => Probe::No(len),
            None => Probe::Partial(len.saturating_sub(bytes.len())),
        }
    }
}

/// The exchanges and peers of one port.
pub(crate) struct ExchangeTable<'a> {
    pub rows: &'a mut [Row],
    pub peers: &'a mut [PeerState],
}

impl Flight {
    /// Whether its request has been sent before.
    pub(crate) const fn is_repetition(&self) -> bool {
        self.repeated > 0
    }

    /// When the first transmission without a timely reply left, if there was one: a reply may belong to any since.
    pub(crate) fn unanswered(&self) -> Option<Instant> {
        Some(self.unanswered).filter(|at| *at != Instant::NEVER)
    }

    /// Whether a request with these bytes may follow transmissions without a reply: a late confirmation must not
    /// confirm another value.
    pub(crate) fn may_repeat(&self, request: &[u8]) -> bool {
        self.repeated == 0 || self.digest == digest(DIGEST_SEED, request)
    }
}

impl ExchangeTable<'_> {
    pub(crate) fn peer_of(&mut self, flight: Flight) -> Option<&mut PeerState> {
        let peer = self.rows.get(usize::from(flight.exchange)).map_or(0, |row| row.peer);
        self.peers.get_mut(usize::from(peer))
    }

    fn row_of(&mut self, flight: Flight) -> Option<&mut Row> {
        self.rows.get_mut(usize::from(flight.exchange))
    }
}

impl Line {
    pub(crate) fn new(exchanges: Span, peers: Span, looks: Option<Grid>, echo: Echo) -> Self {
        Self {
            exchanges,
            peers,
            phase: Phase::Idle,
            run: 0,
            looks,
            look_at: Instant::ZERO,
            expires_at: Instant::NEVER,
            sent: Instant::ZERO,
            echo_setting: echo,
            has_echo: echo.known(),
            echo: None,
            hears_unasked: false,
            transactions: None,
        }
    }

    /// Whether the line is free for an exchange, or values that trigger requests are to be checked.
    pub(crate) fn is_free(&self, now: Instant) -> bool {
        let looks = self.looks.as_ref().is_some_and(|grid| grid.next() <= now);
        match self.phase {
            Phase::Idle => now >= self.look_at || looks,
            Phase::Repeat(_) => true,
            Phase::Sending(_) | Phase::Waiting(_) | Phase::Resting(_) => looks,
        }
    }

    /// Whether a request may be made now.
    pub(crate) const fn may_ask(&self) -> bool {
        matches!(self.phase, Phase::Idle | Phase::Repeat(_))
    }

    pub(crate) const fn flight(&self) -> Option<Flight> {
        match self.phase {
            Phase::Sending(flight) | Phase::Waiting(flight) => Some(flight),
            Phase::Idle | Phase::Repeat(_) | Phase::Resting(_) => None,
        }
    }

    /// The request in flight, or the one to be repeated.
    pub(crate) const fn occupied_by(&self) -> Option<Flight> {
        match self.phase {
            Phase::Sending(flight) | Phase::Waiting(flight) | Phase::Repeat(flight) => Some(flight),
            Phase::Idle | Phase::Resting(_) => None,
        }
    }

    /// The exchange whose request is to be made now; `None` if there is none before `look_at`. The exchange occupies
    /// the line if [`Self::handed_over`] follows, else call this again for the next.
    pub(crate) fn next(&mut self, table: &mut ExchangeTable<'_>, now: Instant) -> Option<Flight> {
        if let Phase::Repeat(flight) = self.phase {
            self.phase = Phase::Idle;
            return Some(flight);
        }
        match self.turns(table, |turns| turns.choose(now)) {
            Ok(exchange) => {
                let cause = self.turns(table, |turns| turns.take(exchange, now));
                Some(Flight {
                    exchange: exchange as u8,
                    cause,
                    repeated: 0,
                    unanswered: Instant::NEVER,
                    is_wrong: false,
                    was_wrong: false,
                    may_be_echo: false,
                    is_pending: false,
                    is_ambiguous: false,
                    expected: None,
                    sdo: None,
                    digest: 0,
                    until: Instant::NEVER,
                    latest: Instant::NEVER,
                })
            }
            Err(later) => {
                self.look_at = later;
                None
            }
        }
    }

    /// A request was handed over.
    pub(crate) fn handed_over(
        &mut self,
        table: &mut ExchangeTable<'_>,
        flight: Flight,
        (expected, sdo): (Option<Expected>, Option<[u8; 3]>),
        request: &[u8],
        now: Instant,
    ) {
        if self.has_echo != Some(false) {
            self.echo = OwnRequest::new(request);
        }
        let nth = usize::from(flight.exchange);
        let is_ambiguous = self.turns(table, |turns| turns.is_ambiguous(nth, now));
        if let Some(row) = table.rows.get_mut(nth) {
            row.expected = expected;
        }
        let digest = digest(DIGEST_SEED, request);
        self.phase = Phase::Sending(Flight {
            expected,
            sdo,
            is_ambiguous: flight.is_ambiguous || is_ambiguous,
            is_wrong: false,
            may_be_echo: false,
            digest,
            until: Instant::NEVER,
            ..flight
        });
    }

    /// The request has left. Returns whether the line now waits for the reply.
    pub(crate) fn sent(&mut self, table: &ExchangeTable<'_>, line: &LineTiming, now: Instant) -> bool {
        let Phase::Sending(flight) = self.phase else { return false };
        self.sent = now;
        let row = table.rows.get(usize::from(flight.exchange));
        let is_answered = row.is_some_and(Row::is_answered);
        let until = |time: fn(&Row) -> Duration| row.map_or(now, |row| now + time(row));
        self.phase = if is_answered {
            let latest = until(|row| row.timeout().saturating_mul(LONGEST_PENDING));
            Phase::Waiting(Flight { until: until(Row::timeout), latest, ..flight })
        } else {
            // Without a reply there is nothing to hear, so the silence after the request is kept here.
            resting(until(Row::pause).max(now + line.turnaround), now)
        };
        self.look_at = now;
        is_answered
    }

    /// A frame with a wrong checksum arrived, perhaps the reply.
    pub(crate) fn heard_wrong(&mut self) {
        if let Phase::Sending(flight) | Phase::Waiting(flight) = &mut self.phase {
            flight.is_wrong = true;
        }
    }

    /// A frame arrived that is the reply or the request's echo: only what follows can tell.
    pub(crate) fn heard_reply_or_echo(&mut self) {
        if let Phase::Sending(flight) | Phase::Waiting(flight) = &mut self.phase {
            flight.may_be_echo = true;
        }
        self.echo = None;
    }

    /// The peer is still processing the request: the timeout starts again, as if the request had left now. Writes that
    /// stop do not wait for it.
    pub(crate) fn heard_pending(&mut self, table: &ExchangeTable<'_>, now: Instant) {
        if let Phase::Sending(flight) | Phase::Waiting(flight) = &mut self.phase {
            (flight.is_pending, flight.is_wrong) = (true, false);
            let timeout = table.rows.get(usize::from(flight.exchange)).map_or(Duration::ZERO, Row::timeout);
            flight.until = (now + timeout).min(flight.latest);
        }
        if matches!(self.phase, Phase::Waiting(_)) {
            self.sent = now;
        }
        self.yield_to_stops(table, now);
    }

    /// A pending answer is not waited for any longer once a write that stops is due.
    pub(crate) fn yield_to_stops(&mut self, table: &ExchangeTable<'_>, now: Instant) {
        let Phase::Waiting(flight) = &mut self.phase else { return };
        if !flight.is_pending {
            return;
        }
        let others = (0_u8..).zip(table.rows.iter()).filter(|(nth, _)| *nth != flight.exchange);
        if let Some(stop) = others.filter_map(|(_, row)| row.stop_at()).min() {
            flight.until = flight.until.min(stop.max(now));
        }
    }

    /// The line is known to echo, or not to. Returns whether that is new.
    pub(crate) fn learn_echo(&mut self, has_echo: bool) -> bool {
        let is_news = self.has_echo.is_none();
        if is_news {
            self.has_echo = Some(has_echo);
        }
        is_news
    }

    /// The peer has answered. If the reply may belong to another request it proves nothing: [`Ended::Unclear`].
    pub(crate) fn answered(
        &mut self,
        table: &mut ExchangeTable<'_>,
        flight: Flight,
        ended: Ended,
        now: Instant,
    ) -> (Ended, PeerChange) {
        let ended = if flight.is_ambiguous { Ended::Unclear } else { ended };
        // The reply may be a late one to the first transmission; that to the repetition is still to come then.
        let sent = if matches!(self.phase, Phase::Sending(_)) { now } else { self.sent };
        if let Some(row) = table.row_of(flight).filter(|row| flight.is_ambiguous || row.is_outstanding(now)) {
            // It may be the reply to another exchange, or to an earlier transmission of a stop; its own is still to
            // come then.
            row.leaves_outstanding(flight.repeated.saturating_add(1), sent + row.late(), now);
        } else {
            leave_outstanding(table, flight, flight.repeated, sent, now);
        }
        let news =
            self.turns(table, |turns| turns.answered(usize::from(flight.exchange), flight.cause, ended, now));
        self.rest(table, flight, now);
        (ended, news)
    }

    fn rest(&mut self, table: &mut ExchangeTable<'_>, flight: Flight, now: Instant) {
        let pause = table.row_of(flight).map_or(Duration::ZERO, |row| row.pause());
        self.phase = resting(now + pause, now);
        self.look_at = now;
        self.echo = None;
    }

    /// The failed request and why it failed, if it has. A wrong reply fails once the line is silent after it.
    pub(crate) fn failure(&self, line: &LineTiming, now: Instant) -> Option<(Flight, Failure)> {
        let Phase::Waiting(flight) = self.phase else { return None };
        match flight.is_wrong {
            true if now >= line.silent_at().min(flight.until) => Some((flight, Failure::Checksum)),
            false if now >= flight.until && flight.is_pending => Some((flight, Failure::Pending)),
            false if now >= flight.until && flight.may_be_echo => Some((flight, Failure::Echo)),
            false if now >= flight.until => Some((flight, Failure::Timeout)),
            _ => None,
        }
    }

    /// Repeats the request or gives it up.
    pub(crate) fn failed(
        &mut self,
        table: &mut ExchangeTable<'_>,
        (flight, failure): (Flight, Failure),
        now: Instant,
    ) -> Over {
        // A write that stops does not wait for repetitions.
        let yields = table.rows.iter().any(|row| row.stop_at().is_some_and(|at| at <= now));
        let sent = self.sent;
        let retries = table.row_of(flight).map_or(0, |row| row.retries(flight.cause));
        let Some(peer) = table.peer_of(flight) else { return Over::GivenUp(PeerChange::Nothing) };
        let is_there = peer.presence() == Presence::Up;
        let counters = &mut peer.counters;
        let counter = match failure {
            Failure::Timeout | Failure::Pending => &mut counters.timeouts,
            Failure::Checksum => &mut counters.checksums,
            Failure::Echo => &mut counters.unconfirmed,
        };
        *counter = counter.wrapping_add(1);
        if failure == Failure::Echo {
            // The frame may have been the echo, and the reply may still come.
            let unanswered = flight.unanswered.min(sent);
            let count = flight.repeated.saturating_add(1);
            leave_outstanding(table, Flight { unanswered, ..flight }, count, sent, now);
            let nth = usize::from(flight.exchange);
            self.turns(table, |turns| turns.answered(nth, flight.cause, Ended::Unconfirmed, now));
            self.rest(table, flight, now);
            return Over::Unconfirmed;
        }
        let unanswered =
            if failure == Failure::Checksum { flight.unanswered } else { flight.unanswered.min(sent) };
        // No repetition of a request that the peer reported to be processing: the peer has it.
        if is_there && flight.repeated < retries && !flight.is_pending && !yields {
            counters.retries = counters.retries.wrapping_add(1);
            let repeated = flight.repeated.saturating_add(1);
            let was_wrong = flight.was_wrong || failure == Failure::Checksum;
            self.phase = Phase::Repeat(Flight { repeated, unanswered, was_wrong, ..flight });
            self.echo = None;
            return Over::Repeated;
        }
        if failure == Failure::Timeout && self.echo_setting == Echo::Auto {
            // The adapter may have been replaced.
            self.has_echo = None;
        }
        let was_wrong = flight.was_wrong || failure == Failure::Checksum;
        Over::GivenUp(self.give_up(table, Flight { unanswered, was_wrong, ..flight }, failure, now))
    }

    /// The request has failed and is not repeated.
    pub(crate) fn give_up(
        &mut self,
        table: &mut ExchangeTable<'_>,
        flight: Flight,
        failure: Failure,
        now: Instant,
    ) -> PeerChange {
        let sent = self.sent;
        leave_outstanding(table, flight, flight.repeated.saturating_add(1), sent, now);
        let nth = usize::from(flight.exchange);
        let news = self.turns(table, |turns| match failure {
            Failure::Timeout => turns.failed(nth, flight.cause, now, flight.unanswered.min(sent)),
            // The peer sent something that is unreadable.
            _ => turns.answered(nth, flight.cause, Ended::Unclear, now),
        });
        self.rest(table, flight, now);
        news
    }

    /// Ends the pause.
    pub(crate) fn advance(&mut self, now: Instant) {
        if let Phase::Resting(until) = self.phase
            && now >= until
        {
            self.phase = Phase::Idle;
            self.look_at = now;
        }
    }

    /// Check for the next exchange: one is wanted, or may be sent earlier than it was.
    pub(crate) const fn look(&mut self, now: Instant) {
        self.look_at = now;
    }

    /// Sends the exchange as soon as the line is free.
    pub(crate) fn request(&mut self, table: &mut ExchangeTable<'_>, exchange: usize, now: Instant) {
        self.turns(table, |turns| turns.request(exchange, now));
        self.look_at = now;
    }

    /// Abandons what has begun: the device is gone, or the gateway slept. Returns the request that occupied the line.
    pub(crate) fn abandon(&mut self, table: &mut ExchangeTable<'_>, now: Instant) -> Option<Flight> {
        let flight = self.occupied_by();
        if let Some(all) = &mut self.transactions {
            all.forget();
            self.turns(table, |turns| {
                turns.lost(flight.map(|flight| (usize::from(flight.exchange), flight.cause)), now)
            });
            (self.phase, self.look_at) = (Phase::Idle, now);
            return flight;
        }
        // A request without a reply is sent only once, received or not.
        if let Some(Flight { exchange, cause: Cause::State(Some(_)), .. }) = flight
            && table.rows.get(usize::from(exchange)).is_some_and(Row::is_answered)
        {
            self.turns(table, |turns| turns.request(usize::from(exchange), now));
        }
        if let Some(flight) = flight
            && let Some(row) = table.row_of(flight).filter(|row| row.is_answered())
        {
            row.leaves_outstanding(flight.repeated.saturating_add(1), now + row.late(), now);
        }
        self.phase = Phase::Idle;
        self.look_at = now;
        self.echo = None;
        flight
    }

    /// The device is up, perhaps another one: its start exchanges are due. A Modbus TCP connection that is up again
    /// says nothing about its devices.
    pub(crate) fn begin(&mut self, table: &mut ExchangeTable<'_>, now: Instant) {
        self.abandon(table, now);
        let is_resumed =
            self.transactions.as_mut().is_some_and(|all| core::mem::replace(&mut all.was_open, true));
        self.turns(table, |turns| if is_resumed { turns.resume(now) } else { turns.begin(now) });
        self.has_echo = self.echo_setting.known();
    }

    pub(crate) fn deadline(&self, line: &LineTiming) -> Instant {
        let looks = self.looks.as_ref().map_or(Instant::NEVER, Grid::next);
        let next = match self.phase {
            Phase::Idle => self.look_at.max(line.quiet_at()),
            Phase::Repeat(_) => line.quiet_at(),
            Phase::Sending(_) => Instant::NEVER,
            Phase::Waiting(flight) if flight.is_wrong => flight.until.min(line.silent_at()),
            Phase::Waiting(flight) => flight.until,
            Phase::Resting(until) => until,
        };
        looks.min(next)
    }

    pub(crate) fn turns<T>(
        &mut self,
        table: &mut ExchangeTable<'_>,
        ask: impl FnOnce(&mut Turns<'_>) -> T,
    ) -> T {
        ask(&mut Turns { rows: table.rows, peers: table.peers, run: &mut self.run })
    }
}

/// A reply to an earlier transmission may still arrive. After a wrong checksum, which may have been noise, it arrives
/// within two timeouts.
fn leave_outstanding(table: &mut ExchangeTable<'_>, flight: Flight, count: u8, sent: Instant, now: Instant) {
    let Some(row) = table.row_of(flight) else { return };
    if flight.unanswered().is_some() {
        row.leaves_outstanding(count, sent + row.late(), now);
    } else if flight.was_wrong && row.alike.count_ones() > 1 {
        row.leaves_outstanding(count, sent + row.late().min(row.timeout().saturating_mul(2)), now);
    }
}

/// The longest wait for a reply after pending answers, in timeouts.
const LONGEST_PENDING: u64 = 16;

fn resting(until: Instant, now: Instant) -> Phase {
    if until > now { Phase::Resting(until) } else { Phase::Idle }
}
