//! The exchanges of one line: which of them has it, and what the line waits for.
//!
//! In: requests that were handed over and have left, replies, the time. Out: the next exchange, and when to look
//! again. Does not know frames.

use super::line_timing::LineTiming;
use super::modbus_tcp::Transactions;
use super::sender::{DIGEST_SEED, digest};
use super::turns::{Cause, Ended, News, PeerState, Row, Turns};
use crate::config::{Echo, Span};
use crate::device::Probe;
use crate::modbus::rtu::Expected;
use crate::schedule::{Grid, Presence};
use crate::time::{Duration, Instant};

/// What a line is used for.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Phase {
    /// The next exchange may have it.
    Idle,
    /// A request is to be repeated.
    Repeat(Flight),
    /// A request has been handed over.
    Sending(Flight),
    /// Its reply is pending.
    Waiting(Flight),
    /// It rests.
    Resting(Instant),
}

/// A request on its way.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Flight {
    /// The exchange, counted from 0 on the port.
    pub exchange: u8,
    pub cause: Cause,
    /// Repetitions so far.
    repeated: u8,
    /// When the first transmission left that had no reply in time; never before there is one.
    unanswered: Instant,
    /// A reply with a wrong checksum came.
    pub is_wrong: bool,
    /// One came to an earlier transmission: that, or noise.
    was_wrong: bool,
    /// What came is its reply, or its own echo.
    pub may_be_echo: bool,
    /// The peer said that it is at it.
    is_pending: bool,
    /// Its reply could be taken for that to another request.
    is_ambiguous: bool,
    /// The reply of a Modbus slave.
    pub expected: Option<Expected>,
    /// Command, index and subindex of an SDO request.
    pub sdo: Option<[u8; 3]>,
    /// Of its bytes.
    digest: u64,
    until: Instant,
    /// Not even a pending answer is waited for longer.
    latest: Instant,
}

/// Why a request has failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Failure {
    Timeout,
    Checksum,
    /// All that came may have been its own echo.
    Echo,
    /// The peer said that it is at it, and nothing else; or a write that stops goes first.
    Pending,
}

/// What became of a request that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Over {
    /// It is repeated.
    Repeated,
    /// It was given up.
    GivenUp(News),
    /// Nobody knows: see [`Failure::Echo`].
    Unconfirmed,
}

/// The exchanges of one port.
#[derive(Debug, Clone)]
pub(crate) struct Line {
    /// The port's range of the exchanges, and of the peers.
    pub exchanges: Span,
    pub peers: Span,
    pub phase: Phase,
    run: u8,
    /// Values that ask are looked at with this period, if there are any.
    pub looks: Option<Grid>,
    /// No exchange is due before.
    look_at: Instant,
    /// No event expires before.
    pub expires_at: Instant,
    /// When the newest request left.
    sent: Instant,
    /// Whether own bytes are heard, as the file says.
    echo_setting: Echo,
    /// The same as far as it is known: as the file says, or as it was learned.
    pub has_echo: Option<bool>,
    /// The echo that is still to come, or may come.
    pub echo: Option<OwnRequest>,
    /// Frames come that nobody asked for.
    pub hears_unasked: bool,
    /// Over Modbus TCP: which request a reply belongs to.
    pub transactions: Option<Transactions>,
}

/// What tells the echo of a request from other bytes.
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

    /// Whether bytes begin with the echo. Nothing else may come before it: a late reply has been on its way
    /// when the request was sent.
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

    /// Since when a reply to it could have been expected, if an earlier transmission had none in time.
    pub(crate) fn unanswered(&self) -> Option<Instant> {
        Some(self.unanswered).filter(|at| *at != Instant::NEVER)
    }

    /// Whether a request with these bytes may follow those that had no reply: one that is confirmed late must not
    /// confirm another value.
    pub(crate) fn may_repeat(&self, request: &[u8]) -> bool {
        self.repeated == 0 || self.digest == digest(DIGEST_SEED, request)
    }
}

