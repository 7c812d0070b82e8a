//! The conversation on one line: which exchange has it, and what the line waits for.
//!
//! In: requests that were handed over and have left, replies, the time. Out: the next exchange, and
//! when to look again. Does not know frames.

use super::line_timing::LineTiming;
use super::sender::{DIGEST_SEED, digest};
use crate::config::{AskWhen, Span};
use crate::device::Probe;
use crate::modbus::rtu::Expected;
use crate::schedule::{Grid, Peer, Presence, Row, Taken, Turns};
use crate::time::{Duration, Instant};

/// Counters of one peer of a line since the start; they wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct PeerCounters {
    /// Requests that were sent, with repetitions.
    pub requests: u32,
    /// Good replies.
    pub replies: u32,
    /// Requests without any reply in time.
    pub timeouts: u32,
    /// Requests whose reply had a wrong checksum.
    pub checksums: u32,
    /// Requests that the peer refused.
    pub refused: u32,
    /// The newest refusal's code on Modbus; 0 before one.
    pub refusal: u8,
    /// Repetitions.
    pub retries: u32,
    /// Times at which a request was not sent because a value of it was unknown or stale.
    pub unprepared: u32,
}

/// One peer of a line.
#[derive(Debug, Clone)]
pub(super) struct PeerState {
    /// Address of the slave, or number of the device.
    pub number: u8,
    pub counters: PeerCounters,
    pub turn: Peer,
}

/// What a line is used for.
#[derive(Debug, Clone, Copy)]
pub(super) enum Phase {
    /// The next exchange may have it.
    Idle,
    /// A request is to be repeated.
    Repeat(Flight),
    /// A request has been handed over.
    Sending(Flight),
    /// Its reply is awaited.
    Waiting(Flight),
    /// It rests.
    Resting(Instant),
}

/// A request on its way.
#[derive(Debug, Clone, Copy)]
pub(super) struct Flight {
    /// The exchange, counted from 0 on the port.
    pub exchange: u8,
    taken: Taken,
    /// Repetitions so far.
    repeated: u8,
    /// One of the requests had no reply in time.
    timed_out: bool,
    /// A reply with a wrong checksum came.
    pub is_wrong: bool,
    /// The reply of a Modbus slave.
    pub expected: Option<Expected>,
    until: Instant,
}

/// Why a request has failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Failure {
    Timeout,
    Checksum,
}

/// The times of one exchange.
#[derive(Debug, Clone, Copy)]
pub(super) struct Times {
    pub timeout: Duration,
    pub pause: Duration,
    pub retries: u8,
    /// Whether it has a reply.
    pub is_answered: bool,
}

/// The conversation of one port.
#[derive(Debug, Clone)]
pub(super) struct Line {
    /// The port's range of the exchanges, and of the peers.
    pub exchanges: Span,
    pub peers: Span,
    pub phase: Phase,
    run: u8,
    /// Values and bits that ask are looked at with this period, if there are any.
    pub looks: Option<Grid>,
    /// No exchange is due before.
    look_at: Instant,
    /// When the newest request left.
    sent: Instant,
    /// The exchange and its timeout of a repetition that is still leaving, although a late reply to the
    /// request before has ended it.
    late: Option<(u8, Duration)>,
    /// Own bytes are heard.
    pub has_echo: bool,
    /// The echo that is still to come.
    pub echo: Option<OwnRequest>,
    /// Frames come that nobody asked for.
    pub hears_unasked: bool,
}

/// What tells the echo of a request from other bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct OwnRequest {
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
    pub(super) fn probe(&self, bytes: &[u8]) -> Probe {
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
pub(super) struct Talks<'a> {
    pub rows: &'a mut [Row],
    pub peers: &'a mut [PeerState],
}

impl Flight {
    /// Whether something wanted it beside its period.
    pub(super) const fn was_requested(&self) -> bool {
        self.taken.was_requested()
    }

    /// Whether its request has been sent before.
    pub(super) const fn is_repetition(&self) -> bool {
        self.repeated > 0
    }
}

impl Talks<'_> {
    /// The peer that a request is to.
    pub(super) fn peer_of(&mut self, flight: Flight) -> Option<&mut PeerState> {
        let peer = self.number_of_peer(flight);
        self.peers.get_mut(usize::from(peer))
    }

    /// Whether no other exchange with a reply is with the peer of a request.
    fn is_alone(&self, flight: Flight) -> bool {
        let peer = self.number_of_peer(flight);
        self.rows.iter().filter(|row| row.peer() == peer && row.is_answered()).nth(1).is_none()
    }

    fn number_of_peer(&self, flight: Flight) -> u8 {
        self.rows.get(usize::from(flight.exchange)).map_or(0, Row::peer)
    }
}

