//! The values that slaves and controller really had, whatever the gateway believes: both ends of each value's route.
//!
//! In: what the slaves of a line did, the controller's registers at each step, the requests that the gateway sent and
//! the replies that it accepted. Out: violations. Does not know timeouts or repetitions.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ops::Range;

use proto_core::config::{FieldSpec, OutputBinding};
use proto_core::device::{Encoding, Overflow};
use proto_core::sysvar::{ModbusPlace, SysVar};
use proto_core::time::{Duration, Instant};

use super::line::{Flight, name};
use crate::oracle::Invariant;
use crate::oracle::device::{self, Look};
use crate::oracle::field::{LineWatch, Verdict, as_number, show};
use crate::oracle::frame::{Raw, shown, size};
use crate::oracle::invariant::Wrong;
use crate::oracle::spec::exchanges::{ExchangesSpec, Kind, RowSpec};
use crate::oracle::spec::{Origin, PortSpec, Spec};
use crate::oracle::varying::look;
use crate::{Done, SlaveDone};

/// The slaves of all lines, and the controller.
#[derive(Debug, Clone, Default)]
pub(in crate::oracle) struct Truth {
    lines: BTreeMap<usize, LineTruth>,
    /// The variables that are sent to slaves, by ordinal.
    histories: Vec<History>,
    /// The part of the controller's image with these variables, as last seen.
    seen: Vec<u8>,
    seen_from: usize,
}

/// The values that the controller had of a variable that is sent to slaves.
#[derive(Debug, Clone)]
struct History {
    var: SysVar,
    /// Its place in the controller's image.
    place: Range<usize>,
    /// Each value, with the time since which the controller had it.
    had: VecDeque<(Instant, Raw)>,
}

/// The slaves of one line.
#[derive(Debug, Clone, Default)]
struct LineTruth {
    answers: VecDeque<Answer>,
    /// Requests that write, as sent by the gateway, and the slaves that have executed them.
    requests: VecDeque<(Instant, usize, Vec<u16>, BTreeSet<u8>)>,
    /// For devices with frames of their own: the newest request of each exchange that the device has accepted.
    took: BTreeMap<usize, Vec<u8>>,
    /// What was written to the slaves, by slave, coils or registers, and address.
    memory: BTreeMap<(u8, bool, u16), u16>,
    /// Slaves that have forgotten what was written, unknown to the gateway.
    forgot: BTreeSet<u8>,
    /// The values that each variable had at its slave.
    held: BTreeMap<usize, VecDeque<(Instant, Raw)>>,
    /// When bytes were last corrupted on the line, or were not sent by one of the simulated slaves.
    garbled: Option<Instant>,
}

#[derive(Debug, Clone)]
struct Answer {
    at: Instant,
    slave: u8,
    place: (u16, u16),
    reply: Vec<u8>,
}

impl Truth {
    pub(in crate::oracle) fn new(spec: &Spec) -> Self {
        let rows = spec
            .ports
            .iter()
            .filter_map(|port| port.exchanges.as_ref())
            .flat_map(|exchanges| &exchanges.rows);
        let mut vars: Vec<SysVar> = rows.flat_map(RowSpec::shown).collect();
        vars.sort_by_key(|var| var.ordinal());
        vars.dedup();
        let histories: Vec<History> = vars
            .into_iter()
            .map(|var| {
                let at = var.image_offset();
                History { var, place: at..at + var.size(), had: VecDeque::new() }
            })
            .collect();
        let seen_from = histories.iter().map(|history| history.place.start).min().unwrap_or_default();
        Self { lines: BTreeMap::new(), histories, seen: Vec::new(), seen_from }
    }

    /// Whether [`Self::sees_controller`] is needed.
    pub(in crate::oracle) fn wants_controller(&self) -> bool {
        !self.histories.is_empty()
    }

    /// Reports the current variables of the controller.
    pub(in crate::oracle) fn sees_controller(&mut self, image: &[u8], now: Instant) {
        // Most steps of a cell change none of these variables.
        if !self.seen.is_empty() && image[self.seen_from..].starts_with(&self.seen) {
            return;
        }
        let end = self.histories.iter().map(|history| history.place.end).max().unwrap_or(self.seen_from);
        self.seen.clear();
        self.seen.extend_from_slice(&image[self.seen_from..end]);
        for History { place, had, .. } in &mut self.histories {
            let mut raw = Raw::default();
            raw[..place.len()].copy_from_slice(&image[place.clone()]);
            if had.back().is_none_or(|newest| newest.1 != raw) {
                had.push_back((now, raw));
            }
        }
    }

