//! Judges what devices executed by two logs: the device's own, and the robot's (docs/cell.md section 5).
//!
//! In: what each device did and when, from its own decoding of the requests; the controller's registers whenever they
//! change, and which of them it has sent to whom. Out: violations. Does not know the engine, or what became of the
//! configuration: the promises of a cell are written by hand in [`Rules`]. Of the gateway it knows when it starts and
//! when it is not called, and of the line when it had a fault, because the device causes none of these.

mod axis;
mod conveyor;
mod device;
mod drive;
mod gripper;
mod mood;
mod program;
mod rfid;
mod robot;
mod rtu;
mod rules;
mod tcp;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, VecDeque};

use proto_core::config::GatewayConfig;
use proto_core::engine::{LinkId, PortId};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

pub(crate) use program::Program;
pub(crate) use rules::Rules;

use crate::{Act, Cell, Invariant, Order, Rng, Violation};
use robot::Robot;
use rules::{MOVE_BIT, STOP_BIT, Source};

/// Judges one cell.
#[derive(Debug)]
pub(crate) struct Judge {
    rules: Rules,
    robot: Robot,
    /// The device's values, each with the time since which it holds.
    held: Vec<VecDeque<(Instant, u16)>>,
    /// The device's values in the robot's registers, as last seen.
    shown: Vec<Option<u16>>,
    /// The executed events, in the order of the rises that caused them.
    moved: VecDeque<Moved>,
    /// A stop that has to be executed.
    stop: Option<Pending>,
    stop_heard: Option<Instant>,
    /// How often the device may still get its start order.
    starts: u32,
    began: Instant,
    /// When the device last sent a reply in time that differs from the request, on a line without faults.
    replied: Option<Instant>,
    /// The value that the device was told to keep. `refused`: when it last refused one, and with which code.
    kept: Option<u32>,
    refused: Option<(Instant, u8)>,
    is_on: bool,
    /// When something last went wrong with the line or the device.
    quiet_since: Instant,
    /// When that last happened, or a reply to the value to keep was missing, late or damaged, or no reply came in time.
    trouble: Instant,
    /// When a reply was last sent in time.
    in_time: Instant,
    is_faulty: bool,
    outcomes: BTreeMap<&'static str, u64>,
    counted: BTreeMap<&'static str, u32>,
    checks: BTreeMap<Invariant, u64>,
    violation: Option<Violation>,
}

/// An event that was executed.
#[derive(Debug, Clone, Copy)]
struct Moved {
    at: Instant,
    /// Since when the values of the event are valid.
    from: Instant,
    /// When a valid reply to it was sent.
    replied: Option<Instant>,
    /// The step after it was executed.
    stepped: bool,
}

/// A stop that the controller has sent to the gateway.
#[derive(Debug, Clone, Copy)]
struct Pending {
    /// When the controller sent the reply with the stop. `known`: when the gateway had received that reply.
    at: Instant,
    known: Option<Instant>,
    conn: u64,
    /// Number of other requests that the device has received since.
    others: u32,
}

impl Judge {
    pub(crate) fn new(rules: Rules, now: Instant) -> Self {
        let values = rules.values.len();
        let mut judge = Self {
            robot: Robot::new(&rules),
            rules,
            held: vec![VecDeque::new(); values],
            shown: vec![None; values],
            moved: VecDeque::new(),
            stop: None,
            stop_heard: None,
            starts: 0,
            began: now,
            replied: None,
            kept: None,
            refused: None,
            is_on: true,
            quiet_since: now,
            trouble: now,
            in_time: now,
            is_faulty: false,
            outcomes: BTreeMap::new(),
            counted: BTreeMap::new(),
            checks: BTreeMap::new(),
            violation: None,
        };
        judge.port_begins(now);
        judge
    }

    pub(crate) fn violation(&self) -> Option<&Violation> {
        self.violation.as_ref()
    }

    pub(crate) fn checks(&self) -> &BTreeMap<Invariant, u64> {
        &self.checks
    }