impl Line {
    pub(super) fn new(exchanges: Span, peers: Span, looks: Option<Grid>, has_echo: bool) -> Self {
        Self {
            exchanges,
            peers,
            phase: Phase::Idle,
            run: 0,
            looks,
            look_at: Instant::ZERO,
            sent: Instant::ZERO,
            late: None,
            has_echo,
            echo: None,
            hears_unasked: false,
        }
    }

    /// Whether the next exchange may have the line.
    pub(super) fn is_free(&self, now: Instant) -> bool {
        let looks = self.looks.as_ref().is_some_and(|grid| grid.next() <= now);
        match self.phase {
            Phase::Idle => now >= self.look_at || looks,
            Phase::Repeat(_) => true,
            Phase::Sending(_) | Phase::Waiting(_) | Phase::Resting(_) => looks,
        }
    }

    /// Whether a request may be made now.
    pub(super) const fn may_ask(&self) -> bool {
        matches!(self.phase, Phase::Idle | Phase::Repeat(_))
    }

    /// The request on its way.
    pub(super) const fn flight(&self) -> Option<Flight> {
        match self.phase {
            Phase::Sending(flight) | Phase::Waiting(flight) => Some(flight),
            Phase::Idle | Phase::Repeat(_) | Phase::Resting(_) => None,
        }
    }

    /// The exchange whose request is to be made now; `None` until the line is to be looked at again.
    /// It has the line if [`Self::handed_over`] follows, else the next is asked for.
    pub(super) fn next(&mut self, talks: &mut Talks<'_>, now: Instant) -> Option<Flight> {
        if let Phase::Repeat(flight) = self.phase {
            self.phase = Phase::Idle;
            return Some(flight);
        }
        match self.turns(talks, |turns| turns.choose(now)) {
            Ok(exchange) => {
                let taken = self.turns(talks, |turns| turns.take(exchange, now));
                Some(Flight {
                    exchange: exchange as u8,
                    taken,
                    repeated: 0,
                    timed_out: false,
                    is_wrong: false,
                    expected: None,
                    until: Instant::NEVER,
                })
            }
            Err(later) => {
                self.look_at = later;
                None
            }
        }
    }

    /// The request was handed over.
    pub(super) fn handed_over(&mut self, flight: Flight, expected: Option<Expected>, request: &[u8]) {
        if self.has_echo {
            self.echo = OwnRequest::new(request);
        }
        self.phase = Phase::Sending(Flight { expected, is_wrong: false, until: Instant::NEVER, ..flight });
    }

    /// It has left. Returns whether the line now waits for the reply.
    pub(super) fn sent(
        &mut self,
        talks: &mut Talks<'_>,
        times: impl FnOnce(u8) -> Option<Times>,
        line: &LineTiming,
        now: Instant,
    ) -> bool {
        if let Some((exchange, timeout)) = self.late.take() {
            let not_before = now + timeout.saturating_mul(2);
            self.turns(talks, |turns| turns.hold(usize::from(exchange), not_before));
        }
        let Phase::Sending(flight) = self.phase else { return false };
        self.sent = now;
        let times = times(flight.exchange);
        let is_answered = times.is_some_and(|times| times.is_answered);
        let until = |time: fn(&Times) -> Duration| times.as_ref().map_or(now, |times| now + time(times));
        self.phase = if is_answered {
            Phase::Waiting(Flight { until: until(|times| times.timeout), ..flight })
        } else {
            // Own bytes are not heard: the silence behind them is kept here.
            resting(until(|times| times.pause).max(now + line.turnaround), now)
        };
        self.look_at = now;
        is_answered
    }

    /// A frame with a wrong checksum came: perhaps the reply.
    pub(super) fn heard_wrong(&mut self) {
        if let Phase::Sending(flight) | Phase::Waiting(flight) = &mut self.phase {
            flight.is_wrong = true;
        }
    }

    /// The peer has answered, whatever it says.
    pub(super) fn answered(&mut self, talks: &mut Talks<'_>, flight: Flight, times: Times, now: Instant) {
        // The reply may be a late one to the first of the requests. Then that to the repetition is
        // still to come, and must not be taken for one to another exchange.
        // If a damaged one was the reason, that costs a peer with a single exchange more than it is worth.
        // The first one may answer what was asked before the gateway or the port was there.
        let is_first = talks.peer_of(flight).is_some_and(|peer| peer.is_unknown());
        let late = flight.timed_out || (flight.repeated > 0 || is_first) && !talks.is_alone(flight);
        let not_before = if late { self.sent + times.timeout.saturating_mul(2) } else { Instant::ZERO };
        if late && matches!(self.phase, Phase::Sending(_)) {
            self.late = Some((flight.exchange, times.timeout));
        }
        self.turns(talks, |turns| turns.answered(usize::from(flight.exchange), now, not_before));
        self.rest(times.pause, now);
    }

