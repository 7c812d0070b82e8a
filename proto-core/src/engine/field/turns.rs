//! Which exchange has a line next (docs/engine.md section 13).
//!
//! In: when exchanges are wanted, and how they ended. Out: the next one, or when to look again. Does not know frames:
//! one line, one exchange at a time, peers that may be silent.
//!
//! A write that stops goes before everything else. Then come events, which expire, then other requested exchanges, the
//! oldest request first; after [`REQUESTED_RUN`] of these a due period has its turn. Of the periods the one that ends
//! first goes first. A period that is not served keeps its end, while those that are served get later ones, so a line
//! with too much to do serves all of them in turn.
//!
//! **A reply that may still come.** Each transmission without a reply leaves one outstanding until it comes or the
//! exchange's `late` time has passed. Until then those exchanges of the peer wait whose replies could be taken for it,
//! the same exchange among them. Nothing else waits.
//!
//! **A peer** is away when nothing was heard of it: when each of its exchanges with a period that used to be answered, or
//! two of them, failed since; where none has a period, those without one count. It is then asked in the gaps between
//! the others, in which its whole timeout fits, and at the latest when its wait is over. The wait grows to
//! 2^[`LONGEST_WAIT`] timeouts, so a peer that never answers takes at most 1 part in 65 of the line. An exchange that is
//! not answered while others of its peer are has a wait of its own.
//!
//! **The start of a device.** What a peer is asked at its start comes before anything else that it is asked, in the
//! order of the rows. Where another exchange with a period tells whether the peer is there, it waits until the peer is
//! heard, or was not heard for its `absent` time. It is asked once, and again only when the peer has started: it said so,
//! or it was away for its `absent` time.

use super::peer_counters::PeerCounters;
use crate::modbus::rtu::Expected;
use crate::schedule::{Grid, Presence};
use crate::time::{Duration, Instant};

/// Requested exchanges in a row while a period is due.
const REQUESTED_RUN: u8 = 4;
/// The longest wait in timeouts, as a power of two.
const LONGEST_WAIT: u8 = 6;
/// No wait is longer than this, or than twice the timeout.
const WAIT_LIMIT: Duration = Duration::from_secs(30);

/// The exchanges of one line, and the peers that they are with.
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
    /// A change, a write that stops, or a start of one that is also written again: wanted until it is answered.
    /// [`Instant::NEVER`] if it is not, as with the other instants here.
    requested: Instant,
    /// What is asked at the start, if that is all it is asked for.
    start: Start,
    start_at: Instant,
    opens: Opens,
    /// An event that is ready to be sent, since this instant.
    event: Instant,
    /// When it was taken last.
    taken: Instant,
    times: Times,
    /// The rows of the line, as bits, whose answers could be taken for its reply.
    pub alike: u64,
    /// How many replies to earlier transmissions may still come.
    outstanding: u8,
    /// Until then they may.
    outstanding_until: Instant,
    /// Of a write that stops: replies to what was sent before it was wanted may come until then.
    former: Instant,
    /// The reply that may come, on Modbus.
    pub expected: Option<Expected>,
    wait: Wait,
    /// It has been answered since the line began.
    was_answered: bool,
    /// It was not answered since its peer was heard.
    is_missed: bool,
    /// What was sent last was neither confirmed nor refused: it may have been an echo.
    pub is_unconfirmed: bool,
}

/// What kind of exchange a row is.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RowKind {
    /// Whether it has a reply, which says that the peer is there.
    pub is_answered: bool,
    /// It is asked at the start.
    pub starts: bool,
    /// It is also asked for other reasons, so the start is no event of its own.
    pub is_state: bool,
    /// It stops its peer.
    pub stops: bool,
    /// Repetitions of a state, and of an event.
    pub retries: [u8; 2],
}

/// The times of a row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Times {
    /// Time on the line if no answer comes.
    pub cost: Duration,
    pub timeout: Duration,
    /// How long after its request a reply may come.
    pub late: Duration,
    /// The rest of the line behind it.
    pub pause: Duration,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Start {
    /// It was carried out, or nobody knows; it is not asked.
    Over,
    Wanted,
    /// It was sent and nothing was heard since. At its instant the peer has been away long enough.
    Unheard,
}

/// Whether the other exchanges of the peer wait, because this one comes first at its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Opens {
    No,
    Yes,
    /// It was taken, and is not answered yet.
    Taken,
}