    /// Forgets values of the controller that are too old to matter.
    pub(in crate::oracle) fn forget_old(&mut self, now: Instant) {
        for History { had, .. } in &mut self.histories {
            while had.len() > 1 && now.saturating_since(had[1].0) > REMEMBERED {
                had.pop_front();
            }
        }
    }

    /// The values that the controller had of a variable.
    pub(super) fn had(&self, var: SysVar) -> Option<&VecDeque<(Instant, Raw)>> {
        let nth = self.histories.binary_search_by_key(&var.ordinal(), |history| history.var.ordinal());
        nth.ok().map(|nth| &self.histories[nth].had).filter(|had| !had.is_empty())
    }

    pub(in crate::oracle) fn garbled(&mut self, port: usize, now: Instant) {
        self.lines.entry(port).or_default().garbled = Some(now);
    }

    /// The gateway knows that the slave has started.
    pub(super) fn started(&mut self, port: usize, slave: u8) {
        if let Some(line) = self.lines.get_mut(&port) {
            line.forgot.remove(&slave);
        }
    }

    /// The gateway sends a request.
    pub(super) fn asks(&mut self, port: usize, row: usize, spec: &RowSpec, request: &[u8], now: Instant) {
        if !spec.is_written() {
            return;
        }
        let values = spec.values_of(&spec.data_of(request));
        let requests = &mut self.lines.entry(port).or_default().requests;
        requests.push_back((now, row, values, BTreeSet::new()));
        if requests.len() > REQUESTS {
            requests.pop_front();
        }
    }

    /// Whether a frame after `since` may be corrupted although its CRC is valid.
    fn is_excused(&self, port: usize, since: Instant) -> bool {
        let line = self.lines.get(&port);
        line.and_then(|line| line.garbled).is_some_and(|at| at + GARBLED >= since)
    }

    /// A slave did something. Returns the number of checks, and their result.
    pub(super) fn done(
        &mut self,
        spec: &Spec,
        nth: usize,
        done: SlaveDone,
        stalled: impl Fn(Instant) -> Duration,
        now: Instant,
    ) -> (u64, Result<(), Wrong>) {
        let port = &spec.ports[nth];
        let Some(exchanges) = &port.exchanges else { return (0, Ok(())) };
        let slave = done.slave;
        self.forget_old(now);
        match done.what {
            Done::Acted(_) => (0, Ok(())),
            Done::Forgot => {
                let line = self.lines.entry(nth).or_default();
                line.memory.retain(|(of, ..), _| *of != slave);
                line.took.retain(|row, _| exchanges.rows.get(*row).is_some_and(|row| row.slave != slave));
                line.forgot.insert(slave);
                (0, Ok(()))
            }
            Done::Answered { address, count, reply } => {
                for (_, row) in exchanges.rows_of(slave).filter(|(_, row)| {
                    row.function == reply[1] && (row.address, row.count) == (address, count)
                }) {
                    for (var, raw) in values_of(port, row, &reply) {
                        self.holds(nth, var, raw, now);
                    }
                }
                self.answered(nth, Answer { at: now, slave, place: (address, count), reply });
                (0, Ok(()))
            }
            Done::Replied { exchange, frame } => {
                let Some(row) = exchanges.rows.get(exchange) else { return (0, Ok(())) };
                for (var, raw) in values_of(port, row, &frame) {
                    self.holds(nth, var, raw, now);
                }
                let place = (exchange as u16, 0);
                self.answered(nth, Answer { at: now, slave, place, reply: frame });
                (0, Ok(()))
            }
            Done::Took { exchange, request } => {
                if !exchanges.rows.get(exchange).is_some_and(RowSpec::is_written) {
                    return (0, Ok(()));
                }
                let values: Vec<u16> = request.iter().copied().map(u16::from).collect();
                let is_it = |row: &RowSpec| row.nth == exchange;
                let result = self.wrote(spec, (nth, exchanges), (slave, &is_it), &values, stalled, now);
                self.lines.entry(nth).or_default().took.insert(exchange, request);
                (1, result)
            }
            Done::Wrote { coils, address, values } => {
                let is_it = |row: &RowSpec| row.written == Some(address) && row.is_coils() == coils;
                let result = self.wrote(spec, (nth, exchanges), (slave, &is_it), &values, stalled, now);
                let line = self.lines.entry(nth).or_default();
                for (at, value) in (address..).zip(values) {
                    line.memory.insert((slave, coils, at), value);
                }
                (1, result)
            }
        }
    }

