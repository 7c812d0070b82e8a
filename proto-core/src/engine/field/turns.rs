//! Which exchange has a line next (docs/engine.md section 13).
//!
//! In: when exchanges are wanted, and how they ended. Out: the next one, or when to check again. Does not know frames:
//! one line, one exchange at a time, peers that may not respond.
//!
//! A write that stops goes first. Then come events, which expire, then other requested exchanges, the oldest request
//! first; after [`REQUESTED_RUN`] of these a due period has its turn. Of the due periods, the one that ends first goes
//! first. A period that is not served keeps its end while those that are served get later ones, so an overloaded line
//! serves all of them in turn.
//!
//! **Late replies.** Each transmission without a reply leaves one reply outstanding until it arrives or the exchange's
//! `late` time has passed. Until then the exchanges of the peer whose replies could be mistaken for it wait, the same
//! exchange among them. Nothing else waits.
//!
//! **A peer is away** if nothing was heard from it: since it was last heard, each of its periodic exchanges that used
//! to be answered has failed, or two of them; if none is periodic, the others count. It is then probed in gaps between
//! the others that are long enough for its whole timeout, and at the latest when its wait is over. The wait grows to
//! 2^[`LONGEST_WAIT`] timeouts, so a peer that never answers takes at most 1 part in 65 of the line. An exchange that
//! is not answered while others of its peer are has a wait of its own.
//!
//! **Start of a device.** The start exchanges of a peer come before all its other exchanges, in the order of the rows.
//! If another, periodic exchange shows whether the peer is up, they wait until the peer is heard, or was not heard for
//! its `absent` time. They are sent once, and again only after the peer has started: it said so, or it was away for its
//! `absent` time.

use super::peer_counters::PeerCounters;
use crate::modbus::rtu::Expected;
use crate::schedule::{Grid, Presence};
use crate::time::{Duration, Instant};

/// Maximum number of requested exchanges in a row while a period is due.
const REQUESTED_RUN: u8 = 4;
/// The longest wait in timeouts, as a power of two.
const LONGEST_WAIT: u8 = 6;
/// No wait is longer than this, or than twice the timeout if that is more.
const WAIT_LIMIT: Duration = Duration::from_secs(30);

/// The exchanges of one line and their peers.
#[derive(Debug)]
pub(crate) struct Turns<'a> {
    pub rows: &'a mut [Row],
    pub peers: &'a mut [PeerState],
    /// Requested exchanges since the last other one.
    pub run: &'a mut u8,
}

