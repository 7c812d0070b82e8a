//! The events of the simulated controller (docs/control.md section 5): what happened, when, and by whom.
//!
//! In: reports of the rest of the controller. Out: numbered events with the controller's time. Events are kept only
//! after [`Controller::record_events`]; before, recording costs nothing.

use std::collections::VecDeque;

use proto_core::sysvar::{IMAGE_BYTES, SysVar};
use proto_core::time::Instant;
use proto_core::wire::scalar::Scalar;
use proto_core::wire::state::{OperationMode, ProgramState, RobotState, SafetyState};
use serde::Serialize;
use serde_json::Value;

use super::common::{Link, snake};
use super::operations::Operation;
use super::program::End;
use super::registers::Registers;
use super::runs::Run;
use super::{ConnId, Controller};

/// One event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ControllerEvent {
    /// 1, 2, 3, ...
    #[serde(rename = "n")]
    pub number: u64,
    /// The controller's time since its start, in seconds.
    pub time_s: f64,
    /// What happened.
    #[serde(flatten)]
    pub what: Happened,
}

/// The content of an event.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Happened {
    /// The controller was started or restarted.
    Started,
    /// A client was accepted.
    Connected {
        /// The server.
        server: Link,
        /// The connection's number.
        client: u64,
    },
    /// A client has left, or was disconnected.
    Disconnected {
        /// The server.
        server: Link,
        /// The connection's number.
        client: u64,
    },
    /// A command arrived at port 2000.
    Command {
        /// The connection's number.
        client: u64,
        /// The command, in the dialect's form.
        text: String,
    },
    /// A reply was sent from port 2000.
    Reply {
        /// The connection's number.
        client: u64,
        /// The reply without its terminator.
        text: String,
        /// The command; `None` for the notice that a program has finished.
        #[serde(skip_serializing_if = "Option::is_none")]
        to: Option<String>,
    },
    /// The robot state changed.
    Robot {
        /// The state now.
        state: String,
        /// The previous state.
        was: String,
    },
    /// The program state changed.
    ProgramState {
        /// The state now.
        state: String,
        /// The previous state.
        was: String,
    },
    /// The safety state changed.
    Safety {
        /// The state now.
        state: String,
        /// The previous state.
        was: String,
    },
    /// The operation mode changed.
    Mode {
        /// The mode now.
        mode: String,
        /// The previous mode.
        was: String,
    },
    /// The program speed changed.
    Speed {
        /// The new speed, per cent.
        percent: f32,
        /// The previous speed, per cent.
        was: f32,
    },
    /// A program was started.
    ProgramStarted {
        /// The number of the run: 1, 2, 3, ...
        run: u64,
        /// The program's name.
        program: String,
        /// What has started it: `command`, `pendant` or `function`.
        by: &'static str,
    },
    /// A program has ended.
    ProgramEnded(Run),
    /// A program has written a line to the log.
    Log {
        /// The program's name.
        program: String,
        /// The line.
        text: String,
    },
    /// An error is shown by `getlasterror`, and, unless it concerns only one command, in the state stream.
    Error {
        /// The error's number.
        code: u32,
        /// The error's text.
        text: String,
    },
    /// The error was acknowledged.
    ErrorCleared,
    /// A register, an input or an output has another value.
    Write {
        /// The item's name.
        item: String,
        /// The new value.
        value: f64,
        /// The previous value.
        was: f64,
        /// The writer: `modbus`, `program`, `control` or a port's name.
        by: String,
    },
    /// An operation was executed.
    Operation {
        /// The operation, as it was given.
        #[serde(flatten)]
        operation: Value,
    },
    /// An operation of a timeline was refused.
    Refused {
        /// The operation, as it was given.
        #[serde(flatten)]
        operation: Value,
        /// The reason.
        error: String,
    },
}

