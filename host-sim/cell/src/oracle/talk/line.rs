//! The conversation on one line or bus: the request on its way, its reply, and who is asked when
//! (proto-core/docs/wire/modbus-rtu.md sections 4 and 5, docs/configuration.md section 4, "Conversations").
//!
//! It does not predict which request is next: it says which ones may be sent, which must not, and how
//! long none may be.

use std::collections::{BTreeMap, BTreeSet};

use proto_core::time::{Duration, Instant};

use super::spec::{RowSpec, Seen, TalkSpec};
use crate::oracle::Invariant;
use crate::oracle::spec::PortSpec;
use crate::oracle::upward::Wrong;

/// The model of one line.
#[derive(Debug, Clone, Default)]
pub(in crate::oracle) struct TalkWatch {
    flight: Option<Flight>,
    /// A request that was handed over has not left.
    leaving: bool,
    /// The newest request has failed, and may be repeated.
    repeat: Option<Flight>,
    /// An exchange ended while its repetition was leaving; until then, its slave is not asked for others.
    held_by: Option<usize>,
    free_at: Instant,
    slaves: BTreeMap<u8, SlaveWatch>,
    /// When each exchange was asked last, without repetitions.
    asked: BTreeMap<usize, Instant>,
    /// Exchanges that a rising bit wants.
    risen: BTreeMap<usize, bool>,
    last_bits: BTreeMap<usize, bool>,
    /// When such a bit rose again before it was asked, newest.
    rose_at: BTreeMap<usize, Instant>,
    /// Exchanges that are to be asked at the start and have not been asked since, by slave.
    opening: BTreeMap<u8, BTreeSet<usize>>,
    /// Those of them whose values were unknown or stale meanwhile, so that they may have been passed over.
    passed: BTreeSet<usize>,
    /// The request whose bytes are still to come back.
    echo: Option<Vec<u8>>,
    pub unanswered: u32,
    pub refused: u32,
    /// When the port came up.
    pub began: Instant,
    /// When something last went wrong: a slave that was up failed, or the gateway did not run.
    pub disturbed_at: Instant,
}

/// A request on its way.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct Flight {
    pub row: usize,
    pub request: Vec<u8>,
    /// When the first of its repetitions was handed over.
    pub began: Instant,
    sent: Option<Instant>,
    repeated: u8,
    timed_out: bool,
    is_wrong: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Presence {
    #[default]
    Unknown,
    Up,
    Down,
}

/// What is known of a slave.
#[derive(Debug, Clone, Default)]
struct SlaveWatch {
    presence: Presence,
    since: Instant,
    /// It is not asked before this, or only for this exchange.
    held_until: Instant,
    held_for: usize,
    failures: u32,
    /// It is down, and not asked before this.
    not_before: Instant,
    asked: Instant,
    /// Its newest answer to each exchange is a refusal.
    refuses: BTreeMap<usize, bool>,
}

impl TalkWatch {
    /// The device of the port is there, perhaps another one.
    pub(in crate::oracle) fn begin(&mut self, talk: Option<&TalkSpec>, now: Instant) {
        self.abandon();
        self.slaves.clear();
        self.asked.clear();
        self.risen.clear();
        self.last_bits.clear();
        self.rose_at.clear();
        self.opening.clear();
        self.passed.clear();
        for row in talk.iter().flat_map(|talk| &talk.rows).filter(|row| row.at_start) {
            self.opening.entry(row.slave).or_default().insert(row.nth);
        }
        (self.began, self.disturbed_at) = (now, now);
    }

    /// What has begun is not continued.
    pub(in crate::oracle) fn abandon(&mut self) {
        let flight = self.flight.take().or(self.repeat.take());
        if let Some(row) = flight.map(|flight| flight.row)
            && self.risen.contains_key(&row)
        {
            self.risen.insert(row, true);
        }
        (self.repeat, self.held_by) = (None, None);
        (self.free_at, self.echo) = (Instant::ZERO, None);
    }