    /// How often each outcome of an event was counted.
    pub(crate) fn outcomes(&self) -> &BTreeMap<&'static str, u64> {
        &self.outcomes
    }

    /// The gateway has started.
    pub(crate) fn gateway_starts(&mut self, now: Instant) {
        self.counted.clear();
        self.robot.gateway_starts(now);
        self.stop = None;
        self.port_begins(now);
    }

    /// The gateway is called again after a stall that counts as sleep.
    pub(crate) fn gateway_wakes(&mut self, now: Instant) {
        self.robot.gateway_wakes(now);
        self.not_called(now);
        // If the gateway does not have the stop yet, it will read it again.
        self.stop = self.stop.filter(|stop| stop.known.is_some());
    }

    /// The gateway's port is up, for the first time or again.
    pub(crate) fn port_begins(&mut self, now: Instant) {
        (self.starts, self.began, self.replied) = (1, now, None);
        self.note_fault(now);
    }

    /// The line, or the port of the gateway, has a fault at this instant.
    pub(crate) fn note_fault(&mut self, now: Instant) {
        (self.quiet_since, self.trouble) = (now, now);
    }

    /// The gateway is not called at this instant.
    pub(crate) fn not_called(&mut self, now: Instant) {
        self.robot.not_called = now;
    }

    /// Reports the current variables of the controller.
    pub(crate) fn sees_controller(&mut self, image: &[u8], now: Instant) {
        if self.violation.is_some() {
            return;
        }
        self.robot.sees(image, now);
        for nth in 0..self.rules.values.len() {
            let value = robot::word(image, self.rules.values[nth]);
            if self.shown[nth].replace(value) == Some(value) {
                continue;
            }
            if self.shown[nth].is_some() && value != 0 && value != self.rules.safe {
                let result = self.was_held(nth, value, now);
                self.judge(Invariant::DeviceValues, result, now);
            }
        }
    }

    /// Bytes of a Modbus connection arrived at the controller.
    pub(crate) fn asked(&mut self, conn: u64, bytes: &[u8], now: Instant) {
        self.robot.asked(conn, bytes, now);
    }

    /// The controller sends bytes on a connection.
    pub(crate) fn answered(&mut self, conn: u64, bytes: &[u8], now: Instant) {
        for at in self.robot.answered(conn, bytes, now, self.stop_heard) {
            // Until the device has received the stop, each new one replaces it.
            self.stop = Some(Pending { at, known: None, conn, others: 0 });
        }
    }

    /// Reports an act of the device.
    pub(crate) fn did(&mut self, act: Act, now: Instant) {
        if self.violation.is_some() {
            return;
        }
        match act {
            Act::Heard(Some(Order::Stop)) => {
                self.stop_heard = Some(now);
                self.stop = None;
            }
            Act::Heard(_) => self.hears_another(now),
            Act::Did(Order::Move, values) => {
                let result = self.moves(&values, now);
                self.judge(Invariant::EventsOnce, result, now);
            }
            Act::Did(Order::Step, values) => {
                let result = self.steps(&values, now);
                self.judge(Invariant::EventsOnce, result, now);
            }
            Act::Did(Order::Stop, _) => {}
            Act::Did(Order::Start, _) => {
                if self.starts == 0 && self.is_away(now) {
                    // This is the first request that the device receives, and until now nothing was heard of the
                    // device.
                    (self.starts, self.replied) = (1, Some(now));
                }
                let result = match self.starts.checked_sub(1) {
                    Some(left) => {
                        self.starts = left;
                        Ok(())
                    }
                    None => Err("the device was started again, and nothing says that it has started".into()),
                };
                self.judge(Invariant::StartsOnce, result, now);
            }
            Act::Did(Order::Keep, values) => self.kept = values.first().copied(),
            Act::Refused(Order::Keep, code) => self.refused = Some((now, code)),
            Act::Refused(..) => {}
            Act::Replied { order, tells, is_whole, in_time } => {
                if order == Some(Order::Keep) && !in_time {
                    self.trouble = now;
                }
                if in_time {
                    self.in_time = now;
                }
                if let Some(moved) = self.moved.back_mut().filter(|moved| is_whole && moved.replied.is_none())
                {
                    moved.replied = Some(now);
                }
                self.replies(is_whole, in_time && tells, now);
            }
            Act::Garbled => {
                if self.is_away(now) {
                    self.starts = 1;
                }
            }
            Act::Holds(nth, value) => {
                self.held[nth].push_back((now, value));
                while self.held[nth].len() > 1 && now.saturating_since(self.held[nth][1].0) > REMEMBERED {
                    self.held[nth].pop_front();
                }
            }
            Act::PowerOff => {
                (self.is_on, self.kept) = (false, None);
                self.note_fault(now);
            }
            Act::PowerOn => {
                self.is_on = true;
                self.note_fault(now);
            }
        }
    }

    fn judge(&mut self, invariant: Invariant, result: Result<(), String>, now: Instant) {
        *self.checks.entry(invariant).or_default() += 1;
        if let (Err(what), None) = (result, &self.violation) {
            self.violation = Some(Violation { invariant, at: now, what });
        }
    }

    /// A value of the device reaches the robot: checks that the device had it recently enough.
    fn was_held(&self, nth: usize, value: u16, now: Instant) -> Result<(), String> {
        let since = now - self.rules.value_age;
        let mut ends: Vec<Instant> = self.held[nth].iter().skip(1).map(|(at, _)| *at).collect();
        ends.push(now);
        let was = self.held[nth].iter().zip(ends).any(|((_, held), end)| *held == value && end >= since);
        if was {
            return Ok(());
        }
        let var = self.rules.values[nth];
        Err(format!(
            "{var} became {value:#06x}, which the device did not hold within {}",
            self.rules.value_age
        ))
    }

    /// The device executes an event: the bit must have risen recently, and for no other execution.
    fn moves(&mut self, values: &[u32], now: Instant) -> Result<(), String> {
        let rules = &self.rules;
        let found = self.robot.rise_for(rules, values, self.stop_heard, now)?;
        for (source, value) in rules.moves.0.iter().zip(values) {
            if let Source::Own(nth) = source
                && !u16::try_from(*value).is_ok_and(|value| self.was_held(*nth, value, now).is_ok())
            {
                return Err(format!("it was told {value:#06x} as its own value, which it did not hold"));
            }
        }
        if let Some(stop) = found.stop
            && self.stop_heard.is_none_or(|heard| heard < stop)
        {
            let what = format!(
                "it moved by a rise that was read {} after a stop that it has not heard of",
                found.read.saturating_since(stop)
            );
            self.judge(Invariant::StopsFirst, Err(what), now);
        }
        *self.checks.entry(Invariant::StopsFirst).or_default() += 1;
        self.moved.push_back(Moved { at: now, from: found.read, replied: None, stepped: false });
        if self.moved.len() > MOVES {
            self.moved.pop_front();
        }
        Ok(())
    }

    /// The device executes the second step: it must follow the first, with a reply between, with values that the robot
    /// had during the first.
    fn steps(&mut self, values: &[u32], now: Instant) -> Result<(), String> {
        let Some((sources, trigger)) = self.rules.step.as_ref() else { return Ok(()) };
        let Some(first) = self.moved.back_mut() else { return Err("a second step without a first".into()) };
        let Some(replied) = first.replied else {
            return Err("the second step was carried out, and no good reply to the first has left".into());
        };
        if std::mem::replace(&mut first.stepped, true) {
            return Err("the second step was carried out twice".into());
        }
        let waited = now.saturating_since(replied);
        let transport = self.robot.transport(&self.rules, replied);
        if waited > *trigger + STALL + ON_THE_LINE + transport {
            return Err(format!("the second step was carried out {waited} after the first"));
        }
        let (from, until) = (first.from, first.at);
        if !self.robot.had(sources, values, from, until) {
            return Err(format!("the second step has {values:?}, which the robot did not have at the first"));
        }
        Ok(())
    }

    fn hears_another(&mut self, now: Instant) {
        let grace = ON_THE_LINE;
        let Some(stop) = &mut self.stop else { return };
        if stop.known.is_none_or(|known| now <= known + grace) {
            return;
        }
        stop.others += 1;
        if stop.others > OTHERS {
            let what = format!("it has heard {} other requests since it was to stop", stop.others);
            self.judge(Invariant::StopsFirst, Err(what), now);
        }
    }

    /// Whether the device was not heard for so long that, for the gateway, it has started again.
    fn is_away(&self, now: Instant) -> bool {
        let unheard = now.saturating_since(self.replied.unwrap_or(self.began));
        unheard + SLACK >= self.rules.absent
    }

    fn replies(&mut self, is_whole: bool, tells: bool, now: Instant) {
        if !is_whole {
            return;
        }
        if self.is_away(now) {
            self.starts = 1;
        }
        // On a faulty line the reply may be lost.
        if tells && !self.is_faulty {
            self.replied = Some(now);
        }
    }

    /// Called at intervals. `is_faulty`: the line has noise or is cut, or the gateway is not called.
    pub(crate) fn survey(&mut self, is_faulty: bool, now: Instant) {
        if self.violation.is_some() {
            return;
        }
        self.is_faulty = is_faulty;
        if is_faulty {
            self.note_fault(now);
        }
        if let Some(stop) = &mut self.stop {
            stop.known = stop.known.or_else(|| self.robot.taken(stop.conn, stop.at));
            let since = stop.known.map(|known| known.max(self.quiet_since));
            if let Some(since) = since.filter(|_| self.is_on) {
                let waits = now.saturating_since(since);
                let result = match waits > STOPS_WITHIN {
                    true => Err(format!("it was to stop, and has not heard of it for {waits}")),
                    false => Ok(()),
                };
                self.judge(Invariant::StopsFirst, result, now);
            }
        }
        if now.saturating_since(self.in_time) > AWAY {
            self.trouble = now;
        }
        if let Some(result) = self.keeps(now) {
            self.judge(Invariant::DeviceKeeps, result, now);
        }
        self.robot.forget(now);
    }

    /// Checks that the gateway has a connection, if it could have had one for long enough.
    fn connects(&mut self, missed: Duration, now: Instant) {
        if missed > CONNECTS_WITHIN {
            let what = format!("the gateway has had no connection to it for {missed}, and could");
            self.judge(Invariant::DeviceKeeps, Err(what), now);
        }
    }

    /// Whether the device keeps the value that the robot has had for long. `None` if something excuses a difference.
    fn keeps(&self, now: Instant) -> Option<Result<(), String>> {
        let var = self.rules.keeps?;
        let kept = self.kept.filter(|_| self.is_on)?;
        let (changed, value) = self.robot.rests(var)?;
        let mut since = changed.max(self.trouble);
        if let Some((at, code)) = self.refused {
            // After a final refusal, the value is not sent again until it changes.
            if at >= changed && !matches!(code, 4 | 6 | 8 | 10 | 11) {
                return None;
            }
            since = since.max(at);
        }
        if now.saturating_since(since) < KEEPS_WITHIN || !self.robot.is_read_steadily(var, since, now) {
            return None;
        }
        Some(match kept == u32::from(value) {
            true => Ok(()),
            false => {
                Err(format!("it keeps {kept}; {var} has been {value} for {}", now.saturating_since(since)))
            }
        })
    }

    /// Adds the gateway's counters of outcomes.
    pub(crate) fn count(&mut self, counters: impl IntoIterator<Item = (&'static str, u32)>) {
        for (name, count) in counters {
            let before = self.counted.insert(name, count).unwrap_or(0);
            *self.outcomes.entry(name).or_default() += u64::from(count.saturating_sub(before));
        }
    }
}