    fn answered(&mut self, port: usize, answer: Answer) {
        let answers = &mut self.lines.entry(port).or_default().answers;
        answers.push_back(answer);
        if answers.len() > ANSWERS {
            answers.pop_front();
        }
    }

    fn holds(&mut self, port: usize, var: SysVar, raw: Raw, now: Instant) {
        let held = self.lines.entry(port).or_default().held.entry(var.ordinal()).or_default();
        held.push_back((now, raw));
        while held.front().is_some_and(|(at, _)| now.saturating_since(*at) > REMEMBERED) {
            held.pop_front();
        }
    }

    /// A slave has executed a write of one of these exchanges: the gateway must have sent the request just now, and the
    /// controller must have had its values at the same time, recently.
    fn wrote(
        &mut self,
        spec: &Spec,
        (nth, exchanges): (usize, &ExchangesSpec),
        (slave, is_of): (u8, &dyn Fn(&RowSpec) -> bool),
        values: &[u16],
        stalled: impl Fn(Instant) -> Duration,
        now: Instant,
    ) -> Result<(), Wrong> {
        let is_excused = self.is_excused(nth, now);
        let line = self.lines.entry(nth).or_default();
        let is_it = |(at, row, asked, by): &&mut (Instant, usize, Vec<u16>, BTreeSet<u8>)| {
            let row = &exchanges.rows[*row];
            // The slave had the other bits of a register before.
            let is_asked = asked.len() == values.len()
                && asked.iter().zip(values).all(|(asked, value)| *asked == value & row.mask);
            let is_to_it = row.slave == slave || row.slave == 0;
            let is_there = is_of(row);
            let is_now = now.saturating_since(*at) <= ON_THE_LINE;
            is_to_it && is_there && is_asked && is_now && !by.contains(&slave)
        };
        let Some((at, row, _, by)) = line.requests.iter_mut().rev().find(is_it) else {
            let what = format!("device {slave} took {values:?}, which nobody asked for just now");
            return if is_excused { Ok(()) } else { Err((Invariant::Carried, what)) };
        };
        by.insert(slave);
        let (at, row) = (*at, &exchanges.rows[*row]);
        self.were_had(spec, &spec.ports[nth], row, values, at, stalled(at))
    }

    /// Checks that the controller had the values of a request at the same time, at most the promised time before it.
    fn were_had(
        &self,
        spec: &Spec,
        port: &PortSpec,
        row: &RowSpec,
        values: &[u16],
        asked: Instant,
        stalled: Duration,
    ) -> Result<(), Wrong> {
        if row.request.is_none() {
            return Ok(());
        }
        let data = row.data_from(values);
        // Without a limit, the controller may have had a value at any time that is remembered.
        let lag = match port.stops_when_stale {
            true => {
                // The values of an event are those of the moment at which it happened.
                let waited = if row.kind == Kind::Event { row.trigger } else { Duration::ZERO };
                port.stale_after + way_of(spec, row) + waited + stalled.min(STALL) + STALL
            }
            false => REMEMBERED,
        };
        let from = asked - lag;
        let mut together = vec![(from, asked)];
        for field in fields(row) {
            let (Some(var), Some(place)) = (shown(field.0).next(), data.get(field.1.clone())) else {
                continue;
            };
            let spans = self.spans(var, asked, |raw| agrees(field.0, var, raw, place));
            let spans: Vec<_> =
                spans.into_iter().filter(|(since, until)| *since <= asked && *until >= from).collect();
            if spans.is_empty() {
                let what = format!(
                    "{}: {var} was written as {place:?}, which the controller has not had for {lag}",
                    name(row)
                );
                return Err((Invariant::Carried, what));
            }
            let both = together.iter().flat_map(|one| {
                spans.iter().map(|other| (one.0.max(other.0), one.1.min(other.1))).filter(|(a, b)| a <= b)
            });
            together = both.collect();
        }
        if together.is_empty() && come_together(spec, row) {
            let what = format!("{}: the controller never had {values:?} together", name(row));
            return Err((Invariant::Carried, what));
        }
        Ok(())
    }