    /// The port is gone.
    pub(in crate::oracle) fn gone(&mut self) {
        self.abandon();
        self.leaving = false;
    }

    /// Whether nothing is on its way or about to be repeated.
    fn is_free(&self) -> bool {
        self.flight.is_none() && self.repeat.is_none() && !self.leaving
    }

    /// Looks for exchanges that are to be asked at the start and cannot be.
    pub(super) fn look_at_opening(&mut self, can_ask: impl Fn(usize) -> bool) {
        let Self { opening, passed, .. } = self;
        passed.extend(opening.values().flatten().copied().filter(|&row| !can_ask(row)));
    }

    /// Bits that ask have changed.
    pub(super) fn watch(&mut self, talk: &TalkSpec, bit: impl Fn(&RowSpec) -> Option<bool>, now: Instant) {
        for (nth, row) in talk.rows.iter().enumerate().filter(|(_, row)| row.rising.is_some()) {
            let Some(on) = bit(row) else { continue };
            let before = self.last_bits.insert(nth, on);
            if on && before == Some(false) && self.risen.insert(nth, true) == Some(true) {
                self.rose_at.insert(nth, now);
            }
        }
    }

    /// A request was handed over: checks that it may be sent now.
    pub(super) fn hands_over(
        &mut self,
        port: &PortSpec,
        talk: &TalkSpec,
        (row, request): (usize, &[u8]),
        (heard, is_busy): (Instant, bool),
        now: Instant,
    ) -> Result<(), Wrong> {
        let spec = &talk.rows[row];
        let wrong = |what: &str| Err((Invariant::Line, format!("{}: {what}", name(spec))));
        if self.leaving || self.flight.is_some() || is_busy {
            return wrong("asked while another transmission is on its way");
        }
        if now < heard + port.turnaround {
            return wrong("asked before the line was silent for long enough");
        }
        if now < self.free_at {
            return wrong("asked before the pause of the exchange before it was over");
        }
        if let Some(failed) = self.repeats().filter(|failed| *failed != row) {
            let what = format!("asked before {} is repeated", name(&talk.rows[failed]));
            return wrong(&what);
        }
        let repeated = self.repeat.take();
        // A second rise shortly before it was asked may be seen after that.
        let rose_before = self.asked.get(&row).zip(self.rose_at.get(&row));
        let is_unseen = rose_before.is_some_and(|(&asked, &rose)| rose <= asked && asked < rose + port.cycle);
        if is_unseen {
            self.rose_at.remove(&row);
        }
        let is_wanted = spec.rising.is_none()
            || spec.every.is_some()
            || repeated.is_some()
            || self.risen.insert(row, false) == Some(true)
            || is_unseen;
        if !is_wanted {
            let what = format!("{}: asked although its bit has not risen", name(spec));
            return Err((Invariant::Cycle, what));
        }
        let slave = self.slaves.entry(spec.slave).or_default();
        if now < slave.held_until && slave.held_for != row {
            let left = slave.held_until.saturating_since(now);
            let what = format!("asked {left} before the replies to another exchange with it are over");
            return wrong(&what);
        }
        if slave.presence == Presence::Down && now < slave.not_before {
            let what = format!(
                "{}: asked {} before a slave that does not answer may be asked",
                name(spec),
                slave.not_before.saturating_since(now)
            );
            return Err((Invariant::Periods, what));
        }
        if slave.presence == Presence::Down && !spec.is_answered() {
            let what = format!("{}: asked, and its slave does not answer", name(spec));
            return Err((Invariant::Periods, what));
        }
        slave.asked = now;
        if let Some(first) = self.comes_first(talk, spec.slave, row) {
            let what = format!("{}: asked before {}, which comes first", name(spec), name(&talk.rows[first]));
            return Err((Invariant::Cycle, what));
        }
        let began = repeated.as_ref().map_or(now, |failed| failed.began);
        if repeated.is_none() {
            self.asked.insert(row, now);
        }
        let repeats = repeated.as_ref().map_or(0, |failed| failed.repeated + 1);
        self.flight = Some(Flight {
            row,
            request: request.to_vec(),
            began,
            sent: None,
            repeated: repeats,
            timed_out: repeated.is_some_and(|failed| failed.timed_out),
            is_wrong: false,
        });
        self.leaving = true;
        self.echo = talk.has_echo.then(|| request.to_vec());
        Ok(())
    }