/// One exchange.
#[derive(Debug, Clone)]
pub(crate) struct Row {
    pub peer: u8,
    kind: RowKind,
    grid: Option<Grid>,
    /// When a change, a write that stops, or the start of a state was requested; it stays requested until it is
    /// answered. Like the other instants here, [`Instant::NEVER`] if it is not.
    requested: Instant,
    /// Whether the start exchange is wanted, if it is sent for no other reason.
    start: Start,
    start_at: Instant,
    opens: Opens,
    /// Since when an event is ready to be sent.
    event: Instant,
    /// When the row was last taken.
    taken: Instant,
    times: Times,
    /// The rows of the line, as bits, whose replies could be mistaken for its own.
    pub alike: u64,
    /// How many replies to earlier transmissions may still arrive.
    outstanding: u8,
    /// Until when they may arrive.
    outstanding_until: Instant,
    /// For a write that stops: until when replies to transmissions before the current request may arrive.
    former: Instant,
    /// The reply that may arrive, on Modbus.
    pub expected: Option<Expected>,
    wait: Wait,
    /// It has been answered since the line began.
    was_answered: bool,
    /// It was not answered since its peer was last heard.
    is_missed: bool,
    /// The last request was neither confirmed nor refused: only its possible echo arrived.
    pub is_unconfirmed: bool,
}

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RowKind {
    /// Whether it has a reply, which shows that the peer is up.
    pub is_answered: bool,
    /// It is sent at the start of the peer.
    pub starts: bool,
    /// It is also sent for other reasons, so the start is not separate.
    pub is_state: bool,
    pub stops: bool,
    /// Maximum number of repetitions, of a state and of an event.
    pub retries: [u8; 2],
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Times {
    /// Time it takes on the line without a reply.
    pub cost: Duration,
    pub timeout: Duration,
    /// How long after its request a reply may arrive.
    pub late: Duration,
    /// The pause of the line after it.
    pub pause: Duration,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Start {
    /// Not wanted: it was executed, or may have been.
    Over,
    Wanted,
    /// It was sent and nothing has been heard since; `start_at` is when the peer will have been away long enough.
    Unheard,
}

/// Whether the other exchanges of the peer wait because this one goes first at its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Opens {
    No,
    Yes,
    /// Its request was taken but is not answered yet.
    Taken,
}

/// The wait after failures, which doubles.
#[derive(Debug, Clone, Copy)]
struct Wait {
    failures: u8,
    /// Not sent before this.
    not_before: Instant,
    /// The peer reported that it is busy: events wait too.
    is_busy: bool,
}

/// A peer of a line, and its availability.
#[derive(Debug, Clone)]
pub(crate) struct PeerState {
    /// Address of the slave, or number of the device.
    pub number: u8,
    pub counters: PeerCounters,
    presence: Presence,
    /// It was heard since the line began.
    was_heard: bool,
    /// When the first of its unanswered requests left, and when the newest failed.
    failing_since: Instant,
    failing_until: Instant,
    failures: u8,
    /// From `not_before` on it is probed in a gap, at `nevertheless` in any case.
    not_before: Instant,
    nevertheless: Instant,
    missed: u32,
    absent: Duration,
}

/// Why a row was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Cause {
    /// An event, whose request was made when it happened.
    Event,
    /// Only the start of the peer.
    Start,
    /// A period, or a request made at this instant.
    State(Option<Instant>),
}

/// How a request ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ended {
    Good,
    /// The peer refused it for good.
    Refused,
    /// The peer accepted it and needs more time.
    Accepted,
    /// The peer did not execute it because it is busy.
    Busy,
    /// The peer may have executed it.
    Unclear,
    /// Only its possible echo arrived.
    Unconfirmed,
}

/// What a failure or a sign of life changes for the peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PeerChange {
    Nothing,
    /// The peer is away from now on.
    Away,
    /// The peer has started: its start exchanges are due.
    Started,
}

impl Wait {
    const NONE: Self = Self { failures: 0, not_before: Instant::ZERO, is_busy: false };

    fn longer(&mut self, timeout: Duration, now: Instant, is_busy: bool) {
        self.failures = self.failures.saturating_add(1);
        self.not_before = now + wait(self.failures, timeout);
        self.is_busy = is_busy;
    }
}

/// The wait after this many failures.
fn wait(failures: u8, timeout: Duration) -> Duration {
    let longest = WAIT_LIMIT.max(timeout.saturating_mul(2));
    timeout.saturating_mul(1_u64.wrapping_shl(u32::from(failures.min(LONGEST_WAIT)))).min(longest)
}

impl PeerState {
    pub(crate) fn new(number: u8, absent: Duration) -> Self {
        Self {
            number,
            counters: PeerCounters::default(),
            presence: Presence::Unknown,
            was_heard: false,
            failing_since: Instant::NEVER,
            failing_until: Instant::ZERO,
            failures: 0,
            not_before: Instant::ZERO,
            nevertheless: Instant::ZERO,
            missed: 0,
            absent,
        }
    }

    /// The peer may be another one now.
    fn forget(&mut self) {
        let (counters, missed) = (self.counters, self.missed);
        *self = Self { counters, missed, ..Self::new(self.number, self.absent) };
    }

    pub(crate) const fn presence(&self) -> Presence {
        self.presence
    }

    /// The periods that were missed while it was up.
    pub(crate) const fn missed(&self) -> u32 {
        self.missed
    }

    /// Whether it did not answer when it was last asked.
    pub(crate) fn is_away(&self) -> bool {
        self.presence == Presence::Down
    }

    /// It was away for its `absent` time.
    fn was_absent(&self) -> bool {
        self.failing_since != Instant::NEVER
            && self.failing_until.saturating_since(self.failing_since) >= self.absent
    }