impl Cell {
    /// From now on, judges what the device of a cell executes by its own log and the robot's. Time stops after the
    /// first violation. Call it before time advances.
    pub(crate) fn judge_device(&mut self, rules: Rules) {
        self.judge = Some(Box::new(Judge::new(rules, self.now)));
        self.queue.push(self.now, crate::due::Due::Survey);
    }

    /// How often each outcome of an event was counted.
    pub fn outcomes(&self) -> BTreeMap<&'static str, u64> {
        self.judge.as_ref().map(|judge| judge.outcomes().clone()).unwrap_or_default()
    }

    /// Lets the judge check the line, and reads the gateway's counters.
    pub(crate) fn survey_device(&mut self) {
        let is_asleep = self.is_asleep();
        let is_faulty = is_asleep || self.is_line_faulty();
        let missed = self.misses_device_for();
        self.count_outcomes();
        let now = self.now;
        if let Some(judge) = &mut self.judge {
            if is_asleep {
                judge.not_called(now);
            }
            judge.survey(is_faulty, now);
            judge.connects(missed, now);
        }
    }

    fn is_line_faulty(&self) -> bool {
        self.lines.iter().any(|line| line.noise_ppm > 0 || !line.connected || !line.is_plugged)
            || self.buses.iter().any(|bus| bus.loss_ppm > 0 || !bus.connected || bus.is_off)
            || self.is_device_faulty()
    }

    /// Reads the gateway's counters of outcomes: before the gateway restarts, and at intervals.
    pub(crate) fn count_outcomes(&mut self) {
        let Some(judge) = &mut self.judge else { return };
        let mut sums: BTreeMap<&'static str, u32> = BTreeMap::new();
        let status = self.engine.status(self.now);
        for peer in status.ports().flat_map(|port| port.peers().collect::<Vec<_>>()) {
            let events = peer.counters.events;
            for (name, count) in [
                ("done", events.done),
                ("refused", events.refused),
                ("accepted", events.accepted),
                ("unknown", events.unknown),
                ("expired", events.expired),
                ("out-of-limits", events.out_of_limits),
                ("no-value", events.no_value),
                ("away", events.away),
                ("still-open", events.still_open),
                ("stopped", events.stopped),
                ("not-followed", events.not_followed),
            ] {
                *sums.entry(name).or_default() += count;
            }
        }
        judge.count(sums);
    }
}