impl ExchangeTable<'_> {
    /// The peer that a request is to.
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

    /// Whether the next exchange may have the line.
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

    /// The request on its way.
    pub(crate) const fn flight(&self) -> Option<Flight> {
        match self.phase {
            Phase::Sending(flight) | Phase::Waiting(flight) => Some(flight),
            Phase::Idle | Phase::Repeat(_) | Phase::Resting(_) => None,
        }
    }

    /// The exchange whose request is on its way, or is to be repeated.
    pub(crate) const fn occupied_by(&self) -> Option<Flight> {
        match self.phase {
            Phase::Sending(flight) | Phase::Waiting(flight) | Phase::Repeat(flight) => Some(flight),
            Phase::Idle | Phase::Resting(_) => None,
        }
    }

    /// The exchange whose request is to be made now; `None` until the line is to be looked at again.
    /// It has the line if [`Self::handed_over`] follows, else the next is asked for.
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

    /// The request was handed over.
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

    /// It has left. Returns whether the line now waits for the reply.
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
            // Own bytes are not heard: the silence behind them is kept here.
            resting(until(Row::pause).max(now + line.turnaround), now)
        };
        self.look_at = now;
        is_answered
    }

    /// A frame with a wrong checksum came: perhaps the reply.
    pub(crate) fn heard_wrong(&mut self) {
        if let Phase::Sending(flight) | Phase::Waiting(flight) = &mut self.phase {
            flight.is_wrong = true;
        }
    }

    /// What came is the reply, or the request's own echo: only what comes behind it can tell.
    pub(crate) fn heard_reply_or_echo(&mut self) {
        if let Phase::Sending(flight) | Phase::Waiting(flight) = &mut self.phase {
            flight.may_be_echo = true;
        }
        self.echo = None;
    }

    /// The peer is at it: its answer is pending anew, as if the request had left now. Writes that stop do not wait for it.
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

    /// What is pending is not waited for beyond the turn of a write that stops.
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

    /// Own bytes are heard, or are not. Returns whether that is news.
    pub(crate) fn learn_echo(&mut self, has_echo: bool) -> bool {
        let is_news = self.has_echo.is_none();
        if is_news {
            self.has_echo = Some(has_echo);
        }
        is_news
    }

    /// The peer has answered. What it says counts for nothing where the answer could be another request's: that is
    /// [`Ended::Unclear`].
    pub(crate) fn answered(
        &mut self,
        table: &mut ExchangeTable<'_>,
        flight: Flight,
        ended: Ended,
        now: Instant,
    ) -> (Ended, News) {
        let ended = if flight.is_ambiguous { Ended::Unclear } else { ended };
        // The reply may be a late one to the first of the requests. Then that to the repetition is still to come.
        let sent = if matches!(self.phase, Phase::Sending(_)) { now } else { self.sent };
        if let Some(row) = table.row_of(flight).filter(|row| flight.is_ambiguous || row.is_outstanding(now)) {
            // What came may be another's reply, or that of a stop to an earlier transmission: its own is to come then.
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

    /// Why the request has failed, if it has. A wrong reply has, once the line is silent behind it.
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

    /// Repeats the request, or gives it up.
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
        let Some(peer) = table.peer_of(flight) else { return Over::GivenUp(News::Nothing) };
        let is_there = peer.presence() == Presence::Up;
        let counters = &mut peer.counters;
        let counter = match failure {
            Failure::Timeout | Failure::Pending => &mut counters.timeouts,
            Failure::Checksum => &mut counters.checksums,
            Failure::Echo => &mut counters.unconfirmed,
        };
        *counter = counter.wrapping_add(1);
        if failure == Failure::Echo {
            // What came may have been the echo, and the reply is still to come.
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
        // The peer has the request of which it said that it is at it.
        if is_there && flight.repeated < retries && !flight.is_pending && !yields {
            counters.retries = counters.retries.wrapping_add(1);
            let repeated = flight.repeated.saturating_add(1);
            let was_wrong = flight.was_wrong || failure == Failure::Checksum;
            self.phase = Phase::Repeat(Flight { repeated, unanswered, was_wrong, ..flight });
            self.echo = None;
            return Over::Repeated;
        }
        if failure == Failure::Timeout && self.echo_setting == Echo::Auto {
            // The adapter may be another one.
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
    ) -> News {
        let sent = self.sent;
        leave_outstanding(table, flight, flight.repeated.saturating_add(1), sent, now);
        let nth = usize::from(flight.exchange);
        let news = self.turns(table, |turns| match failure {
            Failure::Timeout => turns.failed(nth, flight.cause, now, flight.unanswered.min(sent)),
            // It said something, and nobody knows what.
            _ => turns.answered(nth, flight.cause, Ended::Unclear, now),
        });
        self.rest(table, flight, now);
        news
    }

    /// The rest of the line is over.
    pub(crate) fn advance(&mut self, now: Instant) {
        if let Phase::Resting(until) = self.phase
            && now >= until
        {
            self.phase = Phase::Idle;
            self.look_at = now;
        }
    }

    /// The line is to be looked at: something is wanted, or may be asked earlier than it was.
    pub(crate) const fn look(&mut self, now: Instant) {
        self.look_at = now;
    }

    /// The exchange is asked as soon as the line is free.
    pub(crate) fn request(&mut self, table: &mut ExchangeTable<'_>, exchange: usize, now: Instant) {
        self.turns(table, |turns| turns.request(exchange, now));
        self.look_at = now;
    }

    /// What has begun is not continued: the device is gone, or the gateway slept. Returns the request that was on its
    /// way.
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
        // One without a reply is sent once, whether it is heard or not.
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

    /// The device is there, perhaps another one: what is asked at the start is asked. A connection of Modbus TCP that is
    /// there again says nothing about its devices.
    pub(crate) fn begin(&mut self, table: &mut ExchangeTable<'_>, now: Instant) {
        self.abandon(table, now);
        let is_resumed =
            self.transactions.as_mut().is_some_and(|all| core::mem::replace(&mut all.was_open, true));
        self.turns(table, |turns| if is_resumed { turns.resume(now) } else { turns.begin(now) });
        self.has_echo = self.echo_setting.known();
    }

    /// When something happens without an input.
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

/// A reply to an earlier transmission may still come. Behind what had a wrong checksum, and may have been noise, it is
/// not later than two timeouts.
fn leave_outstanding(table: &mut ExchangeTable<'_>, flight: Flight, count: u8, sent: Instant, now: Instant) {
    let Some(row) = table.row_of(flight) else { return };
    if flight.unanswered().is_some() {
        row.leaves_outstanding(count, sent + row.late(), now);
    } else if flight.was_wrong && row.alike.count_ones() > 1 {
        row.leaves_outstanding(count, sent + row.late().min(row.timeout().saturating_mul(2)), now);
    }
}

/// How long pending answers are waited for, in timeouts.
const LONGEST_PENDING: u64 = 16;

fn resting(until: Instant, now: Instant) -> Phase {
    if until > now { Phase::Resting(until) } else { Phase::Idle }
}