    /// The periods in which the controller had values of a variable for which `is_it` is true.
    fn spans(&self, var: SysVar, now: Instant, is_it: impl Fn(Raw) -> bool) -> Vec<(Instant, Instant)> {
        let Some(had) = self.had(var) else { return Vec::new() };
        let ends = had.iter().skip(1).map(|(at, _)| *at).chain([now.max(Instant::ZERO)]);
        let spans = had.iter().zip(ends).filter(|((_, raw), _)| is_it(*raw));
        spans.map(|((since, _), until)| (*since, until)).collect()
    }

    /// The gateway has accepted a reply: its slave must have sent it for this request, after the first transmission.
    pub(super) fn taken(
        &mut self,
        port: (usize, &PortSpec),
        row: &RowSpec,
        flight: &Flight,
        reply: &[u8],
        now: Instant,
    ) -> Result<(), Wrong> {
        let (nth, spec) = port;
        let place = match row.written {
            _ if row.frames.is_some() => (row.nth as u16, 0),
            Some(written) if row.reply.is_none() => (written, row.count),
            _ => (row.address, row.count),
        };
        let is_it = |answer: &&Answer| {
            answer.at >= flight.began
                && answer.slave == row.slave
                && answer.reply == reply
                && answer.place == place
        };
        let line = self.lines.entry(nth).or_default();
        if line.answers.iter().any(|answer| is_it(&answer)) {
            return Ok(());
        }
        if self.is_excused(nth, flight.began) {
            for (var, raw) in values_of(spec, row, reply) {
                self.holds(nth, var, raw, now);
            }
            return Ok(());
        }
        let what = format!("{}: {reply:02x?} was taken, which its slave did not answer to that", name(row));
        Err((Invariant::Held, what))
    }

    /// A value of a slave reaches the controller: the slave must have had it at `since` or later.
    pub(in crate::oracle) fn was_held(
        &self,
        port: usize,
        (var, raw): (SysVar, Raw),
        since: Instant,
        now: Instant,
    ) -> Result<(), Wrong> {
        let held = self.lines.get(&port).and_then(|line| line.held.get(&var.ordinal()));
        let mut held = held.into_iter().flatten();
        if held.any(|(at, value)| *value == raw && *at >= since) {
            return Ok(());
        }
        let what = format!(
            "{var} = {} reaches the controller; its slave has not held that for {}",
            show(var, raw),
            now.saturating_since(since)
        );
        Err((Invariant::Held, what))
    }

    /// Checks that a slave has the controller's values, if these have not changed after `since`. `None` if they have
    /// changed, or if the slave's values are unknown.
    pub(super) fn is_up_to_date(
        &self,
        port: usize,
        row: &RowSpec,
        since: Instant,
    ) -> Option<Result<(), Wrong>> {
        let line = self.lines.get(&port)?;
        if line.forgot.contains(&row.slave) || row.shown().next().is_none() {
            return None;
        }
        let data = match (&row.frames, line.took.get(&row.nth)) {
            (None, _) => line.written(row)?,
            (Some(_), Some(request)) => request.clone(),
            (Some(_), None) if row.at_start || row.every.is_some() => {
                return Some(Err((Invariant::Updated, format!("{}: it was never told", name(row)))));
            }
            (Some(_), None) => return None,
        };
        let mut wrong = None;
        for (field, place) in fields(row) {
            let Some(var) = shown(field).next() else { continue };
            let (at, raw) = *self.had(var)?.back()?;
            if at > since {
                return None;
            }
            let place = data.get(place)?;
            if !agrees(field, var, raw, place) {
                wrong =
                    Some(format!("{}: {var} is {}, but the slave has {place:?}", name(row), show(var, raw)));
            }
        }
        Some(wrong.map_or(Ok(()), |what| Err((Invariant::Updated, what))))
    }

    /// Number of stored entries.
    pub(in crate::oracle) fn len(&self) -> usize {
        let of_line = |line: &LineTruth| {
            line.answers.len() + line.requests.len() + line.held.values().map(VecDeque::len).sum::<usize>()
        };
        self.lines.values().map(of_line).sum::<usize>()
            + self.histories.iter().map(|history| history.had.len()).sum::<usize>()
    }
}

impl LineTruth {
    /// The data that a slave has for an exchange that writes, in the form of a request.
    fn written(&self, row: &RowSpec) -> Option<Vec<u8>> {
        let address = row.written?;
        let there =
            |nth: u16| self.memory.get(&(row.slave, row.is_coils(), address + nth)).copied().unwrap_or(0);
        let len = row.request.as_ref()?.payload;
        let count = if row.is_coils() { row.count } else { (len / 2) as u16 };
        let values: Vec<u16> = (0..count).map(there).collect();
        Some(row.data_from(&values))
    }
}

