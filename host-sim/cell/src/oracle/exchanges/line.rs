//! The exchanges of one line or bus: the request in flight, its reply, and which exchanges may be sent when
//! (proto-core/docs/wire/modbus-rtu.md sections 4 and 5, docs/configuration.md section 4, "Exchanges").
//!
//! Does not predict the next request. Says which requests may be sent, which must not, and for how long the line may be
//! idle.

use std::collections::{BTreeMap, BTreeSet};

use proto_core::config::Echo;
use proto_core::time::{Duration, Instant};

use crate::oracle::Invariant;
use crate::oracle::invariant::Wrong;
use crate::oracle::spec::PortSpec;
use crate::oracle::spec::exchanges::{ExchangesSpec, Kind, RowSpec};
use crate::oracle::spec::frames::Seen;

/// The model of one line.
#[derive(Debug, Clone, Default)]
pub(in crate::oracle) struct ExchangesWatch {
    flight: Option<Flight>,
    /// A request was handed over and has not left yet.
    leaving: bool,
    /// The newest request has failed, and may be repeated.
    repeat: Option<Flight>,
    free_at: Instant,
    slaves: BTreeMap<u8, SlaveWatch>,
    rows: Vec<RowWatch>,
    /// The start exchanges, by slave, that have not been sent since the port came up.
    opening: BTreeMap<u8, BTreeSet<usize>>,
    /// Start exchanges whose values were unknown or stale at some time, so that the gateway may have skipped them.
    passed: BTreeSet<usize>,
    /// Whether the line echoes; `None` if unknown.
    has_echo: Option<bool>,
    /// The request whose echo is expected, or possible.
    echo: Option<Vec<u8>>,
    pub unanswered: u32,
    pub refused: u32,
    /// When the port came up.
    pub began: Instant,
    /// When something last went wrong: a slave that was up failed, or the gateway did not run.
    pub fault_at: Instant,
}

/// A request in flight.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct Flight {
    pub row: usize,
    pub request: Vec<u8>,
    /// When the first transmission was sent.
    pub began: Instant,
    /// For an event: when it expires.
    expires: Option<Instant>,
    sent: Option<Instant>,
    repeated: u8,
    /// When the first transmission without a timely reply left.
    pub timed_out: Option<Instant>,
    is_wrong: bool,
    was_wrong: bool,
    /// A frame arrived that is either the reply or the request's echo.
    may_be_echo: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Presence {
    #[default]
    Unknown,
    Up,
    Down,
}

/// The model of a slave.
#[derive(Debug, Clone, Default)]
struct SlaveWatch {
    presence: Presence,
    since: Instant,
    was_heard: bool,
    /// When the first request that it has not answered since it was last heard left, and when the newest one failed.
    failing: Option<(Instant, Instant)>,
    failures: u32,
    /// When a start exchange was last answered that had failed before.
    opened: Instant,
    asked: Instant,
    started: Instant,
}

/// The model of an exchange.
#[derive(Debug, Clone, Default)]
struct RowWatch {
    /// When it was last sent, apart from repetitions.
    asked: Option<Instant>,
    /// The newest request since the port came up.
    request: Option<Vec<u8>>,
    /// How many replies to earlier transmissions may still arrive, and until when.
    outstanding: (u8, Instant),
    /// Until when replies that could be mistaken for its own may arrive.
    blocked_until: Instant,
    was_answered: bool,
    is_missed: bool,
    failures: u32,
    /// After its own failures, it is sent at this instant at the latest.
    retry_at: Instant,
    is_unconfirmed: bool,
    is_refused: bool,
    /// It may be sent as a start exchange.
    starts: bool,
    last_bit: Option<bool>,
    /// Its bit has risen; the event may be sent until this instant.
    risen: Option<Instant>,
}

/// How a request was answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ended {
    Good,
    /// Refused for good.
    Refused,
    /// Not executed.
    Busy,
    /// Possibly executed.
    Unclear,
}

impl Ended {
    /// The meaning of a refusal, which on Modbus depends on its code.
    pub(super) const fn refused(code: u8, is_modbus: bool) -> Self {
        match code {
            6 if is_modbus => Self::Busy,
            4 | 8 | 10 | 11 if is_modbus => Self::Unclear,
            _ => Self::Refused,
        }
    }
}

