//! Which exchange has a line next (docs/wire/modbus-rtu.md section 5).
//!
//! In: when exchanges are wanted, and how they ended. Out: the next one, or when to look again.
//! Does not know frames: one line, one exchange at a time, peers that may be silent.
//!
//! Requested exchanges go first, the oldest request before the others; after [`REQUESTED_RUN`] of
//! them a due period has its turn. Of the periods the one that ends first goes first. A period that is
//! not served keeps its end, while those that are served get later ones, and of equals the one that
//! was served first is the next: so a line with too much to do serves all of them in turn. A peer that is down is asked in the
//! gaps between the others, in which its whole timeout fits; if there is no gap for as long as the
//! peer's wait, it is asked nevertheless. The wait grows to [`LONGEST_WAIT`] timeouts, so a peer
//! that never answers takes at most 1 part in 65 of the line.
//!
//! What a peer is asked at its start comes before anything else that it is asked, in the order of the
//! rows: at first, and after each time that it did not answer.
//!
//! A row that nobody answers waits while its peer is down, because nothing would tell that it was heard.
//! Once another row of the peer is answered, the waiting ones of the start go first, and with them begins
//! what is asked at the start behind them.

use super::Grid;
use crate::time::{Duration, Instant};

/// Requested exchanges in a row while a period is due.
const REQUESTED_RUN: u8 = 4;
/// The wait after the first failure in timeouts, as a power of two.
const FIRST_WAIT: u32 = 1;
/// The longest wait in timeouts, as a power of two.
const LONGEST_WAIT: u32 = 6;
/// No wait is longer than this, or than twice the timeout.
const WAIT_LIMIT: Duration = Duration::from_secs(30);

/// Whether a slave answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum Presence {
    /// It has not been asked yet.
    Unknown,
    /// It answered when it was last asked.
    Up,
    /// It did not answer when it was last asked.
    Down,
}

impl Presence {
    /// Its name in statistics: `unknown`, `up` or `down`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Up => "up",
            Self::Down => "down",
        }
    }
}

/// The exchanges of one line, and the peers that they are with.
#[derive(Debug)]
pub(crate) struct Turns<'a> {
    pub rows: &'a mut [Row],
    pub peers: &'a mut [Peer],
    /// Requested exchanges since the last other one.
    pub run: &'a mut u8,
}

/// One exchange.
#[derive(Debug, Clone)]
pub(crate) struct Row {
    peer: u8,
    grid: Option<Grid>,
    start: bool,
    /// It is to be asked at the start or because the peer was away, and has not been taken since.
    opens: bool,
    requested: Option<Instant>,
    /// Whether it has a reply, which says that the peer is there.
    is_answered: bool,
    /// When it was taken last.
    taken: Instant,
    /// Time on the line if no answer comes.
    cost: Duration,
    timeout: Duration,
}

/// One that answers, or does not.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    presence: Presence,
    /// Not asked before.
    not_before: Instant,
    /// From a failure to the next question.
    wait: Duration,
    failures: u32,
    missed: u32,
}

/// How a row was taken, which [`Turns::failed`] wants to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Taken {
    requested: Option<Instant>,
}

impl Peer {
    /// Nothing is known of it.
    pub(crate) const NEW: Self = Self {
        presence: Presence::Unknown,
        not_before: Instant::ZERO,
        wait: Duration::ZERO,
        failures: 0,
        missed: 0,
    };

    pub(crate) const fn presence(&self) -> Presence {
        self.presence
    }

    /// Its periods that went by while it was not down.
    pub(crate) const fn missed(&self) -> u32 {
        self.missed
    }
}

impl Row {
    /// An exchange with a peer, each `every` and at the start if it says so, that takes the line for
    /// `cost` if no answer comes.
    pub(crate) fn new(
        peer: u8,
        (every, start): (Option<Duration>, bool),
        (cost, timeout): (Duration, Duration),
        now: Instant,
    ) -> Self {
        let grid = every.map(|period| Grid::starting_at(now, period));
        let (requested, taken) = (start.then_some(now), Instant::ZERO);
        Self { peer, grid, start, opens: start, requested, is_answered: true, taken, cost, timeout }
    }
}