/// The fields of a request, each with its place in the data.
fn fields(row: &RowSpec) -> Vec<(&FieldSpec, std::ops::Range<usize>)> {
    let Some(request) = &row.request else { return Vec::new() };
    match &request.device {
        Some(device) => request.fields.iter().zip(device.places.iter().cloned()).collect(),
        None => {
            let mut at = 0;
            let places = request.fields.iter().map(|field| {
                let len = size(field);
                at += len;
                at - len..at
            });
            request.fields.iter().zip(places).collect()
        }
    }
}

/// Whether these bytes of a field represent this value of its variable.
fn agrees(field: &FieldSpec, var: SysVar, raw: Raw, bytes: &[u8]) -> bool {
    let (encoding, overflow, from) = match *field {
        FieldSpec::DeviceOutput { encoding, overflow, from } => (encoding, overflow, from),
        FieldSpec::UserOutput { ty, from } => (Encoding::scalar(ty), Overflow::Usual, from),
        _ => return true,
    };
    let number = match from {
        OutputBinding::Variable { scale, offset, .. } => {
            as_number(var, raw) * f64::from(scale) + f64::from(offset)
        }
        OutputBinding::Bit { bit, .. } => f64::from(raw[0] >> bit & 1),
        OutputBinding::Constant(_)
        | OutputBinding::Counter
        | OutputBinding::CounterTo { .. }
        | OutputBinding::Reply
        | OutputBinding::State { .. }
        | OutputBinding::Port { .. }
        | OutputBinding::Link { .. } => return true,
    };
    device::read(&encoding, bytes) == Some(device::shown_as(&encoding, overflow, number))
}

/// The values of the variables in a reply; none in a refusal.
fn values_of(port: &PortSpec, row: &RowSpec, reply: &[u8]) -> Vec<(SysVar, Raw)> {
    let Some(nth) = row.reply else { return Vec::new() };
    // Alive counters do not matter here: the device knows which values it had.
    let (frame, mut apart) = (&port.inputs[nth], LineWatch::default());
    let verdict = match row.frames {
        Some(_) if look(frame, reply) == Look::Frame(reply.len()) => apart.judge(frame, nth, reply),
        // A refusal.
        Some(_) => return Vec::new(),
        None if reply[1] & 0x80 != 0 => return Vec::new(),
        None => apart.judge_data(frame, nth, &reply[3..reply.len() - 2]),
    };
    match verdict {
        Verdict::Accepted(accepted) => accepted.values,
        _ => Vec::new(),
    }
}

/// The longest time that a value takes from the controller to the gateway.
fn way_of(spec: &Spec, row: &RowSpec) -> Duration {
    let is_polled = row.shown().all(|var| spec.origin[var.ordinal()] == Some(Origin::Modbus));
    if is_polled { POLLED } else { STREAMED }
}

/// Whether the gateway reads all values of a request with one poll.
fn come_together(spec: &Spec, row: &RowSpec) -> bool {
    let places: Option<Vec<u16>> = row
        .shown()
        .map(|var| match (spec.origin[var.ordinal()], var.modbus()) {
            (Some(Origin::Modbus), Some(ModbusPlace::Register { address })) => Some(address),
            _ => None,
        })
        .collect();
    places.is_some_and(|places| {
        let (low, high) = (places.iter().min(), places.iter().max());
        low.zip(high).is_some_and(|(low, high)| high - low <= TOGETHER)
    })
}

/// A request is executed within this time after it was sent.
const ON_THE_LINE: Duration = Duration::from_millis(250);
/// A poll is given up after this time.
const POLLED: Duration = Duration::from_millis(500);
/// Longer than any delay of data in a stream.
const STREAMED: Duration = Duration::from_secs(10);
/// A longer stall of the gateway counts as sleep.
const STALL: Duration = Duration::from_millis(500);
/// Registers that are at most this far apart are read with one poll.
const TOGETHER: u16 = 16;
/// For this long after bytes were corrupted on a line, a frame that looks valid may be wrong.
const GARBLED: Duration = Duration::from_secs(1);
/// For how long values are remembered.
const REMEMBERED: Duration = Duration::from_secs(60);
const ANSWERS: usize = 256;
const REQUESTS: usize = 64;