impl RowWatch {
    fn is_outstanding(&self, now: Instant) -> bool {
        self.outstanding.0 > 0 && self.outstanding.1 > now
    }

    fn leaves(&mut self, count: u8, until: Instant, now: Instant) {
        let before = if self.is_outstanding(now) { self.outstanding.0 } else { 0 };
        self.outstanding = (before.saturating_add(count), self.outstanding.1.max(until));
    }

    fn waits_longer(&mut self, timeout: Duration, now: Instant) {
        self.failures += 1;
        self.retry_at = now + wait(timeout, self.failures);
    }
}

impl ExchangesWatch {
    /// The port is up, perhaps with another device.
    pub(in crate::oracle) fn begin(&mut self, exchanges: Option<&ExchangesSpec>, now: Instant) {
        let Some(exchanges) = exchanges else { return };
        self.abandon(Some(exchanges), now);
        self.slaves.clear();
        self.opening.clear();
        self.passed.clear();
        self.rows = vec![RowWatch::default(); exchanges.rows.len()];
        for (watch, row) in self.rows.iter_mut().zip(&exchanges.rows) {
            watch.starts = row.kind == Kind::Start;
            if row.at_start {
                self.opening.entry(row.slave).or_default().insert(row.nth);
            }
            if row.is_answered() {
                // Earlier requests are unknown and may still be answered.
                watch.outstanding = (u8::MAX, now + row.late);
                watch.blocked_until = now + row.late;
            }
        }
        self.has_echo = known(exchanges.echo);
        (self.began, self.fault_at) = (now, now);
    }

    /// The gateway abandons the request in flight.
    pub(in crate::oracle) fn abandon(&mut self, exchanges: Option<&ExchangesSpec>, now: Instant) {
        // A request that is about to be repeated counts as repeated.
        let flight = self.flight.take().or(self.repeat.take().map(|mut flight| {
            flight.repeated += 1;
            flight
        }));
        if let Some((flight, exchanges)) = flight.zip(exchanges)
            && exchanges.rows[flight.row].is_answered()
        {
            // Replies may arrive for the late time after the newest transmission left. If it has not left yet, the
            // gateway may wait as long from now on.
            let late = exchanges.rows[flight.row].late;
            match flight.sent {
                Some(sent) => self.leaves(exchanges, flight.row, flight.repeated + 1, sent + late, now),
                None => self.leaves(exchanges, flight.row, 0, now + late, now),
            }
        }
        for row in &mut self.rows {
            (row.risen, row.last_bit) = (None, None);
        }
        (self.free_at, self.echo) = (Instant::ZERO, None);
    }

    /// The port is gone.
    pub(in crate::oracle) fn gone(&mut self, exchanges: Option<&ExchangesSpec>, now: Instant) {
        self.abandon(exchanges, now);
        self.leaving = false;
    }

    /// Up to `count` replies to an exchange may arrive until this instant.
    fn leaves(&mut self, exchanges: &ExchangesSpec, row: usize, count: u8, until: Instant, now: Instant) {
        self.rows[row].leaves(count, until, now);
        for &other in &exchanges.rows[row].alike {
            self.rows[other].blocked_until = self.rows[other].blocked_until.max(until);
        }
    }

    /// Whether no request is in flight or about to be repeated.
    fn is_free(&self) -> bool {
        self.flight.is_none() && self.repeat.is_none() && !self.leaving
    }

    /// Notes the start exchanges that cannot be sent now.
    pub(super) fn look_at_opening(&mut self, can_ask: impl Fn(usize) -> bool) {
        let Self { opening, passed, .. } = self;
        passed.extend(opening.values().flatten().copied().filter(|&row| !can_ask(row)));
    }

    /// The bits of events may have changed. Only a rise from a known 0 is an event.
    pub(super) fn watch(
        &mut self,
        exchanges: &ExchangesSpec,
        bit: impl Fn(&RowSpec) -> Option<bool>,
        now: Instant,
    ) {
        for (watch, row) in self.rows.iter_mut().zip(&exchanges.rows).filter(|(_, row)| row.rising.is_some())
        {
            let on = bit(row);
            let before = std::mem::replace(&mut watch.last_bit, on);
            if on == Some(true) && before == Some(false) {
                watch.risen = Some(now + row.trigger);
            }
        }
    }