    /// The request has come back.
    pub(super) fn echoed(&mut self) {
        self.echo = None;
    }

    /// What is to be asked at the start of a slave before this exchange, and could be.
    fn comes_first(&self, talk: &TalkSpec, slave: u8, row: usize) -> Option<usize> {
        let opening = self.opening.get(&slave)?;
        // What nobody answers waits for a slave that does not.
        let is_down = self.slaves.get(&slave).is_some_and(|slave| slave.presence == Presence::Down);
        let may_be = |nth: &usize| !is_down || talk.rows[*nth].is_answered();
        let first = *opening.iter().find(|nth| !self.passed.contains(*nth) && may_be(nth))?;
        let is_itself = first == row || opening.contains(&row) && row < first;
        (!is_itself).then_some(first)
    }

    fn is_opened(&mut self, slave: u8, row: usize) {
        self.passed.remove(&row);
        if let Some(opening) = self.opening.get_mut(&slave) {
            opening.remove(&row);
        }
    }

    /// The request has left.
    pub(in crate::oracle) fn left(&mut self, talk: &TalkSpec, turnaround: Duration, now: Instant) {
        self.leaving = false;
        if let Some(row) = self.held_by.take() {
            let spec = &talk.rows[row];
            self.hold(spec.slave, row, now + spec.timeout.saturating_mul(2));
        }
        let Some(flight) = self.flight.as_mut().filter(|flight| flight.sent.is_none()) else { return };
        let spec = &talk.rows[flight.row];
        if spec.is_answered() {
            flight.sent = Some(now);
        } else {
            let row = flight.row;
            self.flight = None;
            self.free_at = now + spec.rest(turnaround);
            self.is_opened(spec.slave, row);
        }
    }

    /// Whether a reply is awaited to a request that has left.
    pub(in crate::oracle) fn waits(&self) -> bool {
        self.flight.as_ref().is_some_and(|flight| flight.sent.is_some())
    }

    /// What the bytes that are held begin with.
    pub(super) fn see(&self, port: &PortSpec, talk: &TalkSpec, bytes: &[u8]) -> Seen {
        let answer = match (&self.echo, &self.flight) {
            // The reply is looked for behind the echo.
            (Some(own), _) => match bytes.get(..own.len()) {
                Some(whole) if whole == own => Seen::Echo(own.len()),
                None if bytes.first() == own.first() => Seen::Begins { is_ours: true },
                _ => Seen::No,
            },
            // Nobody answers what is for all.
            (None, Some(flight)) if talk.rows[flight.row].is_answered() => {
                talk.rows[flight.row].see(&flight.request, bytes)
            }
            (None, _) => Seen::No,
        };
        answer.or(talk.see_unasked(port, bytes))
    }