impl Happened {
    /// The value of `event` in its line.
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::Started => "started",
            Self::Connected { .. } => "connected",
            Self::Disconnected { .. } => "disconnected",
            Self::Command { .. } => "command",
            Self::Reply { .. } => "reply",
            Self::Robot { .. } => "robot",
            Self::ProgramState { .. } => "program_state",
            Self::Safety { .. } => "safety",
            Self::Mode { .. } => "mode",
            Self::Speed { .. } => "speed",
            Self::ProgramStarted { .. } => "program_started",
            Self::ProgramEnded(_) => "program_ended",
            Self::Log { .. } => "log",
            Self::Error { .. } => "error",
            Self::ErrorCleared => "error_cleared",
            Self::Write { .. } => "write",
            Self::Operation { .. } => "operation",
            Self::Refused { .. } => "refused",
        }
    }
}

/// The event in words.
impl std::fmt::Display for Happened {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Started => write!(f, "the controller has started"),
            Self::Connected { server, client } => write!(f, "client {client} connected to {server}"),
            Self::Disconnected { server, client } => write!(f, "client {client} disconnected from {server}"),
            Self::Command { client, text } => write!(f, "client {client} asks: {text}"),
            Self::Reply { client, text, .. } => write!(f, "client {client} gets: {text}"),
            Self::Robot { state, was } => write!(f, "robot: {was} -> {state}"),
            Self::ProgramState { state, was } => write!(f, "program: {was} -> {state}"),
            Self::Safety { state, was } => write!(f, "safety: {was} -> {state}"),
            Self::Mode { mode, was } => write!(f, "mode: {was} -> {mode}"),
            Self::Speed { percent, was } => write!(f, "speed: {was} % -> {percent} %"),
            Self::ProgramStarted { run, program, by } => {
                write!(f, "run {run} of {program} started by {by}")
            }
            Self::ProgramEnded(run) => write!(f, "{run}"),
            Self::Log { program, text } => write!(f, "{program}: {text}"),
            Self::Error { code, text } => write!(f, "error {code:#06x}: {text}"),
            Self::ErrorCleared => write!(f, "the error was cleared"),
            Self::Write { item, value, was, by } => write!(f, "{item}: {was} -> {value} by {by}"),
            Self::Operation { operation } => write!(f, "done: {operation}"),
            Self::Refused { operation, error } => write!(f, "refused: {operation}: {error}"),
        }
    }
}

#[derive(Debug, Default)]
pub(super) struct Recorder {
    on: bool,
    /// Maximum number of kept writes, and of kept other events.
    max: usize,
    next: u64,
    kept: VecDeque<ControllerEvent>,
    /// Writes are stored separately, so a fast recipe does not displace other events.
    writes: VecDeque<ControllerEvent>,
    /// Number of the newest event that was dropped.
    dropped: u64,
    shown: Option<ReportedStates>,
    /// The time of the newest call.
    now: Instant,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct ReportedStates {
    robot: RobotState,
    program: ProgramState,
    safety: SafetyState,
    mode: OperationMode,
    speed: f32,
}

pub(super) struct Before {
    image: Box<[u8; IMAGE_BYTES]>,
    analog: ([u16; 8], [u16; 2]),
}

impl Recorder {
    pub(super) fn is_on(&self) -> bool {
        self.on
    }

    pub(super) fn set_now(&mut self, now: Instant) {
        self.now = now;
    }

    pub(super) fn now(&self) -> Instant {
        self.now
    }

    fn keep(&mut self, time_s: f64, what: Happened) {
        self.next += 1;
        let kept = if matches!(what, Happened::Write { .. }) { &mut self.writes } else { &mut self.kept };
        if kept.len() >= self.max
            && let Some(oldest) = kept.pop_front()
        {
            self.dropped = self.dropped.max(oldest.number);
        }
        kept.push_back(ControllerEvent { number: self.next, time_s, what });
    }