impl Turns<'_> {
    /// Wants a row as soon as possible; false if there is no such row.
    pub(crate) fn request(&mut self, row: usize, now: Instant) -> bool {
        let Some(row) = self.rows.get_mut(row) else { return false };
        row.requested.get_or_insert(now);
        true
    }

    /// The row to take now, or when to look again.
    pub(crate) fn choose(&mut self, now: Instant) -> Result<usize, Instant> {
        let (mut requested, mut due, mut probe) = (First::NONE, First::NONE, First::NONE);
        // Each peer that is down has a wait of its own: the one that may be asked first is not always the
        // one that has waited too long first.
        let mut overdue = First::NONE;
        let (mut look_again, mut next_due) = (Instant::NEVER, Instant::NEVER);
        let is_opening = self.rows.iter().any(|row| row.opens);
        for (nth, row) in self.rows.iter().enumerate() {
            if is_opening && self.waits_for_opening(nth, row) {
                continue;
            }
            let Some(peer) = self.peers.get(usize::from(row.peer)) else { continue };
            if !row.is_answered && peer.presence == Presence::Down {
                continue;
            }
            let wanted = row.wanted();
            let at = wanted.max(peer.not_before);
            match peer.presence {
                _ if at > now => {
                    look_again = look_again.min(at);
                    if peer.presence != Presence::Down {
                        next_due = next_due.min(at);
                    }
                }
                Presence::Down => {
                    probe.consider((at, row.taken), nth);
                    overdue.consider((at + peer.wait, row.taken), nth);
                }
                _ if row.requested.is_some() => requested.consider((wanted, row.taken), nth),
                _ => due.consider((row.end_of_period(), row.taken), nth),
            }
        }
        let probe = probe.nth.and_then(|nth| {
            let row = self.rows.get(nth)?;
            Some((nth, now + row.cost <= next_due))
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

    /// Whether another row of the peer is to be asked at its start before this one.
    fn waits_for_opening(&self, nth: usize, row: &Row) -> bool {
        let peer = self.peers.get(usize::from(row.peer));
        let is_down = peer.is_some_and(|peer| peer.presence == Presence::Down);
        let comes = |other: &Row| other.opens && other.peer == row.peer && (other.is_answered || !is_down);
        let first = self.rows.iter().position(comes);
        first.is_some_and(|first| first != nth)
    }

    /// The row is taken: its request is being sent, or there is nothing to send.
    pub(crate) fn take(&mut self, nth: usize, now: Instant) -> Taken {
        let Some(row) = self.rows.get_mut(nth) else { return Taken { requested: None } };
        let missed = row.grid.as_mut().and_then(|grid| grid.due(now)).unwrap_or(0);
        if let Some(peer) = self.peers.get_mut(usize::from(row.peer))
            && peer.presence != Presence::Down
        {
            let missed = u32::try_from(missed).unwrap_or(u32::MAX);
            peer.missed = peer.missed.saturating_add(missed);
        }
        row.taken = now;
        row.opens = false;
        Taken { requested: row.requested.take() }
    }

    /// The peer has answered; what it says to the request does not matter. It is asked nothing
    /// else before `not_before`.
    pub(crate) fn answered(&mut self, nth: usize, now: Instant, not_before: Instant) {
        let Some(which) = self.rows.get(nth).map(|row| row.peer) else { return };
        let Some(peer) = self.peers.get_mut(usize::from(which)) else { return };
        let was_down = peer.presence == Presence::Down;
        peer.presence = Presence::Up;
        peer.failures = 0;
        peer.not_before = not_before;
        if !was_down {
            return;
        }
        // The answered one may have gone before one that had to wait.
        let waited = self.rows.iter().position(|row| row.peer == which && row.opens && !row.is_answered);
        if waited.is_some_and(|waited| waited < nth)
            && let Some(row) = self.rows.get_mut(nth).filter(|row| row.start)
        {
            row.opens = true;
            row.requested.get_or_insert(now);
        }
        for (_, row) in self.rows.iter_mut().enumerate().filter(|(at, row)| row.peer == which && *at != nth) {
            if row.start {
                row.requested.get_or_insert(now);
            }
            if let Some(grid) = &mut row.grid {
                // What went by in the meantime is not missed.
                *grid = Grid::starting_at(grid.next().max(now), grid.period());
            }
        }
    }

    /// The peer has not answered, the last time to a request whose sending ended at `sent`.
    pub(crate) fn failed(&mut self, nth: usize, taken: Taken, now: Instant, sent: Instant) {
        let Some(row) = self.rows.get_mut(nth) else { return };
        row.requested = row.requested.or(taken.requested);
        let (timeout, which) = (row.timeout, row.peer);
        // It may have lost its power.
        for row in self.rows.iter_mut().filter(|row| row.start && row.peer == which) {
            row.opens = true;
            row.requested.get_or_insert(now);
        }
        let Some(peer) = self.peers.get_mut(usize::from(which)) else { return };
        let exponent = peer.failures.saturating_add(FIRST_WAIT).min(LONGEST_WAIT);
        peer.failures = peer.failures.saturating_add(1);
        let longest = WAIT_LIMIT.max(timeout.saturating_mul(2));
        peer.wait = timeout.saturating_mul(1_u64.wrapping_shl(exponent)).min(longest);
        peer.presence = Presence::Down;
        peer.not_before = (now + peer.wait).max(sent + timeout.saturating_mul(2));
    }
}

impl Row {
    /// Since when the row is to be taken, or from when.
    fn wanted(&self) -> Instant {
        let due = self.grid.as_ref().map_or(Instant::NEVER, Grid::next);
        self.requested.map_or(due, |requested| requested.min(due))
    }

    /// When the period that is due, or the next one, is missed.
    fn end_of_period(&self) -> Instant {
        self.grid.as_ref().map_or(Instant::NEVER, |grid| grid.next() + grid.period())
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