    /// Checks that the line is free for a request, and that no repetition goes first.
    fn check_turn(
        &self,
        port: &PortSpec,
        exchanges: &ExchangesSpec,
        row: usize,
        (heard, is_busy): (Instant, bool),
        now: Instant,
    ) -> Result<(), Wrong> {
        let wrong = |what: &str| Err((Invariant::Line, format!("{}: {what}", name(&exchanges.rows[row]))));
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
            let what = format!("asked before {} is repeated", name(&exchanges.rows[failed]));
            return wrong(&what);
        }
        Ok(())
    }

    /// Checks that a slave that is away only gets requests that have a reply, and rarely enough.
    fn check_presence(
        &mut self,
        exchanges: &ExchangesSpec,
        spec: &RowSpec,
        is_first: bool,
        now: Instant,
    ) -> Result<(), Wrong> {
        let slave = self.slaves.entry(spec.slave).or_default();
        if slave.presence == Presence::Down && !spec.is_answered() {
            let what = format!("{}: asked, and its slave does not answer", name(spec));
            return Err((Invariant::Periods, what));
        }
        let not_before = slave
            .failing
            .map(|(_, newest)| newest + wait(exchanges.shortest(spec.slave), slave.failures).half());
        if let Some(left) = not_before.filter(|_| slave.presence == Presence::Down && is_first)
            && now < left
        {
            let what = format!(
                "{}: asked {} before a slave that does not answer may be asked",
                name(spec),
                left.saturating_since(now)
            );
            return Err((Invariant::Periods, what));
        }
        Ok(())
    }

    /// A request was sent: checks that it may be sent now.
    pub(super) fn note_sent(
        &mut self,
        port: &PortSpec,
        exchanges: &ExchangesSpec,
        (row, request): (usize, &[u8]),
        (heard, is_busy): (Instant, bool),
        now: Instant,
    ) -> Result<(), Wrong> {
        let spec = &exchanges.rows[row];
        let wrong = |what: &str| Err((Invariant::Line, format!("{}: {what}", name(spec))));
        self.check_turn(port, exchanges, row, (heard, is_busy), now)?;
        let repeated = self.repeat.take();
        let expires = match &repeated {
            Some(failed) => failed.expires,
            None => self.rows[row].risen.take(),
        };
        if spec.kind == Kind::Event && repeated.is_none() && expires.is_none_or(|until| until < now) {
            let what = format!("{}: asked although its bit has not risen just now", name(spec));
            return Err((Invariant::Cycle, what));
        }
        // A device that was away for long enough may get its start exchanges before it is heard.
        let failing = self.slaves.get(&spec.slave).and_then(|slave| slave.failing);
        let is_away = failing.is_some_and(|(since, _)| now.saturating_since(since) >= exchanges.absent);
        let starts = std::mem::take(&mut self.rows[row].starts) || is_away;
        if repeated.is_none() && spec.kind == Kind::Start && !starts {
            let what = format!("{}: asked although its device has not started", name(spec));
            return Err((Invariant::Cycle, what));
        }
        let was_heard = self.slaves.get(&spec.slave).is_some_and(|slave| slave.was_heard);
        if repeated.is_none() && self.start_waits(exchanges, row) && (was_heard || !is_away) {
            let what = format!("{}: asked, and nothing tells that its device is there", name(spec));
            return Err((Invariant::Cycle, what));
        }
        if repeated.is_none()
            && let Some(other) =
                spec.alike.iter().copied().find(|&other| self.rows[other].is_outstanding(now))
        {
            let left = self.rows[other].outstanding.1.saturating_since(now);
            let what =
                format!("asked {left} before the replies to {} are over", name(&exchanges.rows[other]));
            return wrong(&what);
        }
        self.check_presence(exchanges, spec, repeated.is_none(), now)?;
        self.slaves.entry(spec.slave).or_default().asked = now;
        if let Some(first) = self.comes_first(exchanges, spec.slave, row) {
            let what =
                format!("{}: asked before {}, which comes first", name(spec), name(&exchanges.rows[first]));
            return Err((Invariant::Cycle, what));
        }
        self.is_opened(spec.slave, row);
        let began = repeated.as_ref().map_or(now, |failed| failed.began);
        let watch = &mut self.rows[row];
        if repeated.is_none() {
            watch.asked = Some(now);
        }
        watch.request = Some(request.to_vec());
        let repeats = repeated.as_ref().map_or(0, |failed| failed.repeated + 1);
        self.flight = Some(Flight {
            row,
            request: request.to_vec(),
            began,
            expires,
            sent: None,
            repeated: repeats,
            timed_out: repeated.as_ref().and_then(|failed| failed.timed_out),
            is_wrong: false,
            was_wrong: repeated.is_some_and(|failed| failed.was_wrong),
            may_be_echo: false,
        });
        self.leaving = true;
        if self.has_echo != Some(false) {
            self.echo = Some(request.to_vec());
        }
        Ok(())
    }

    /// The echo of the request arrived.
    pub(super) fn echoed(&mut self) {
        self.echo = None;
        self.has_echo.get_or_insert(true);
    }

    /// A frame arrived that is either the reply or the request's echo.
    pub(super) fn heard_reply_or_echo(&mut self) {
        if let Some(flight) = &mut self.flight {
            flight.may_be_echo = true;
        }
        self.echo = None;
    }

    /// The start exchange of a slave that could be sent and must come before this exchange.
    fn comes_first(&self, exchanges: &ExchangesSpec, slave: u8, row: usize) -> Option<usize> {
        let opening = self.opening.get(&slave)?;
        // While a slave is away, exchanges without a reply wait.
        let is_down = self.slaves.get(&slave).is_some_and(|slave| slave.presence == Presence::Down);
        let may_be = |nth: &usize| {
            (!is_down || exchanges.rows[*nth].is_answered()) && !self.start_waits(exchanges, *nth)
        };
        let first = *opening.iter().find(|nth| !self.passed.contains(*nth) && may_be(nth))?;
        let is_itself = first == row || opening.contains(&row) && row < first;
        (!is_itself).then_some(first)
    }

    /// Whether a start exchange waits until its slave is up, because a periodic exchange shows whether it is.
    fn start_waits(&self, exchanges: &ExchangesSpec, row: usize) -> bool {
        let spec = &exchanges.rows[row];
        let is_up = self.slaves.get(&spec.slave).is_some_and(|slave| slave.presence == Presence::Up);
        let tells = |row: &RowSpec| row.is_answered() && row.every.is_some();
        spec.kind == Kind::Start && !is_up && exchanges.rows_of(spec.slave).any(|(_, row)| tells(row))
    }

    fn is_opened(&mut self, slave: u8, row: usize) {
        self.passed.remove(&row);
        if let Some(opening) = self.opening.get_mut(&slave) {
            opening.remove(&row);
        }
    }

    /// The request has left.
    pub(in crate::oracle) fn left(&mut self, exchanges: &ExchangesSpec, turnaround: Duration, now: Instant) {
        self.leaving = false;
        let Some(flight) = self.flight.as_mut().filter(|flight| flight.sent.is_none()) else { return };
        let spec = &exchanges.rows[flight.row];
        if spec.is_answered() {
            flight.sent = Some(now);
        } else {
            self.flight = None;
            self.free_at = now + spec.rest(turnaround);
        }
    }

    /// Whether the line waits for the reply to a request that has left.
    pub(in crate::oracle) fn waits(&self) -> bool {
        self.flight.as_ref().is_some_and(|flight| flight.sent.is_some())
    }

    /// The exchanges with outstanding replies, except the one in flight.
    fn late_rows(&self, now: Instant) -> impl Iterator<Item = (usize, &RowWatch)> {
        let own = self.flight.as_ref().map(|flight| flight.row);
        let rows = self.rows.iter().enumerate();
        rows.filter(move |(nth, row)| Some(*nth) != own && row.is_outstanding(now))
    }

    /// Interprets the beginning of the bytes received so far.
    pub(super) fn see(&self, port: &PortSpec, exchanges: &ExchangesSpec, bytes: &[u8], now: Instant) -> Seen {
        let echo = match &self.echo {
            None => Seen::No,
            Some(own) => match bytes.get(..own.len()) {
                Some(whole) if whole == own => Seen::Echo(own.len()),
                None if bytes.first() == own.first() => Seen::Begins { is_ours: true },
                _ => Seen::No,
            },
        };
        let answer = match &self.flight {
            // The reply can only come after the echo.
            _ if self.has_echo == Some(true) && self.echo.is_some() => Seen::No,
            // A broadcast has no reply.
            Some(flight) if exchanges.rows[flight.row].is_answered() => {
                exchanges.rows[flight.row].see(&flight.request, bytes)
            }
            _ => Seen::No,
        };
        let late = self.late_rows(now).fold(Seen::No, |seen, (nth, row)| {
            seen.or(exchanges.rows[nth].see_late(row.request.as_deref(), bytes).late(nth))
        });
        let answer = match (answer, echo) {
            (Seen::Reply(len), Seen::Echo(own)) if own == len => Seen::ReplyOrEcho(len),
            _ => answer.or(echo),
        };
        match (answer, late) {
            // It may refuse an earlier request.
            (Seen::Refusal(len), Seen::Late(other, _)) if other == len => Seen::Ambiguous(len),
            _ => answer.or(late).or(exchanges.see_unasked(port, bytes)),
        }
    }

    /// The exchange in flight, and its request.
    pub(super) fn pending<'t>(&self, exchanges: &'t ExchangesSpec) -> Option<(&'t RowSpec, &[u8])> {
        self.flight.as_ref().map(|flight| (&exchanges.rows[flight.row], &flight.request[..]))
    }

    /// The exchange with an outstanding reply for which `is` holds.
    pub(super) fn late_of(
        &self,
        exchanges: &ExchangesSpec,
        is: impl Fn(&RowSpec) -> bool,
        now: Instant,
    ) -> Option<usize> {
        self.late_rows(now).map(|(nth, _)| nth).find(|&nth| is(&exchanges.rows[nth]))
    }

    /// A late reply to this exchange arrived. Returns the slave if it has started.
    pub(super) fn came_late(&mut self, exchanges: &ExchangesSpec, row: usize, now: Instant) -> Option<u8> {
        let outstanding = &mut self.rows[row].outstanding;
        outstanding.0 = outstanding.0.saturating_sub(1);
        self.heard(exchanges, exchanges.rows[row].slave, now)
    }

    /// A reply arrived that may belong to any of several requests. Returns the slave if it has started.
    pub(super) fn came_ambiguous(&mut self, exchanges: &ExchangesSpec, now: Instant) -> Option<u8> {
        let slave = exchanges.rows[self.flight.as_ref()?.row].slave;
        self.heard(exchanges, slave, now)
    }

    pub(super) fn heard_wrong(&mut self) {
        if let Some(flight) = &mut self.flight {
            flight.is_wrong = true;
        }
    }

    /// The slave has answered. Returns the request, and the slave if it has started.
    pub(super) fn answered(
        &mut self,
        exchanges: &ExchangesSpec,
        ended: Ended,
        now: Instant,
    ) -> Option<(Flight, Option<u8>)> {
        let flight = self.flight.take()?;
        let spec = &exchanges.rows[flight.row];
        // After a repetition, or while an earlier reply is outstanding, two equal frames may also be two replies.
        let is_sure = flight.repeated == 0 && !self.rows[flight.row].is_outstanding(now);
        if is_sure && (flight.may_be_echo || self.echo.is_some()) {
            self.has_echo.get_or_insert(flight.may_be_echo);
        }
        self.refused = self.refused.wrapping_add(u32::from(ended != Ended::Good));
        self.rest(spec.pause, now);
        self.leaves_of(exchanges, &flight, flight.repeated, flight.sent.unwrap_or(now), now);
        let started = self.ended(exchanges, &flight, ended, now);
        self.rows[flight.row].is_refused = ended == Ended::Refused;
        Some((flight, started))
    }

    fn rest(&mut self, pause: Duration, now: Instant) {
        self.free_at = now + pause;
        self.echo = None;
    }

    /// Up to `count` replies to a request may still arrive.
    fn leaves_of(
        &mut self,
        exchanges: &ExchangesSpec,
        flight: &Flight,
        count: u8,
        sent: Instant,
        now: Instant,
    ) {
        let spec = &exchanges.rows[flight.row];
        if flight.timed_out.is_some() {
            self.leaves(exchanges, flight.row, count, sent + spec.late, now);
        } else if flight.was_wrong && spec.alike.len() > 1 {
            // The damaged frame may have been noise before the reply.
            self.leaves(
                exchanges,
                flight.row,
                count,
                sent + spec.late.min(spec.timeout.saturating_mul(2)),
                now,
            );
        }
    }

    /// A request has ended, and its slave was heard. Returns the slave if it has started.
    fn ended(
        &mut self,
        exchanges: &ExchangesSpec,
        flight: &Flight,
        ended: Ended,
        now: Instant,
    ) -> Option<u8> {
        let spec = &exchanges.rows[flight.row];
        let watch = &mut self.rows[flight.row];
        (watch.was_answered, watch.is_unconfirmed) = (true, false);
        if spec.at_start && watch.failures > 0 {
            // Other exchanges may have waited for this one.
            self.slaves.entry(spec.slave).or_default().opened = now;
        }
        match ended {
            Ended::Good | Ended::Refused => (watch.failures, watch.retry_at) = (0, Instant::ZERO),
            Ended::Busy | Ended::Unclear => watch.waits_longer(spec.timeout, now),
        }
        if ended == Ended::Busy {
            // It was not executed, so it may be sent again.
            watch.starts |= spec.kind == Kind::Start;
            watch.risen = watch.risen.or(flight.expires);
        }
        self.heard(exchanges, spec.slave, now)
    }

    /// A slave was heard. Returns the slave if it has started: its start exchanges are due again.
    pub(super) fn heard(&mut self, exchanges: &ExchangesSpec, number: u8, now: Instant) -> Option<u8> {
        let slave = self.slaves.entry(number).or_default();
        let has_started =
            slave.failing.is_some_and(|(since, newest)| newest.saturating_since(since) >= exchanges.absent);
        if slave.presence != Presence::Up {
            (slave.presence, slave.since) = (Presence::Up, now);
        }
        (slave.was_heard, slave.failing, slave.failures) = (true, None, 0);
        for (watch, row) in self.rows.iter_mut().zip(&exchanges.rows).filter(|(_, row)| row.slave == number) {
            watch.is_missed = false;
            watch.starts |= has_started && row.kind == Kind::Start;
        }
        if has_started {
            slave.started = now;
        }
        has_started.then_some(number)
    }

    /// A CANopen node reported that it has booted: its start exchanges are due again.
    pub(super) fn booted(&mut self, exchanges: &ExchangesSpec, number: u8, now: Instant) {
        for (watch, row) in self.rows.iter_mut().zip(&exchanges.rows).filter(|(_, row)| row.slave == number) {
            watch.starts |= row.kind == Kind::Start;
        }
        self.slaves.entry(number).or_default().started = now;
    }

    /// Lets a request fail whose reply is overdue. Returns the slave if it has started.
    pub(super) fn tick(&mut self, exchanges: &ExchangesSpec, heard: Instant, now: Instant) -> Option<u8> {
        let flight = self.flight.as_ref()?;
        let spec = &exchanges.rows[flight.row];
        let until = flight.sent? + spec.timeout;
        let ends = if flight.is_wrong { until.min(heard + exchanges.silence) } else { until };
        if now < ends {
            return None;
        }
        let mut flight = self.flight.take()?;
        if flight.may_be_echo && !flight.is_wrong {
            // Whether it was executed is unknown, and it has not failed: the frame may have been the echo, and all
            // replies may still arrive.
            let until = flight.sent? + spec.late;
            self.rest(spec.pause, now);
            let watch = &mut self.rows[flight.row];
            watch.leaves(flight.repeated + 1, until, now);
            (watch.was_answered, watch.is_unconfirmed) = (true, true);
            return None;
        }
        self.echo = None;
        flight.timed_out = flight.timed_out.or(flight.sent.filter(|_| !flight.is_wrong));
        flight.was_wrong |= flight.is_wrong;
        let slave = self.slaves.entry(spec.slave).or_default();
        if slave.presence != Presence::Down {
            self.fault_at = self.fault_at.max(now);
        }
        let retries = if spec.kind == Kind::State { spec.retries } else { spec.event_retries };
        if slave.presence == Presence::Up && flight.repeated < retries {
            self.repeat = Some(flight);
            return None;
        }
        if !flight.is_wrong && exchanges.echo == Echo::Auto {
            self.has_echo = None;
        }
        self.fails(exchanges, &flight, flight.is_wrong, now)
    }

    /// The exchange whose request is to be repeated.
    pub(super) fn repeats(&self) -> Option<usize> {
        self.repeat.as_ref().map(|failed| failed.row)
    }

    /// The request that is to be repeated.
    pub(super) fn repeated_request(&self) -> Option<&[u8]> {
        self.repeat.as_ref().map(|failed| &failed.request[..])
    }

    /// The gateway does not repeat the request. Returns the slave if it has started.
    pub(super) fn is_not_repeated(&mut self, exchanges: &ExchangesSpec, now: Instant) -> Option<u8> {
        let mut failed = self.repeat.take()?;
        // It counts as repeated nevertheless.
        failed.repeated += 1;
        self.fails(exchanges, &failed, false, now)
    }

    fn fails(
        &mut self,
        exchanges: &ExchangesSpec,
        flight: &Flight,
        is_wrong: bool,
        now: Instant,
    ) -> Option<u8> {
        let spec = &exchanges.rows[flight.row];
        self.unanswered = self.unanswered.wrapping_add(1);
        self.rest(spec.pause, now);
        let sent = flight.sent.unwrap_or(now);
        self.leaves_of(exchanges, flight, flight.repeated + 1, sent, now);
        if is_wrong {
            // The slave sent something unreadable.
            return self.ended(exchanges, flight, Ended::Unclear, now);
        }
        let watch = &mut self.rows[flight.row];
        watch.is_missed = true;
        watch.waits_longer(spec.timeout, now);
        let is_silent = self.is_silent(exchanges, spec.slave);
        let slave = self.slaves.entry(spec.slave).or_default();
        let first = flight.timed_out.unwrap_or(sent);
        slave.failing = Some((slave.failing.map_or(first, |(since, _)| since), now));
        slave.failures += 1;
        if is_silent && slave.presence != Presence::Down {
            (slave.presence, slave.since) = (Presence::Down, now);
        }
        None
    }

    /// Whether a slave is away: since it was last heard, each of its exchanges that used to be answered has failed, or
    /// two of them. If none was ever answered, all count. If one of those that count is periodic, only the periodic
    /// ones count.
    fn is_silent(&self, exchanges: &ExchangesSpec, number: u8) -> bool {
        let rows = exchanges.rows_of(number).filter(|(_, row)| row.is_answered());
        let rows: Vec<_> = rows.map(|(nth, row)| (row.every.is_some(), &self.rows[nth])).collect();
        let was_answered = rows.iter().any(|(_, row)| row.was_answered);
        let mut deciding = rows;
        deciding.retain(|(_, row)| row.was_answered || !was_answered);
        if deciding.iter().any(|(has_period, _)| *has_period) {
            deciding.retain(|(has_period, _)| *has_period);
        }
        let missed = deciding.iter().filter(|(_, row)| row.is_missed).count();
        missed > 0 && missed >= deciding.len().min(2)
    }

    /// Checks that the line is not idle although a period has ended, that every period has its turn, and that slaves
    /// that are away are probed. `stalled` returns for how long the gateway was not called since an instant. Returns
    /// the number of checks.
    pub(super) fn keeps_periods(
        &self,
        port: &PortSpec,
        exchanges: &ExchangesSpec,
        (heard, is_busy): (Instant, bool),
        stalled: impl Fn(Instant) -> Duration,
        now: Instant,
    ) -> Result<u64, Wrong> {
        let mut checked = 0;
        let free = self.free_at.max(heard + port.turnaround).max(self.fault_at);
        for ((nth, row), watch) in exchanges.rows.iter().enumerate().zip(&self.rows) {
            let (Some(every), Some(asked), true) = (row.every, watch.asked, row.is_always_ready()) else {
                continue;
            };
            let Some(slave) = self.slaves.get(&row.slave) else { continue };
            // If no exchange with a device has a reply, its presence stays unknown.
            let is_mute = slave.presence == Presence::Unknown
                && exchanges.rows_of(row.slave).all(|(_, row)| !row.is_answered());
            let is_healthy = slave.presence == Presence::Up && slave.failing.is_none();
            if !is_healthy && !is_mute || self.is_opening(exchanges, row.slave, slave) {
                continue;
            }
            checked += 1;
            let ready = watch.blocked_until.max(watch.retry_at).max(slave.since).max(slave.opened);
            let due = (asked + every).max(free).max(ready);
            let idle = now.saturating_since(due);
            if self.is_free() && !is_busy && idle > IDLE + stalled(due) {
                let what = format!("{}: its period has ended, and the line is free for {idle}", name(row));
                return Err((Invariant::Periods, what));
            }
            let from = asked.max(self.fault_at).max(ready);
            let waits = now.saturating_since(from);
            if waits > every.saturating_mul(2) + exchanges.all_costs + stalled(from) {
                let what = format!("{}: not asked for {waits}", name(&exchanges.rows[nth]));
                return Err((Invariant::Periods, what));
            }
        }
        // A request with values is not sent while one of them is unknown or stale.
        let is_asked = |row: &RowSpec| row.every.is_some() && row.is_always_ready() && row.is_answered();
        let is_wanted = |number: u8| exchanges.rows_of(number).any(|(_, row)| is_asked(row));
        let are_down = self.slaves.iter().filter(|(_, slave)| slave.presence == Presence::Down);
        for (&number, slave) in are_down.filter(|(number, _)| is_wanted(**number)) {
            checked += 1;
            let rows = || exchanges.rows_of(number).map(|(_, row)| row);
            let longest = rows().map(|row| row.timeout).max().unwrap_or_default();
            let late = rows().map(|row| row.late).max().unwrap_or_default();
            let from = slave.asked.max(self.began);
            let waits = now.saturating_since(from);
            let costs = exchanges.all_costs.saturating_mul(2) + late;
            if waits > wait(longest, 6).saturating_mul(2) + costs + stalled(from) {
                return Err((Invariant::Periods, format!("slave {number} is not looked for since {waits}")));
            }
        }
        Ok(checked)
    }

    /// Whether a start exchange of a slave may have to be sent before its others.
    fn is_opening(&self, exchanges: &ExchangesSpec, number: u8, slave: &SlaveWatch) -> bool {
        let starts = |(nth, row): (usize, &RowSpec)| {
            let watch = &self.rows[nth];
            let was_asked = watch.asked.is_some_and(|asked| asked > slave.started.max(self.began));
            row.at_start && (!was_asked || watch.failures > 0)
        };
        self.opening.get(&number).is_some_and(|opening| !opening.is_empty())
            || exchanges.rows_of(number).any(starts)
    }

    /// Since when the exchange could be executed, with no failure on the line; `None` if it cannot be executed now.
    pub(super) fn could_ask(&self, exchanges: &ExchangesSpec, row: usize) -> Option<Instant> {
        let number = exchanges.rows[row].slave;
        let (slave, watch) = (self.slaves.get(&number)?, &self.rows[row]);
        let is_up = slave.presence == Presence::Up && slave.failing.is_none();
        let is_taken = !watch.is_refused && !watch.is_unconfirmed && watch.failures == 0;
        let since = slave.since.max(self.fault_at).max(watch.blocked_until).max(slave.opened);
        let since = since.max(slave.started);
        (is_up && is_taken && !self.is_opening(exchanges, number, slave)).then_some(since.max(self.began))
    }
}

/// The wait after this many failures of a slave or an exchange.
fn wait(timeout: Duration, failures: u32) -> Duration {
    timeout.saturating_mul(1 << failures.min(6)).min(LONGEST_WAIT.max(timeout.saturating_mul(2)))
}

trait Half {
    fn half(self) -> Self;
}

impl Half for Duration {
    fn half(self) -> Self {
        Self::from_micros(self.as_micros() / 2)
    }
}

/// Whether the line echoes, as configured; `None` if the gateway finds out.
fn known(echo: Echo) -> Option<bool> {
    match echo {
        Echo::Yes => Some(true),
        Echo::No => Some(false),
        Echo::Auto => None,
    }
}

/// Names the exchange in messages.
pub(super) fn name(row: &RowSpec) -> String {
    if row.frames.is_some() {
        return format!("exchange {} with device {}", row.nth + 1, row.slave);
    }
    format!("slave {}, function {} at {}", row.slave, row.function, row.address)
}

/// A free line is not idle for longer than this while a request is due.
const IDLE: Duration = Duration::from_millis(5);
/// No wait of a slave or an exchange is longer than this, or than twice the timeout if that is more. Then it is
/// probed if the line has a gap.
const LONGEST_WAIT: Duration = Duration::from_secs(30);