    fn rest(&mut self, pause: Duration, now: Instant) {
        self.phase = resting(now + pause, now);
        self.look_at = now;
        self.echo = None;
    }

    /// Why the request has failed, if it has. A wrong reply has, once the line is silent behind it.
    pub(super) fn failure(&self, line: &LineTiming, now: Instant) -> Option<(Flight, Failure)> {
        let Phase::Waiting(flight) = self.phase else { return None };
        match flight.is_wrong {
            true if now >= line.silent_at().min(flight.until) => Some((flight, Failure::Checksum)),
            false if now >= flight.until => Some((flight, Failure::Timeout)),
            _ => None,
        }
    }

    /// Repeats the request, or gives it up. Returns whether it was given up.
    pub(super) fn failed(
        &mut self,
        talks: &mut Talks<'_>,
        (flight, failure): (Flight, Failure),
        times: Times,
        now: Instant,
    ) -> bool {
        let Some(peer) = talks.peer_of(flight) else { return true };
        let counters = &mut peer.counters;
        let counter = match failure {
            Failure::Timeout => &mut counters.timeouts,
            Failure::Checksum => &mut counters.checksums,
        };
        *counter = counter.wrapping_add(1);
        if peer.turn.presence() == Presence::Up && flight.repeated < times.retries {
            counters.retries = counters.retries.wrapping_add(1);
            let repeated = flight.repeated.saturating_add(1);
            let timed_out = flight.timed_out || failure == Failure::Timeout;
            self.phase = Phase::Repeat(Flight { repeated, timed_out, ..flight });
            self.echo = None;
            return false;
        }
        self.give_up(talks, flight, times, now);
        true
    }

    /// The request has failed and is not repeated.
    pub(super) fn give_up(&mut self, talks: &mut Talks<'_>, flight: Flight, times: Times, now: Instant) {
        let sent = self.sent;
        self.turns(talks, |turns| turns.failed(usize::from(flight.exchange), flight.taken, now, sent));
        self.rest(times.pause, now);
    }

    /// The rest of the line is over.
    pub(super) fn advance(&mut self, now: Instant) {
        if let Phase::Resting(until) = self.phase
            && now >= until
        {
            self.phase = Phase::Idle;
            self.look_at = now;
        }
    }

    /// The exchange is asked as soon as the line is free.
    pub(super) fn request(&mut self, talks: &mut Talks<'_>, exchange: usize, now: Instant) {
        self.turns(talks, |turns| turns.request(exchange, now));
        self.look_at = now;
    }

    /// What has begun is not continued: the device is gone, or the gateway slept.
    pub(super) fn abandon(&mut self, talks: &mut Talks<'_>, now: Instant) {
        // One without a reply is sent once, whether it is heard or not.
        let is_answered = |exchange: u8| talks.rows.get(usize::from(exchange)).is_some_and(Row::is_answered);
        if let Phase::Repeat(flight) | Phase::Sending(flight) | Phase::Waiting(flight) = self.phase
            && flight.taken.was_requested()
            && is_answered(flight.exchange)
        {
            self.turns(talks, |turns| turns.request(usize::from(flight.exchange), now));
        }
        self.phase = Phase::Idle;
        self.late = None;
        self.look_at = now;
        self.echo = None;
    }

    /// The device is there, perhaps another one: what is asked at the start is asked.
    pub(super) fn begin(&mut self, talks: &mut Talks<'_>, now: Instant) {
        self.abandon(talks, now);
        talks.rows.iter_mut().for_each(|row| row.restart(now));
        talks.peers.iter_mut().for_each(|peer| peer.turn.forget());
    }

    /// When something happens without an input.
    pub(super) fn deadline(&self, line: &LineTiming) -> Instant {
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

    fn turns<T>(&mut self, talks: &mut Talks<'_>, ask: impl FnOnce(&mut Turns<'_, PeerState>) -> T) -> T {
        ask(&mut Turns { rows: talks.rows, peers: talks.peers, run: &mut self.run })
    }
}

impl PeerState {
    /// Whether it has not been asked since the gateway or the port is there.
    fn is_unknown(&self) -> bool {
        self.turn.presence() == Presence::Unknown
    }

    /// Whether it did not answer when it was last asked.
    pub(super) fn is_down(&self) -> bool {
        self.turn.presence() == Presence::Down
    }
}

impl AsMut<Peer> for PeerState {
    fn as_mut(&mut self) -> &mut Peer {
        &mut self.turn
    }
}

impl AsRef<Peer> for PeerState {
    fn as_ref(&self) -> &Peer {
        &self.turn
    }
}

fn resting(until: Instant, now: Instant) -> Phase {
    if until > now { Phase::Resting(until) } else { Phase::Idle }
}

/// Whether an exchange needs its values or a bit to be looked at.
pub(super) const fn is_looked_at(when: &AskWhen) -> bool {
    when.change || when.rising.is_some()
}