/// How long to wait after failures, which doubles.
#[derive(Debug, Clone, Copy)]
struct Wait {
    failures: u8,
    /// Not asked before.
    not_before: Instant,
    /// The peer said that it is busy: events wait too.
    is_busy: bool,
}

/// One peer of a line, and whether it answers.
#[derive(Debug, Clone)]
pub(crate) struct PeerState {
    /// Address of the slave, or number of the device.
    pub number: u8,
    pub counters: PeerCounters,
    presence: Presence,
    /// It was heard since the line began.
    was_heard: bool,
    /// Since when its requests are not answered, and until when that was seen.
    failing_since: Instant,
    failing_until: Instant,
    failures: u8,
    /// Asked in a gap from here on, and in any case at the second instant.
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
    /// The start of the peer alone.
    Start,
    /// A period, or a value that is wanted since this instant.
    State(Option<Instant>),
}

/// How a request ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ended {
    /// A good reply came.
    Good,
    /// The peer refused it for good.
    Refused,
    /// The peer is doing it, and takes its time.
    Accepted,
    /// The peer has not done it, because it is busy.
    Busy,
    /// The peer may have done it.
    Unclear,
    /// What came may have been an echo.
    Unconfirmed,
}

/// What a failure, or a sign of life, means for the peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum News {
    Nothing,
    /// The peer is away from now on.
    Away,
    /// The peer has started: what is asked at its start is asked.
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

/// The wait behind so many failures.
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

    /// It may be another one.
    fn forget(&mut self) {
        let (counters, missed) = (self.counters, self.missed);
        *self = Self { counters, missed, ..Self::new(self.number, self.absent) };
    }

    pub(crate) const fn presence(&self) -> Presence {
        self.presence
    }

    /// Its periods that went by while it was there.
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

    /// It has said nothing for that time since the line began: perhaps it does not before it was started.
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

    /// From when on it is to be sent, if it stops its peer and is wanted.
    pub(crate) fn stop_at(&self) -> Option<Instant> {
        (self.kind.stops && self.is_requested()).then(|| self.requested.max(self.wait.not_before))
    }

    fn is_requested(&self) -> bool {
        self.requested != Instant::NEVER
    }

    /// Wants it from now on, if it is not wanted yet.
    fn request(&mut self, now: Instant) {
        self.requested = self.requested.min(now);
    }

    /// Wants it again for the same reason, unless it is wanted for a newer one.
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

    /// How often a request for this reason is repeated.
    pub(crate) const fn retries(&self, cause: Cause) -> u8 {
        let [of_state, of_event] = self.kind.retries;
        match cause {
            Cause::State(_) => of_state,
            Cause::Start | Cause::Event => of_event,
        }
    }

    /// Whether a reply to an earlier transmission may still come.
    pub(crate) fn is_outstanding(&self, now: Instant) -> bool {
        self.outstanding > 0 && self.outstanding_until > now
    }

    /// So many replies may come until this instant.
    pub(crate) fn leaves_outstanding(&mut self, count: u8, until: Instant, now: Instant) {
        let before = if self.is_outstanding(now) { self.outstanding } else { 0 };
        self.outstanding = before.saturating_add(count);
        self.outstanding_until = self.outstanding_until.max(until);
    }

    /// One of the replies that were outstanding has come.
    pub(crate) fn late_reply_came(&mut self) {
        self.outstanding = self.outstanding.saturating_sub(1);
    }

    /// The line begins anew: what is asked at the start is asked again, and periods begin now. What was asked before
    /// is not known, and may be answered now.
    fn begin(&mut self, now: Instant) {
        self.start_over(now);
        (self.event, self.expected) = (Instant::NEVER, None);
        (self.wait, self.was_answered, self.is_missed) = (Wait::NONE, false, false);
        self.is_unconfirmed = false;
        // Nobody knows how many: they are pending until the end.
        let count = if self.kind.is_answered { u8::MAX } else { 0 };
        (self.outstanding, self.outstanding_until) = (count, now + self.times.late);
        if let Some(grid) = &mut self.grid {
            *grid = Grid::starting_at(now, grid.period());
        }
    }

    /// What is asked at the start is asked.
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

    /// Since when it is wanted beside its period.
    fn requested_at(&self) -> Instant {
        self.requested.min(self.start_at)
    }

    /// Since when the row is to be taken, or from when; of one without an event that is ready.
    fn wanted(&self) -> Instant {
        self.grid.as_ref().map_or(Instant::NEVER, Grid::next).min(self.requested_at())
    }

    /// When the period that is due, or the next one, is missed.
    fn end_of_period(&self) -> Instant {
        self.grid.as_ref().map_or(Instant::NEVER, |grid| grid.next() + grid.period())
    }
}