    /// It was not heard for its `absent` time since the line began: perhaps it only responds once it is started.
    fn is_mute(&self) -> bool {
        !self.was_heard && self.was_absent()
    }
}

impl Row {
    pub(crate) fn new(peer: u8, kind: RowKind, period: Option<Duration>, times: Times) -> Self {
        Self {
            peer,
            kind,
            grid: period.map(|period| Grid::starting_at(Instant::ZERO, period)),
            requested: Instant::NEVER,
            start: Start::Over,
            start_at: Instant::NEVER,
            opens: Opens::No,
            event: Instant::NEVER,
            taken: Instant::ZERO,
            times,
            alike: 0,
            outstanding: 0,
            outstanding_until: Instant::ZERO,
            former: Instant::ZERO,
            expected: None,
            wait: Wait::NONE,
            was_answered: false,
            is_missed: false,
            is_unconfirmed: false,
        }
    }

    pub(crate) const fn is_answered(&self) -> bool {
        self.kind.is_answered
    }

    /// Whether it is written until the peer has it.
    pub(crate) const fn is_state(&self) -> bool {
        self.kind.is_state
    }

    pub(crate) const fn stops(&self) -> bool {
        self.kind.stops
    }

    /// From when on it is to be sent, if it is a wanted write that stops its peer.
    pub(crate) fn stop_at(&self) -> Option<Instant> {
        (self.kind.stops && self.is_requested()).then(|| self.requested.max(self.wait.not_before))
    }

    fn is_requested(&self) -> bool {
        self.requested != Instant::NEVER
    }

    /// Requests it from now on, unless it is already requested.
    fn request(&mut self, now: Instant) {
        self.requested = self.requested.min(now);
    }

    /// Requests it again for the same reason, unless there is a newer request.
    fn request_again(&mut self, requested: Option<Instant>) {
        if !self.is_requested() {
            self.requested = requested.unwrap_or(Instant::NEVER);
        }
    }

    const fn set_start(&mut self, start: Start, at: Instant) {
        (self.start, self.start_at) = (start, at);
    }

    pub(crate) const fn timeout(&self) -> Duration {
        self.times.timeout
    }

    pub(crate) const fn late(&self) -> Duration {
        self.times.late
    }

    pub(crate) const fn pause(&self) -> Duration {
        self.times.pause
    }

    /// Maximum number of repetitions of a request with this cause.
    pub(crate) const fn retries(&self, cause: Cause) -> u8 {
        let [of_state, of_event] = self.kind.retries;
        match cause {
            Cause::State(_) => of_state,
            Cause::Start | Cause::Event => of_event,
        }
    }

    /// Whether a reply to an earlier transmission may still arrive.
    pub(crate) fn is_outstanding(&self, now: Instant) -> bool {
        self.outstanding > 0 && self.outstanding_until > now
    }

    /// This many replies may arrive until this instant.
    pub(crate) fn leaves_outstanding(&mut self, count: u8, until: Instant, now: Instant) {
        let before = if self.is_outstanding(now) { self.outstanding } else { 0 };
        self.outstanding = before.saturating_add(count);
        self.outstanding_until = self.outstanding_until.max(until);
    }

    /// One of the outstanding replies has arrived.
    pub(crate) fn late_reply_came(&mut self) {
        self.outstanding = self.outstanding.saturating_sub(1);
    }

    /// The line begins anew: start exchanges are due, and periods begin now. Earlier requests are unknown and may still
    /// be answered.
    fn begin(&mut self, now: Instant) {
        self.start_over(now);
        (self.event, self.expected) = (Instant::NEVER, None);
        (self.wait, self.was_answered, self.is_missed) = (Wait::NONE, false, false);
        self.is_unconfirmed = false;
        // Their number is unknown, so they stay outstanding until the end.
        let count = if self.kind.is_answered { u8::MAX } else { 0 };
        (self.outstanding, self.outstanding_until) = (count, now + self.times.late);
        if let Some(grid) = &mut self.grid {
            *grid = Grid::starting_at(now, grid.period());
        }
    }