    /// The exchange that a reply is awaited to.
    pub(super) fn awaits<'t>(&self, talk: &'t TalkSpec) -> Option<&'t RowSpec> {
        self.flight.as_ref().map(|flight| &talk.rows[flight.row])
    }

    pub(super) fn heard_wrong(&mut self) {
        if let Some(flight) = &mut self.flight {
            flight.is_wrong = true;
        }
    }

    /// The slave has answered.
    pub(super) fn answered(&mut self, talk: &TalkSpec, is_refusal: bool, now: Instant) -> Option<Flight> {
        let flight = self.flight.take()?;
        let spec = &talk.rows[flight.row];
        self.is_opened(spec.slave, flight.row);
        let was_down = self.slaves.get(&spec.slave).is_some_and(|slave| slave.presence == Presence::Down);
        if let Some(opening) = self.opening.get_mut(&spec.slave).filter(|_| was_down && spec.at_start)
            && opening.range(..flight.row).any(|nth| !talk.rows[*nth].is_answered())
        {
            // What waited before it comes first, and then this again.
            opening.insert(flight.row);
        }
        self.echo = None;
        self.refused = self.refused.wrapping_add(u32::from(is_refusal));
        self.free_at = now + spec.pause;
        let slave = self.slaves.entry(spec.slave).or_default();
        let is_first = slave.presence == Presence::Unknown;
        if slave.presence != Presence::Up {
            (slave.presence, slave.since) = (Presence::Up, now);
        }
        slave.failures = 0;
        slave.refuses.insert(flight.row, is_refusal);
        let is_alone = talk.rows_of(spec.slave).filter(|(_, row)| row.is_answered()).nth(1).is_none();
        if flight.timed_out || (flight.repeated > 0 || is_first) && !is_alone {
            match flight.sent {
                Some(sent) => self.hold(spec.slave, flight.row, sent + spec.timeout.saturating_mul(2)),
                None => self.held_by = Some(flight.row),
            }
        }
        Some(flight)
    }

    fn hold(&mut self, slave: u8, row: usize, until: Instant) {
        let slave = self.slaves.entry(slave).or_default();
        (slave.held_until, slave.held_for) = (until, row);
    }

    /// A deadline may have passed: replies that have not come fail. Returns whether the slave is given up.
    pub(super) fn tick(&mut self, talk: &TalkSpec, heard: Instant, now: Instant) -> Option<u8> {
        let flight = self.flight.as_ref()?;
        let spec = &talk.rows[flight.row];
        let until = flight.sent? + spec.timeout;
        let ends = if flight.is_wrong { until.min(heard + talk.silence) } else { until };
        if now < ends {
            return None;
        }
        let mut flight = self.flight.take()?;
        self.echo = None;
        flight.timed_out |= !flight.is_wrong;
        let slave = self.slaves.entry(spec.slave).or_default();
        if slave.presence != Presence::Down {
            self.disturbed_at = self.disturbed_at.max(now);
        }
        if slave.presence == Presence::Up && flight.repeated < spec.retries {
            self.repeat = Some(flight);
            return None;
        }
        self.fails(talk, &flight, now)
    }

    /// The exchange whose request is to be repeated.
    pub(super) fn repeats(&self) -> Option<usize> {
        self.repeat.as_ref().map(|failed| failed.row)
    }

    /// The request cannot be repeated. Returns the slave, which is given up.
    pub(super) fn is_not_repeated(&mut self, talk: &TalkSpec, now: Instant) -> Option<u8> {
        let failed = self.repeat.take()?;
        self.fails(talk, &failed, now)
    }

    fn fails(&mut self, talk: &TalkSpec, flight: &Flight, now: Instant) -> Option<u8> {
        let spec = &talk.rows[flight.row];
        let slave = self.slaves.entry(spec.slave).or_default();
        self.unanswered = self.unanswered.wrapping_add(1);
        self.free_at = now + spec.pause;
        if slave.presence != Presence::Down {
            (slave.presence, slave.since) = (Presence::Down, now);
        }
        slave.failures += 1;
        let wait = spec.timeout.saturating_mul(1 << slave.failures.min(6)).min(LONGEST_WAIT);
        slave.not_before = (now + wait).max(flight.sent? + spec.timeout.saturating_mul(2));
        if self.risen.contains_key(&flight.row) {
            self.risen.insert(flight.row, true);
        }
        // It may have lost its power.
        let at_start = talk.rows_of(spec.slave).filter(|(_, row)| row.at_start).map(|(nth, _)| nth);
        let at_start: Vec<usize> = at_start.collect();
        self.passed.retain(|row| !at_start.contains(row));
        self.opening.entry(spec.slave).or_default().extend(at_start);
        Some(spec.slave)
    }

    /// Checks that the line has not been idle although a period has ended, that every period has its turn,
    /// and that slaves that are down are looked for. `stalled` is for how long the gateway was not called
    /// since an instant. Returns the number of checks.
    pub(super) fn keeps_periods(
        &self,
        port: &PortSpec,
        talk: &TalkSpec,
        (heard, is_busy): (Instant, bool),
        stalled: impl Fn(Instant) -> Duration,
        now: Instant,
    ) -> Result<u64, Wrong> {
        let mut checked = 0;
        let free = self.free_at.max(heard + port.turnaround).max(self.disturbed_at);
        for (nth, row) in talk.rows.iter().enumerate() {
            let (Some(every), Some(&asked), true) = (row.every, self.asked.get(&nth), row.is_always_ready())
            else {
                continue;
            };
            let Some(slave) = self.slaves.get(&row.slave) else { continue };
            // Nothing is known of a device that nobody expects an answer of.
            let is_mute = slave.presence == Presence::Unknown
                && talk.rows_of(row.slave).all(|(_, row)| !row.is_answered());
            if slave.presence != Presence::Up && !is_mute {
                continue;
            }
            checked += 1;
            let due = (asked + every).max(free).max(slave.held_until).max(slave.since);
            let idle = now.saturating_since(due);
            if self.is_free() && !is_busy && idle > IDLE + stalled(due) {
                let what = format!("{}: its period has ended, and the line is free for {idle}", name(row));
                return Err((Invariant::Periods, what));
            }
            let from = asked.max(slave.since).max(self.disturbed_at).max(slave.held_until);
            let waits = now.saturating_since(from);
            if waits > every.saturating_mul(2) + talk.all_costs + stalled(from) {
                let what = format!("{}: not asked for {waits}", name(row));
                return Err((Invariant::Periods, what));
            }
        }
        // A request with values is not sent as long as one is unknown or stale.
        let is_asked = |row: &RowSpec| row.every.is_some() && row.is_always_ready() && row.is_answered();
        let is_wanted = |number: u8| talk.rows_of(number).any(|(_, row)| is_asked(row));
        let are_down = self.slaves.iter().filter(|(_, slave)| slave.presence == Presence::Down);
        for (&number, slave) in are_down.filter(|(number, _)| is_wanted(**number)) {
            checked += 1;
            let timeouts = talk.rows_of(number).map(|(_, row)| row.timeout);
            let wait = timeouts.max().unwrap_or_default().saturating_mul(64).min(LONGEST_WAIT);
            let from = slave.asked.max(self.began);
            let waits = now.saturating_since(from);
            if waits > wait.saturating_mul(2) + talk.all_costs.saturating_mul(2) + stalled(from) {
                return Err((Invariant::Periods, format!("slave {number} is not looked for since {waits}")));
            }
        }
        Ok(checked)
    }

    /// Since when the exchange could be carried out without any failure on the line; `None` if it cannot.
    pub(super) fn could_ask(&self, talk: &TalkSpec, row: usize) -> Option<Instant> {
        let slave = self.slaves.get(&talk.rows[row].slave)?;
        let is_refused = slave.refuses.get(&row).copied().unwrap_or(false);
        let is_up = slave.presence == Presence::Up && !is_refused;
        is_up.then(|| slave.since.max(self.disturbed_at).max(slave.held_until).max(self.began))
    }
}

/// The exchange in words.
pub(super) fn name(row: &RowSpec) -> String {
    if row.frames.is_some() {
        return format!("exchange {} with device {}", row.nth + 1, row.slave);
    }
    format!("slave {}, function {} at {}", row.slave, row.function, row.address)
}

/// A free line with something to do is not left idle for longer.
const IDLE: Duration = Duration::from_millis(5);
/// A slave that does not answer is asked again after this at the latest, if the line has a gap.
const LONGEST_WAIT: Duration = Duration::from_secs(30);