impl Turns<'_> {
    /// Wants a row until it is answered.
    pub(crate) fn request(&mut self, nth: usize, now: Instant) {
        if let Some(row) = self.rows.get_mut(nth) {
            if !row.is_requested() {
                row.former = row.outstanding_until;
            }
            row.request(now);
        }
    }

    /// The request of an event is ready, or is not sent any more.
    pub(crate) fn set_event(&mut self, nth: usize, event: Option<Instant>) {
        if let Some(row) = self.rows.get_mut(nth) {
            row.event = event.unwrap_or(Instant::NEVER);
        }
    }

    /// The line begins anew.
    pub(crate) fn begin(&mut self, now: Instant) {
        self.rows.iter_mut().for_each(|row| row.begin(now));
        self.peers.iter_mut().for_each(|peer| peer.forget());
        *self.run = 0;
    }

    /// The connection to the peers is lost, and perhaps a row's request with it: it was not answered. How long they
    /// stay away counts from here.
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

    /// The connection is there again: periods begin now, and nobody has to wait.
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

    /// The row to take now, or when to look again.
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

    /// When no reply is outstanding any more that could be taken for one to this row.
    fn free_at(&self, row: &Row, now: Instant) -> Instant {
        if row.alike == 0 {
            return Instant::ZERO;
        }
        let rows = self.rows.iter().zip(0_u32..);
        let others = rows.filter(|(other, nth)| {
            other.is_outstanding(now) && other.peer == row.peer && row.alike.unbounded_shr(*nth) & 1 != 0
        });
        // Whichever of the transmissions of a stop is answered, the peer has stopped since it was wanted.
        let until = |other: &Row| match row.kind.stops && core::ptr::eq(other, row) {
            true => row.former,
            false => other.outstanding_until,
        };
        others.map(|(other, _)| until(other)).max().unwrap_or(Instant::ZERO)
    }

    /// Whether another reply may come that could be taken for one to this row.
    pub(crate) fn is_ambiguous(&self, nth: usize, now: Instant) -> bool {
        self.rows.get(nth).is_some_and(|row| self.free_at(row, now) > now)
    }

    /// Whether another row of the peer is to be asked at its start before this one.
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

    /// Whether a start waits until its peer is heard, because another row will tell: one that is sent to a peer that is
    /// perhaps away may be carried out without a reply, and once more when the peer is heard.
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

    /// The row is taken: its request is being sent, or there is nothing to send.
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

    /// A row that was taken was not sent: a value of it is missing.
    pub(crate) fn not_sent(&mut self, nth: usize, cause: Cause, now: Instant) {
        let Some(row) = self.rows.get_mut(nth) else { return };
        match cause {
            // Without `opens`: the others need not wait for its values.
            Cause::Start => row.set_start(Start::Wanted, now + row.times.timeout),
            Cause::State(Some(_)) if row.kind.stops => {
                row.request(now);
                row.wait.not_before = now + row.times.timeout;
            }
            _ => {}
        }
    }

    /// A request ended with an answer of the peer.
    pub(crate) fn answered(&mut self, nth: usize, cause: Cause, ended: Ended, now: Instant) -> News {
        let Some(row) = self.rows.get_mut(nth) else { return News::Nothing };
        let which = row.peer;
        (row.was_answered, row.is_unconfirmed, row.opens) = (true, false, Opens::No);
        match ended {
            Ended::Good | Ended::Refused | Ended::Accepted => row.wait = Wait::NONE,
            Ended::Busy | Ended::Unclear => {
                row.wait.longer(row.times.timeout, now, ended == Ended::Busy);
                match cause {
                    Cause::State(requested) => row.request_again(requested),
                    // It was not carried out.
                    Cause::Start if ended == Ended::Busy => row.set_start(Start::Wanted, now),
                    Cause::Start | Cause::Event => {}
                }
            }
            Ended::Unconfirmed => row.is_unconfirmed = true,
        }
        if row.kind.stops && ended != Ended::Good && ended != Ended::Accepted {
            // A stop is wanted until it is confirmed, whatever a refusal says.
            row.request(now);
            row.wait.not_before = now + row.times.timeout;
        }
        if ended == Ended::Unconfirmed {
            return News::Nothing;
        }
        self.heard(which, Some(nth), now)
    }

    /// A sign of life of a peer, beside the row whose reply it is.
    pub(crate) fn heard(&mut self, which: u8, own: Option<usize>, now: Instant) -> News {
        let Some(peer) = self.peers.get_mut(usize::from(which)) else { return News::Nothing };
        let was_away = peer.is_away();
        let has_started = peer.was_absent();
        (peer.presence, peer.was_heard, peer.failures) = (Presence::Up, true, 0);
        peer.failing_since = Instant::NEVER;
        for row in self.rows.iter_mut().filter(|row| row.peer == which) {
            row.is_missed = false;
            // Its request, or the reply, was lost; nobody knows which.
            if row.start == Start::Unheard {
                row.set_start(Start::Over, Instant::NEVER);
            }
            if was_away && let Some(grid) = &mut row.grid {
                // What went by in the meantime is not missed.
                *grid = Grid::starting_at(grid.next().max(now), grid.period());
            }
        }
        if !has_started {
            return News::Nothing;
        }
        self.started(which, own, now);
        News::Started
    }

    /// The peer has started: what is asked at its start is asked, but for a row that was just answered, unless
    /// another one has to come before it.
    pub(crate) fn started(&mut self, which: u8, own: Option<usize>, now: Instant) {
        let starts = |row: &Row| row.peer == which && row.kind.starts;
        let first = self.rows.iter().position(starts);
        for (nth, row) in self.rows.iter_mut().enumerate().filter(|(_, row)| starts(row)) {
            if own != Some(nth) || first != Some(nth) {
                row.start_over(now);
            }
        }
    }

    /// The peer has not answered a request that left first at `sent`.
    pub(crate) fn failed(&mut self, nth: usize, cause: Cause, now: Instant, sent: Instant) -> News {
        let Some(row) = self.rows.get_mut(nth) else { return News::Nothing };
        let (timeout, which) = (row.times.timeout, row.peer);
        let Some(peer) = self.peers.get_mut(usize::from(which)) else {
            return News::Nothing;
        };
        if row.opens == Opens::Taken {
            // A state is still to come first. Whether the start of its own was heard, nobody knows.
            row.opens = if cause == Cause::Start { Opens::No } else { Opens::Yes };
        }
        match cause {
            Cause::State(requested) => row.request_again(requested),
            Cause::Start => row.set_start(Start::Unheard, sent + peer.absent),
            Cause::Event => {}
        }
        row.wait.longer(timeout, now, false);
        if row.stop_at().is_some() {
            // Others have a turn, no more.
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
            return News::Nothing;
        }
        let Some(peer) = self.peers.get_mut(usize::from(which)) else {
            return News::Nothing;
        };
        let wait = wait(peer.failures, timeout);
        peer.presence = Presence::Down;
        peer.not_before = now + Duration::from_micros(wait.as_micros() / 2);
        peer.nevertheless = now + wait;
        // The peer's wait is counted from its failures; those of one exchange are not its own fault.
        for row in self.rows.iter_mut().filter(|row| row.peer == which && !row.kind.stops) {
            row.wait = Wait::NONE;
        }
        if was_away { News::Nothing } else { News::Away }
    }

    /// Whether enough exchanges of a peer were not answered since it was heard.
    fn is_silent(&self, which: u8) -> bool {
        let rows = || self.rows.iter().filter(|row| row.peer == which && row.kind.is_answered);
        let was_answered = rows().any(|row| row.was_answered);
        // One that never was does not say anything while others were.
        let deciding = || rows().filter(|row| row.was_answered || !was_answered);
        // Nor does one that is asked now and then while others have a period: they will tell.
        let has_period = deciding().any(|row| row.grid.is_some());
        let deciding = || deciding().filter(|row| row.grid.is_some() || !has_period);
        let (all, missed) = (deciding().count(), deciding().filter(|row| row.is_missed).count());
        missed >= all.min(2) && missed > 0
    }

    /// Whether a peer is away, and is asked with a period, so that its return is noticed. Nothing tells whether one that
    /// is only asked when something happens is still away.
    pub(crate) fn is_known_to_be_away(&self, which: u8) -> bool {
        let is_asked = |row: &Row| row.peer == which && row.kind.is_answered && row.grid.is_some();
        self.peers.get(usize::from(which)).is_some_and(PeerState::is_away) && self.rows.iter().any(is_asked)
    }
}

/// The row with the smallest key; the first of several.
#[derive(Clone, Copy)]
struct First {
    /// What decides, and when the row was taken last.
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