    /// Makes a start exchange due.
    fn start_over(&mut self, now: Instant) {
        if !self.kind.starts {
            return;
        }
        self.opens = Opens::Yes;
        if self.kind.is_state {
            self.request(now);
        } else {
            self.set_start(Start::Wanted, now);
        }
    }

    /// Since when it is requested apart from its period.
    fn requested_at(&self) -> Instant {
        self.requested.min(self.start_at)
    }

    /// When it is, or was, to be taken, apart from events.
    fn wanted(&self) -> Instant {
        self.grid.as_ref().map_or(Instant::NEVER, Grid::next).min(self.requested_at())
    }

    /// The end of the due or next period, when it is missed.
    fn end_of_period(&self) -> Instant {
        self.grid.as_ref().map_or(Instant::NEVER, |grid| grid.next() + grid.period())
    }
}

impl Turns<'_> {
    /// Requests a row until it is answered.
    pub(crate) fn request(&mut self, nth: usize, now: Instant) {
        if let Some(row) = self.rows.get_mut(nth) {
            if !row.is_requested() {
                row.former = row.outstanding_until;
            }
            row.request(now);
        }
    }

    /// The request of an event is ready, or is no longer to be sent.
    pub(crate) fn set_event(&mut self, nth: usize, event: Option<Instant>) {
        if let Some(row) = self.rows.get_mut(nth) {
            row.event = event.unwrap_or(Instant::NEVER);
        }
    }

    pub(crate) fn begin(&mut self, now: Instant) {
        self.rows.iter_mut().for_each(|row| row.begin(now));
        self.peers.iter_mut().for_each(|peer| peer.forget());
        *self.run = 0;
    }

    /// The connection to the peers is lost, and with it perhaps a row's request: it was not answered. The peers' time
    /// away counts from now.
    pub(crate) fn lost(&mut self, row: Option<(usize, Cause)>, now: Instant) {
        if let Some((nth, cause)) = row {
            self.failed(nth, cause, now, now);
        }
        for peer in &mut *self.peers {
            if peer.failing_since == Instant::NEVER {
                (peer.failing_since, peer.failing_until) = (now, now);
            }
        }
    }

    /// The connection is up again: periods begin now, and all waits end.
    pub(crate) fn resume(&mut self, now: Instant) {
        for row in &mut *self.rows {
            (row.event, row.wait) = (Instant::NEVER, Wait::NONE);
            if let Some(grid) = &mut row.grid {
                *grid = Grid::starting_at(now, grid.period());
            }
        }
        for peer in &mut *self.peers {
            peer.presence = Presence::Unknown;
            (peer.not_before, peer.nevertheless, peer.failing_until) = (Instant::ZERO, Instant::ZERO, now);
        }
        *self.run = 0;
    }

    /// Whether a write that stops this peer is still to be sent.
    pub(crate) fn is_stopping(&self, which: u8) -> bool {
        self.rows.iter().any(|row| row.peer == which && row.stop_at().is_some())
    }

    /// The row to take now, or when to check again.
    pub(crate) fn choose(&mut self, now: Instant) -> Result<usize, Instant> {
        let (mut stop, mut event) = (First::NONE, First::NONE);
        let (mut requested, mut due, mut probe, mut overdue) =
            (First::NONE, First::NONE, First::NONE, First::NONE);
        let (mut look_again, mut next_due) = (Instant::NEVER, Instant::NEVER);
        let is_opening = self.rows.iter().any(|row| row.opens == Opens::Yes);
        for (nth, row) in self.rows.iter().enumerate() {
            let Some(peer) = self.peers.get(usize::from(row.peer)) else { continue };
            if let Some(at) = row.stop_at() {
                if at > now {
                    look_again = look_again.min(at);
                } else {
                    stop.consider((at, row.taken), nth);
                }
                continue;
            }
            if is_opening && self.waits_for_opening(nth, row) || !row.kind.is_answered && peer.is_away() {
                continue;
            }
            if self.start_waits(row) {
                continue;
            }
            let free_at = self.free_at(row, now);
            let busy_until = if row.wait.is_busy { row.wait.not_before } else { Instant::ZERO };
            let at = row.event.max(free_at).max(busy_until);
            if at > now {
                look_again = look_again.min(at);
            } else {
                event.consider((row.event, row.taken), nth);
            }
            let wanted = row.wanted();
            let at = wanted.max(free_at).max(row.wait.not_before);
            if !peer.is_away() {
                if at > now {
                    (look_again, next_due) = (look_again.min(at), next_due.min(at));
                } else if row.requested_at() <= now {
                    requested.consider((row.requested_at(), row.taken), nth);
                } else {
                    due.consider((row.end_of_period(), row.taken), nth);
                }
                continue;
            }
            let at = at.max(peer.not_before);
            if at > now {
                look_again = look_again.min(at);
            } else {
                probe.consider((at, row.taken), nth);
                overdue.consider((at.max(peer.nevertheless), row.taken), nth);
            }
        }
        if let Some(nth) = stop.nth.or(event.nth) {
            return Ok(nth);
        }
        let probe = probe.nth.and_then(|nth| {
            let row = self.rows.get(nth)?;
            Some((nth, now + row.times.cost <= next_due))
        });
        let nevertheless = overdue.key.0;
        let periodic = overdue.nth.filter(|_| nevertheless <= now).or(due.nth);
        if let Some(nth) = requested.nth
            && (*self.run < REQUESTED_RUN || periodic.is_none())
        {
            *self.run = self.run.saturating_add(1);
            return Ok(nth);
        }
        *self.run = 0;
        match (periodic, probe) {
            (Some(nth), _) | (None, Some((nth, true))) => Ok(nth),
            (None, Some((_, false))) => Err(look_again.min(nevertheless)),
            (None, None) => Err(look_again),
        }
    }

    /// When no outstanding reply can be mistaken for one to this row any more.
    fn free_at(&self, row: &Row, now: Instant) -> Instant {
        if row.alike == 0 {
            return Instant::ZERO;
        }
        let rows = self.rows.iter().zip(0_u32..);
        let others = rows.filter(|(other, nth)| {
            other.is_outstanding(now) && other.peer == row.peer && row.alike.unbounded_shr(*nth) & 1 != 0
        });
        // Whichever transmission of a stop is answered, the peer has stopped since it was requested.
        let until = |other: &Row| match row.kind.stops && core::ptr::eq(other, row) {
            true => row.former,
            false => other.outstanding_until,
        };
        others.map(|(other, _)| until(other)).max().unwrap_or(Instant::ZERO)
    }

    /// Whether another reply may arrive that could be mistaken for one to this row.
    pub(crate) fn is_ambiguous(&self, nth: usize, now: Instant) -> bool {
        self.rows.get(nth).is_some_and(|row| self.free_at(row, now) > now)
    }

    /// Whether another start exchange of the peer has to come before this row.
    fn waits_for_opening(&self, nth: usize, row: &Row) -> bool {
        let is_away = self.peers.get(usize::from(row.peer)).is_some_and(|peer| peer.is_away());
        let comes = |other: &Row| {
            other.opens == Opens::Yes
                && other.peer == row.peer
                && (other.kind.is_answered || !is_away)
                && !self.start_waits(other)
        };
        let first = self.rows.iter().position(comes);
        first.is_some_and(|first| first != nth)
    }

    /// Whether a start exchange waits until its peer is heard, because another row will show that. Sent to a peer that
    /// may be away, it might be executed without a reply, and again once the peer is heard.
    fn start_waits(&self, row: &Row) -> bool {
        let tells = |other: &Row| other.peer == row.peer && other.kind.is_answered && other.grid.is_some();
        let turn = self.peers.get(usize::from(row.peer));
        let waits = match row.start {
            Start::Over => false,
            Start::Wanted => turn.is_some_and(|turn| turn.presence != Presence::Up && !turn.is_mute()),
            Start::Unheard => true,
        };
        waits && self.rows.iter().any(tells)
    }

    /// Takes the row: its request is sent now, or there is nothing to send.
    pub(crate) fn take(&mut self, nth: usize, now: Instant) -> Cause {
        let Some(row) = self.rows.get_mut(nth) else { return Cause::State(None) };
        row.taken = now;
        if row.stop_at().is_none() && core::mem::replace(&mut row.event, Instant::NEVER) != Instant::NEVER {
            return Cause::Event;
        }
        if row.opens == Opens::Yes {
            row.opens = Opens::Taken;
        }
        let is_due = row.grid.as_ref().is_some_and(|grid| grid.next() <= now);
        let missed = row.grid.as_mut().and_then(|grid| grid.due(now)).unwrap_or(0);
        let is_start = row.start_at <= now && !row.is_requested() && !is_due;
        row.set_start(Start::Over, Instant::NEVER);
        let requested = core::mem::replace(&mut row.requested, Instant::NEVER);
        let requested = Some(requested).filter(|at| *at != Instant::NEVER);
        let cause = if is_start { Cause::Start } else { Cause::State(requested) };
        if let Some(peer) = self.peers.get_mut(usize::from(row.peer))
            && !peer.is_away()
        {
            let missed = u32::try_from(missed).unwrap_or(u32::MAX);
            peer.missed = peer.missed.saturating_add(missed);
        }
        cause
    }

    /// A row that was taken was not sent, because one of its values is missing.
    pub(crate) fn not_sent(&mut self, nth: usize, cause: Cause, now: Instant) {
        let Some(row) = self.rows.get_mut(nth) else { return };
        match cause {
            // `opens` is not set: the others need not wait for its values.
            Cause::Start => row.set_start(Start::Wanted, now + row.times.timeout),
            Cause::State(Some(_)) if row.kind.stops => {
                row.request(now);
                row.wait.not_before = now + row.times.timeout;
            }
            _ => {}
        }
    }

    /// A request ended with a reply of the peer.
    pub(crate) fn answered(&mut self, nth: usize, cause: Cause, ended: Ended, now: Instant) -> PeerChange {
        let Some(row) = self.rows.get_mut(nth) else { return PeerChange::Nothing };
        let which = row.peer;
        (row.was_answered, row.is_unconfirmed, row.opens) = (true, false, Opens::No);
        match ended {
            Ended::Good | Ended::Refused | Ended::Accepted => row.wait = Wait::NONE,
            Ended::Busy | Ended::Unclear => {
                row.wait.longer(row.times.timeout, now, ended == Ended::Busy);
                match cause {
                    Cause::State(requested) => row.request_again(requested),
                    // It was not executed.
                    Cause::Start if ended == Ended::Busy => row.set_start(Start::Wanted, now),
                    Cause::Start | Cause::Event => {}
                }
            }
            Ended::Unconfirmed => row.is_unconfirmed = true,
        }
        if row.kind.stops && ended != Ended::Good && ended != Ended::Accepted {
            // A stop is requested until it is confirmed, even after a refusal.
            row.request(now);
            row.wait.not_before = now + row.times.timeout;
        }
        if ended == Ended::Unconfirmed {
            return PeerChange::Nothing;
        }
        self.heard(which, Some(nth), now)
    }

    /// A sign of life of a peer. `own` is the row whose reply it is, if any.
    pub(crate) fn heard(&mut self, which: u8, own: Option<usize>, now: Instant) -> PeerChange {
        let Some(peer) = self.peers.get_mut(usize::from(which)) else { return PeerChange::Nothing };
        let was_away = peer.is_away();
        let has_started = peer.was_absent();
        (peer.presence, peer.was_heard, peer.failures) = (Presence::Up, true, 0);
        peer.failing_since = Instant::NEVER;
        for row in self.rows.iter_mut().filter(|row| row.peer == which) {
            row.is_missed = false;
            // Its request or the reply was lost; it is unknown which.
            if row.start == Start::Unheard {
                row.set_start(Start::Over, Instant::NEVER);
            }
            if was_away && let Some(grid) = &mut row.grid {
                // Periods that passed while the peer was away are not missed.
                *grid = Grid::starting_at(grid.next().max(now), grid.period());
            }
        }
        if !has_started {
            return PeerChange::Nothing;
        }
        self.started(which, own, now);
        PeerChange::Started
    }

    /// The peer has started: its start exchanges are due, except a row that was just answered, unless another one has
    /// to come before it.
    pub(crate) fn started(&mut self, which: u8, own: Option<usize>, now: Instant) {
        let starts = |row: &Row| row.peer == which && row.kind.starts;
        let first = self.rows.iter().position(starts);
        for (nth, row) in self.rows.iter_mut().enumerate().filter(|(_, row)| starts(row)) {
            if own != Some(nth) || first != Some(nth) {
                row.start_over(now);
            }
        }
    }

    /// The peer has not answered a request that first left at `sent`.
    pub(crate) fn failed(&mut self, nth: usize, cause: Cause, now: Instant, sent: Instant) -> PeerChange {
        let Some(row) = self.rows.get_mut(nth) else { return PeerChange::Nothing };
        let (timeout, which) = (row.times.timeout, row.peer);
        let Some(peer) = self.peers.get_mut(usize::from(which)) else {
            return PeerChange::Nothing;
        };
        if row.opens == Opens::Taken {
            // A state still has to come first. A pure start may have been received.
            row.opens = if cause == Cause::Start { Opens::No } else { Opens::Yes };
        }
        match cause {
            Cause::State(requested) => row.request_again(requested),
            Cause::Start => row.set_start(Start::Unheard, sent + peer.absent),
            Cause::Event => {}
        }
        row.wait.longer(timeout, now, false);
        if row.stop_at().is_some() {
            // A stop waits no longer than for one turn of the others.
            row.wait.not_before = now + timeout;
        }
        row.is_missed = true;
        if peer.failing_since == Instant::NEVER {
            peer.failing_since = sent;
        }
        peer.failing_until = now;
        peer.failures = peer.failures.saturating_add(1);
        let was_away = peer.is_away();
        if !was_away && !self.is_silent(which) {
            return PeerChange::Nothing;
        }
        let Some(peer) = self.peers.get_mut(usize::from(which)) else {
            return PeerChange::Nothing;
        };
        let wait = wait(peer.failures, timeout);
        peer.presence = Presence::Down;
        peer.not_before = now + Duration::from_micros(wait.as_micros() / 2);
        peer.nevertheless = now + wait;
        // The peer's own wait counts its failures; the waits of single exchanges are for peers that respond.
        for row in self.rows.iter_mut().filter(|row| row.peer == which && !row.kind.stops) {
            row.wait = Wait::NONE;
        }
        if was_away { PeerChange::Nothing } else { PeerChange::Away }
    }

    /// Whether enough exchanges of a peer were not answered since it was heard.
    fn is_silent(&self, which: u8) -> bool {
        let rows = || self.rows.iter().filter(|row| row.peer == which && row.kind.is_answered);
        let was_answered = rows().any(|row| row.was_answered);
        // An exchange that was never answered says nothing while others were.
        let deciding = || rows().filter(|row| row.was_answered || !was_answered);
        // Nor does an occasional one if others are periodic: those will tell.
        let has_period = deciding().any(|row| row.grid.is_some());
        let deciding = || deciding().filter(|row| row.grid.is_some() || !has_period);
        let (all, missed) = (deciding().count(), deciding().filter(|row| row.is_missed).count());
        missed >= all.min(2) && missed > 0
    }

    /// Whether a peer is away and has a periodic exchange, which will notice its return. Without one, nothing shows
    /// whether it is still away.
    pub(crate) fn is_known_to_be_away(&self, which: u8) -> bool {
        let is_asked = |row: &Row| row.peer == which && row.kind.is_answered && row.grid.is_some();
        self.peers.get(usize::from(which)).is_some_and(PeerState::is_away) && self.rows.iter().any(is_asked)
    }
}

/// The row with the smallest key; the first one if several have it.
#[derive(Clone, Copy)]
struct First {
    /// What decides, and when the row was last taken.
    key: (Instant, Instant),
    nth: Option<usize>,
}

impl First {
    const NONE: Self = Self { key: (Instant::NEVER, Instant::NEVER), nth: None };

    fn consider(&mut self, key: (Instant, Instant), nth: usize) {
        if self.nth.is_none() || key < self.key {
            *self = Self { key, nth: Some(nth) };
        }
    }
}