    /// The values before a write; `None` while nothing is recorded.
    pub(super) fn before(&self, registers: &Registers) -> Option<Before> {
        self.on.then(|| Before { image: Box::new(*registers.image()), analog: registers.analog_outputs() })
    }
}

impl Controller {
    /// Keeps events from now on, for [`Self::events_since`].
    pub fn record_events(&mut self) {
        self.quiet.ends();
        self.record_newest_events(MAX_EVENTS);
    }

    /// As [`Self::record_events`], with another maximum number of kept events, for writes and for all others.
    pub fn record_newest_events(&mut self, max: usize) {
        self.quiet.ends();
        (self.recorder.on, self.recorder.max) = (true, max.max(1));
    }

    /// The kept events with this number or a later one, oldest first.
    pub fn events_since(&self, number: u64) -> impl Iterator<Item = &ControllerEvent> {
        let from =
            |events: &'_ VecDeque<ControllerEvent>| events.partition_point(|event| event.number < number);
        let (others, writes) = (&self.recorder.kept, &self.recorder.writes);
        let mut others = others.range(from(others)..).peekable();
        let mut writes = writes.range(from(writes)..).peekable();
        std::iter::from_fn(move || match (others.peek(), writes.peek()) {
            (Some(other), Some(write)) if write.number < other.number => writes.next(),
            (Some(_), _) => others.next(),
            (None, _) => writes.next(),
        })
    }

    /// The number of the newest event, 0 before the first.
    pub fn newest_event(&self) -> u64 {
        self.recorder.next
    }

    /// The number of the newest event that is no longer kept, 0 if all are.
    pub fn dropped_events(&self) -> u64 {
        self.recorder.dropped
    }

    /// The controller's time since its start, in seconds.
    pub fn time_s(&self, now: Instant) -> f64 {
        now.saturating_since(self.epoch.unwrap_or(now)).as_micros() as f64 / 1e6
    }

    pub(super) fn happened(&mut self, now: Instant, what: impl FnOnce() -> Happened) {
        if self.recorder.on {
            let time_s = self.time_s(now);
            self.recorder.keep(time_s, what());
        }
    }

    /// Records how the running program has ended.
    pub(super) fn run_over(&mut self, now: Instant, program: &str, end: Option<&End>) {
        let time_s = self.time_s(now);
        let run = self.runs.end(program, end, time_s);
        self.happened(now, || Happened::ProgramEnded(run));
    }

    pub(super) fn client_event(&mut self, now: Instant, link: Link, conn: ConnId, came: bool) {
        let (server, client) = (link, conn.0);
        self.happened(now, || match came {
            true => Happened::Connected { server, client },
            false => Happened::Disconnected { server, client },
        });
    }

    pub(super) fn operation_done(&mut self, now: Instant, operation: &Operation) {
        self.happened(now, || Happened::Operation {
            operation: serde_json::to_value(operation).unwrap_or(Value::Null),
        });
    }

    /// Records a refused operation that has no caller to answer, such as a step of a timeline.
    pub fn note_refused(&mut self, now: Instant, operation: &Operation, error: &str) {
        self.quiet.ends();
        self.happened(now, || Happened::Refused {
            operation: serde_json::to_value(operation).unwrap_or(Value::Null),
            error: error.to_owned(),
        });
    }

    /// Records changes of the state machines and errors since the last call.
    pub(super) fn note_states(&mut self, now: Instant) {
        let errors = self.machine.take_errors();
        if !self.recorder.on {
            return;
        }
        let machine = &self.machine;
        let shown = ReportedStates {
            robot: machine.robot(),
            program: machine.program(),
            safety: machine.safety(),
            mode: machine.mode(),
            speed: machine.speed_percent(),
        };
        for error in errors {
            self.happened(now, || match error {
                Some(error) => Happened::Error { code: error.id.code(), text: error.message },
                None => Happened::ErrorCleared,
            });
        }
        let Some(was) = self.recorder.shown.replace(shown) else {
            return self.happened(now, || Happened::Started);
        };
        if was.mode != shown.mode {
            let (mode, was) = (snake(shown.mode.name()), snake(was.mode.name()));
            self.happened(now, || Happened::Mode { mode, was });
        }
        if was.safety != shown.safety {
            let (state, was) = (snake(shown.safety.name()), snake(was.safety.name()));
            self.happened(now, || Happened::Safety { state, was });
        }
        if was.robot != shown.robot {
            let (state, was) = (snake(shown.robot.name()), snake(was.robot.name()));
            self.happened(now, || Happened::Robot { state, was });
        }
        if was.program != shown.program {
            let (state, was) = (snake(shown.program.name()), snake(was.program.name()));
            self.happened(now, || Happened::ProgramState { state, was });
        }
        if was.speed != shown.speed {
            let (percent, was) = (shown.speed, was.speed);
            self.happened(now, || Happened::Speed { percent, was });
        }
    }