/// The kinds of judged devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A gripper on Modbus RTU.
    Gripper,
    /// An axis on Modbus RTU, with a motion in two steps.
    Axis,
    /// An RFID head with text frames.
    Rfid,
    /// A drive on CANopen.
    Drive,
    /// A conveyor on Modbus TCP, with a motion in two steps and two units.
    Conveyor,
}

impl Kind {
    /// All kinds.
    pub(crate) const ALL: [Self; 5] = [Self::Gripper, Self::Axis, Self::Rfid, Self::Drive, Self::Conveyor];

    /// The kind in the embedded cell of this name.
    pub(crate) fn of(cell: &str) -> Option<Self> {
        Some(match cell {
            "judged-gripper" => Self::Gripper,
            "judged-axis" => Self::Axis,
            "judged-rfid" => Self::Rfid,
            "judged-drive" => Self::Drive,
            "judged-modbus-tcp" => Self::Conveyor,
            _ => return None,
        })
    }

    /// Connects the device and starts judging it. Returns the robot's program.
    pub(crate) fn begin(self, cell: &mut Cell, config: &GatewayConfig, mut rng: Rng) -> Program {
        let rules = match self {
            Self::Gripper => gripper::rules(),
            Self::Axis => axis::rules(),
            Self::Rfid => rfid::rules(),
            Self::Drive => drive::rules(),
            Self::Conveyor => conveyor::rules(),
        };
        let (now, own) = (cell.now(), rng.fork());
        let name = config.ports.first().map_or("", |port| port.name.as_str()).to_owned();
        match self {
            Self::Gripper => {
                let line = cell.line_of(&name);
                cell.attach(line, gripper::device(own, now));
            }
            Self::Axis => {
                let line = cell.line_of(&name);
                cell.attach(line, axis::device(own, now));
            }
            Self::Rfid => {
                let line = cell.line_of(&name);
                cell.attach(line, rfid::Head::new(own, now));
            }
            Self::Drive => {
                let bus = cell.bus_of(&name);
                cell.attach_can(bus, drive::Drive::new(own, now));
            }
            Self::Conveyor => cell.attach_server(LinkId::of_port(PortId(0)), conveyor::device(own, now)),
        }
        let program = Program::new(&rules, now, rng.fork());
        cell.judge_device(rules);
        program
    }
}