    /// Records the changes since `before`.
    pub(super) fn note_writes(&mut self, now: Instant, before: Option<Before>, by: &str) {
        let Some(before) = before else { return };
        let image = *self.registers.image();
        let analog = self.registers.analog_outputs();
        if image == *before.image && analog == before.analog {
            return;
        }
        for var in SysVar::all() {
            for (item, was, value) in changes(var, &before.image, &image) {
                self.happened(now, || Happened::Write { item, value, was, by: by.to_owned() });
            }
        }
        let cabinet = before.analog.0.iter().zip(analog.0).zip(1..).map(|pair| ("AO", pair));
        let tool = before.analog.1.iter().zip(analog.1).zip(1..).map(|pair| ("ToolAO", pair));
        for (group, ((was, value), nth)) in cabinet.chain(tool) {
            if *was != value {
                let (was, value) = (f64::from(*was), f64::from(value));
                let item = format!("{group}[{nth}]");
                self.happened(now, || Happened::Write { item, value, was, by: by.to_owned() });
            }
        }
    }
}

/// Name, previous value and new value of each change in a variable.
fn changes(var: SysVar, before: &[u8; IMAGE_BYTES], now: &[u8; IMAGE_BYTES]) -> Vec<(String, f64, f64)> {
    let place = var.image_offset()..var.image_offset() + var.size();
    let (Some(was), Some(is)) = (before.get(place.clone()), now.get(place)) else { return Vec::new() };
    if was == is {
        return Vec::new();
    }
    if let ([was], [is]) = (was, is) {
        let bits = (0..8).filter(|bit| (was ^ is) >> bit & 1 == 1);
        let named = bits.filter_map(|bit| {
            let value = |byte: u8| f64::from(byte >> bit & 1);
            Some((bit_name(var, bit)?, value(*was), value(*is)))
        });
        return named.collect();
    }
    let value = |bytes: &[u8]| Scalar::decode(var.ty(), bytes).map_or(f64::NAN, Scalar::as_f64);
    vec![(var.to_string(), value(was), value(is))]
}

/// The common name of a bit; `None` for the status of an output, which follows its command.
fn bit_name(var: SysVar, bit: u8) -> Option<String> {
    let nth = bit + 1;
    Some(match (var.group(), var.index()) {
        ("DigitalSignalStatus", 4..=6) => return None,
        ("DigitalSignalStatus", byte @ 1..=2) => format!("DI[{}]", 8 * (byte - 1) + nth),
        ("DigitalSignalStatus", 3) => format!("ToolDI[{nth}]"),
        ("DigitalSignalStatus", 7) => format!("FDI[{nth}]"),
        ("DigitalSignalStatus", 8) => format!("FDO[{nth}]"),
        ("DigitalOutputCommand", byte @ 1..=2) => format!("DO[{}]", 8 * (byte - 1) + nth),
        ("DigitalOutputCommand", 3) => format!("ToolDO[{nth}]"),
        _ => format!("{var}.{bit}"),
    })
}

/// Number of writes, and of other events, that [`Controller::record_events`] keeps.
pub const MAX_EVENTS: usize = 20_000;