/// The names of all outcomes of events.
pub const OUTCOMES: [&str; 11] = [
    "done",
    "refused",
    "accepted",
    "unknown",
    "expired",
    "out-of-limits",
    "no-value",
    "away",
    "still-open",
    "stopped",
    "not-followed",
];

/// The bits that request a motion and a stop, with their variable.
pub(crate) fn bits() -> (SysVar, u8, u8) {
    (rules::var("BitOutputReg[3]"), MOVE_BIT, STOP_BIT)
}

/// Older values of the device are not needed.
const REMEMBERED: Duration = Duration::from_secs(10);
const MOVES: usize = 16;
/// A request arrives at its device at most this long after it was sent.
const ON_THE_LINE: Duration = Duration::from_millis(100);
/// A longer stall of the gateway counts as sleep, after which nothing is continued.
const STALL: Duration = Duration::from_millis(500);
/// Without faults of the line and the device, a stop arrives within this time.
const STOPS_WITHIN: Duration = Duration::from_millis(800);
/// If more other requests than this have arrived, the stop was not merely lost by chance.
const OTHERS: u32 = 12;
/// The device has a new value within this time: the longest wait after refusals, plus the late time.
const KEEPS_WITHIN: Duration = Duration::from_secs(7);
/// The gateway reconnects within this time: its longest wait, a failed attempt, and a retransmission by TCP.
const CONNECTS_WITHIN: Duration = Duration::from_secs(8);
/// A device that replies at least this often never counts as away.
const AWAY: Duration = Duration::from_millis(500);
/// How much the two ends may differ about the length of an absence.
const SLACK: Duration = Duration::from_millis(100);
