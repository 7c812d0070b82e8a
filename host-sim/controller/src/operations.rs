//! Operations at run time (docs/control.md section 2): what a person at the pendant, a cable that breaks, or a
//! test does to the controller.
//!
//! In: an [`Operation`], as JSON by serde. Out: its result as JSON, or why it was refused; a refused operation
//! has changed nothing. The way it came in is its caller's.

use std::collections::BTreeMap;

use proto_core::command::{Action, Percent};
use proto_core::modbus::Exception;
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::OperationMode;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::Controller;
use super::condition::Condition;
use super::events::KINDS;
use super::faults::Link;
use super::program::Script;
use recipe_config::InitialTarget;

/// An operation. In JSON its name is the value of `do`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Operation {
    /// The state (docs/control.md section 3).
    State {},
    /// The values of these items.
    Get {
        /// Their names.
        items: Vec<String>,
    },
    /// The counters of `--stats`.
    Counters {},
    /// The programs' names.
    Programs {},
    /// The kept events.
    Events {
        /// From this number on.
        #[serde(default)]
        since: u64,
        /// Only these kinds; all if it is empty.
        #[serde(default)]
        kinds: Vec<String>,
        /// At most so many.
        #[serde(default = "default_max")]
        max: usize,
    },
    /// Each event from now on, to the caller. [`Controller::operate`] refuses it: the caller follows.
    Follow {
        /// Only these kinds; all if it is empty.
        #[serde(default)]
        kinds: Vec<String>,
    },
    /// Sets items: all of them, or none.
    Set {
        /// Name and value of each.
        items: BTreeMap<String, Number>,
    },
    /// Turns the key.
    Mode {
        /// The mode.
        mode: Mode,
    },
    /// Presses the emergency stop.
    EmergencyStop {},
    /// Opens a safety door.
    ProtectiveStop {},
    /// Makes the arm collide.
    Collide {
        /// The axis, 1 to 6.
        axis: u8,
    },
    /// Releases and acknowledges a stop.
    Clear {},
    /// Somebody enters or leaves a zone of reduced speed.
    Reduced {
        /// Whether somebody is in it.
        on: bool,
    },
    /// Shows an error.
    RaiseError {
        /// Its number; not 0.
        code: u32,
        /// Its text.
        #[serde(default)]
        text: String,
    },
    /// Acknowledges the shown error.
    ClearError {},
    /// The pendant's button.
    PowerOn {},
    /// The pendant's button.
    PowerOff {},
    /// The pendant's button.
    Enable {},
    /// The pendant's button.
    Disable {},
    /// Starts a program.
    Run {
        /// Its name.
        program: String,
        /// The speed; the present one if it is absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        speed_percent: Option<f32>,
    },
    /// Stops the program.
    Stop {},
    /// Pauses the program.
    Pause {},
    /// Lets the program go on.
    Resume {},
    /// Adds or replaces a program.
    Upload {
        /// Its name.
        program: String,
        /// Its text.
        script: String,
    },
    /// Removes a program.
    Remove {
        /// Its name.
        program: String,
    },
    /// Assigns a recipe to a port.
    Recipe {
        /// The port's name.
        port: String,
        /// The recipe's name; `None` for no recipe.
        recipe: Option<String>,
    },
    /// Sets a port's cycle.
    Cycle {
        /// The port's name.
        port: String,
        /// Milliseconds, at least 4.
        ms: f64,
    },
    /// Switches the controller off and on.
    Restart {
        /// The registers after it.
        #[serde(default)]
        registers: AfterRestart,
    },
    /// Begins a fault.
    Fault(Fault),
    /// Ends faults: all that are on this server, port or item, or all.
    Heal {
        /// The server.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        server: Option<Link>,
        /// The port's name.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        port: Option<String>,
        /// The item's name.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        item: Option<String>,
        /// The longer transitions.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        transitions: bool,
    },
    /// Moves a stepped clock. [`Controller::operate`] refuses it: the clock is the caller's.
    Advance {
        /// By so many seconds.
        seconds: f64,
    },
    /// Waits. [`Controller::operate`] refuses it: the clock is the caller's.
    Wait {
        /// For this.
        until: Condition,
        /// For so many seconds at most.
        #[serde(default = "default_timeout")]
        timeout_s: f64,
    },
}

/// The value of an item: a number, or a bit as a bool.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, true or false")]
pub enum Number {
    /// A bit.
    Bit(bool),
    /// A number.
    Number(f64),
}

impl Number {
    /// As a number.
    pub fn value(self) -> f64 {
        match self {
            Self::Bit(on) => f64::from(u8::from(on)),
            Self::Number(number) => number,
        }
    }
}

/// The operation mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// From the pendant.
    Manual,
    /// Programs started on the pendant.
    Auto,
    /// Commands from port 2000.
    Remote,
}

impl From<Mode> for OperationMode {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::Manual => Self::Manual,
            Mode::Auto => Self::Auto,
            Mode::Remote => Self::Remote,
        }
    }
}

/// The registers after a restart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AfterRestart {
    /// The file's initial values.
    #[default]
    Initial,
    /// 0.
    Cleared,
}

/// A fault, with what it is on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// On a server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub server: Option<Link>,
    /// On a recipe port, by its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub port: Option<String>,
    /// On an item, by its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub item: Option<String>,
    /// Additional time of transitions, in seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transitions: Option<f64>,
    /// What is wrong.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<Kind>,
    /// For `delay`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// For `exception`, 1 to 11.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub code: Option<u8>,
    /// For `cut`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bytes: Option<usize>,
    /// For `spoil`: a number, or `nan`, `inf`, `-inf`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<Spoil>,
}

/// The kinds of faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Nothing is sent.
    Mute,
    /// Answers come later.
    Delay,
    /// New connections are closed.
    Refuse,
    /// All connections are closed, once.
    Disconnect,
    /// Random bytes are sent in place of what is right.
    Garbage,
    /// Every Modbus request is answered with an exception.
    Exception,
    /// The same state packet is sent again and again.
    Freeze,
    /// One state packet ends early.
    Cut,
    /// Another number is sent in place of an item's.
    Spoil,
}

impl Kind {
    const fn name(self) -> &'static str {
        match self {
            Self::Mute => "mute",
            Self::Delay => "delay",
            Self::Refuse => "refuse",
            Self::Disconnect => "disconnect",
            Self::Garbage => "garbage",
            Self::Exception => "exception",
            Self::Freeze => "freeze",
            Self::Cut => "cut",
            Self::Spoil => "spoil",
        }
    }
}

/// What is sent in place of an item's value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, \"nan\", \"inf\" or \"-inf\"")]
pub enum Spoil {
    /// A number.
    Number(f32),
    /// None.
    No(NoNumber),
}

/// A float that is no number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum NoNumber {
    /// NaN.
    #[serde(rename = "nan")]
    Nan,
    /// Infinity.
    #[serde(rename = "inf")]
    Inf,
    /// Minus infinity.
    #[serde(rename = "-inf")]
    NegInf,
}

impl Spoil {
    fn value(self) -> f32 {
        match self {
            Self::Number(number) => number,
            Self::No(NoNumber::Nan) => f32::NAN,
            Self::No(NoNumber::Inf) => f32::INFINITY,
            Self::No(NoNumber::NegInf) => f32::NEG_INFINITY,
        }
    }
}

/// Why an operation was refused: one line. Nothing has changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused(pub String);

impl std::fmt::Display for Refused {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Refused {}

type Done = Result<Value, Refused>;

fn refused<T>(why: impl Into<String>) -> Result<T, Refused> {
    Err(Refused(why.into()))
}

impl Operation {
    /// From a JSON object whose `do` is the operation's name.
    ///
    /// # Errors
    /// [`Refused`]: what is wrong, and what is allowed.
    pub fn from_json(object: Map<String, Value>) -> Result<Self, Refused> {
        if !object.contains_key("do") {
            return refused("`do` is missing: it names the operation, such as \"state\"");
        }
        Self::deserialize(Value::Object(object)).map_err(|error| Refused(error.to_string()))
    }

    /// Whether it only reads or waits.
    pub const fn is_reading(&self) -> bool {
        matches!(
            self,
            Self::State {}
                | Self::Get { .. }
                | Self::Counters {}
                | Self::Programs {}
                | Self::Events { .. }
                | Self::Follow { .. }
                | Self::Advance { .. }
                | Self::Wait { .. }
        )
    }
}

impl Controller {
    /// Carries out an operation. Call [`Self::poll_output`] until it returns
    /// [`ControllerOutput::Sleep`](crate::ControllerOutput::Sleep) after it. `now` must not be earlier than in
    /// the last call.
    ///
    /// # Errors
    /// [`Refused`]; nothing changed. `follow`, `advance` and `wait` are always refused: they are the caller's.
    pub fn operate(&mut self, now: Instant, operation: &Operation) -> Done {
        self.begin(now);
        if self.is_shut_down {
            return refused("the controller is shut down");
        }
        self.advance(now);
        let before = (!operation.is_reading()).then(|| self.recorder.before(&self.registers)).flatten();
        let result = self.carry_out_operation(now, operation)?;
        if !operation.is_reading() {
            self.operation_done(now, operation);
            if !matches!(operation, Operation::Restart { .. }) {
                self.note_writes(now, before, "control");
            }
            self.settle(now);
        }
        Ok(result)
    }

    fn carry_out_operation(&mut self, now: Instant, operation: &Operation) -> Done {
        match operation {
            Operation::State {} => return Ok(self.state(now)),
            Operation::Get { items } => return self.get_items(items),
            Operation::Counters {} => return Ok(json!(self.counters())),
            Operation::Programs {} => {
                return Ok(self.scripts.iter().map(Script::name).collect());
            }
            Operation::Events { since, kinds, max } => return self.kept_events(*since, kinds, *max),
            Operation::Set { items } => self.set_items(items)?,
            Operation::Mode { mode } => self.set_mode((*mode).into()),
            Operation::EmergencyStop {} => self.emergency_stop(now),
            Operation::ProtectiveStop {} => self.protective_stop(now),
            Operation::Collide { axis } => {
                if !(1..=6).contains(axis) {
                    return refused(format!("axis: {axis} is not within 1 to 6"));
                }
                self.collide(now, *axis);
            }
            Operation::Clear {} => self.clear_stop(now),
            Operation::Reduced { on: true } => self.enter_reduced(now),
            Operation::Reduced { on: false } => self.leave_reduced(now),
            Operation::RaiseError { code: 0, .. } => return refused("code: 0 means that there is no error"),
            Operation::RaiseError { code, text } => self.machine.raise(*code, text.as_str()),
            Operation::ClearError {} => self.machine.clear_error(),
            Operation::PowerOn {} => self.press(now, Action::PowerOn)?,
            Operation::PowerOff {} => self.press(now, Action::PowerOff)?,
            Operation::Enable {} => self.press(now, Action::Enable)?,
            Operation::Disable {} => self.press(now, Action::Disable)?,
            Operation::Stop {} => self.press(now, Action::Stop)?,
            Operation::Pause {} => self.press(now, Action::Pause)?,
            Operation::Resume {} => self.press(now, Action::Resume)?,
            Operation::Run { program, speed_percent } => self.run_at_pendant(now, program, *speed_percent)?,
            Operation::Upload { program, script } => self.upload(program, script)?,
            Operation::Remove { program } => self.remove(program)?,
            Operation::Recipe { port, recipe } => self.give_recipe(now, port, recipe.as_deref())?,
            Operation::Cycle { port, ms } => self.give_cycle(now, port, *ms)?,
            Operation::Restart { registers: AfterRestart::Initial } => self.restart(now),
            Operation::Restart { registers: AfterRestart::Cleared } => self.restart_cleared(now),
            Operation::Fault(fault) => self.begin_fault(fault)?,
            Operation::Heal { server, port, item, transitions } => {
                self.heal_some(*server, port.as_deref(), item.as_deref(), *transitions)?;
            }
            Operation::Follow { .. } | Operation::Advance { .. } | Operation::Wait { .. } => {
                return refused("this is not possible here");
            }
        }
        Ok(Value::Null)
    }

    fn get_items(&self, items: &[String]) -> Done {
        let mut values = Map::new();
        for name in items {
            let value = self.registers.value(target(name)?);
            values.insert(name.clone(), number(value));
        }
        Ok(Value::Object(values))
    }

    fn kept_events(&self, since: u64, kinds: &[String], max: usize) -> Done {
        check_kinds(kinds)?;
        let wanted = |kind: &str| kinds.is_empty() || kinds.iter().any(|wanted| wanted == kind);
        let mut next = self.newest_event() + 1;
        let mut events = Vec::new();
        for event in self.events_since(since) {
            if events.len() >= max {
                next = event.number;
                break;
            }
            if wanted(event.what.kind()) {
                events.push(event);
            }
        }
        let lost = self.dropped_events().saturating_sub(since.saturating_sub(1));
        Ok(json!({ "events": events, "next": next, "lost": lost }))
    }

    fn set_items(&mut self, items: &BTreeMap<String, Number>) -> Result<(), Refused> {
        let before = self.registers.clone();
        for (name, value) in items {
            let result = target(name).and_then(|target| {
                self.registers.force(target, value.value()).map_err(|error| Refused(error.to_string()))
            });
            if let Err(error) = result {
                self.registers = before;
                return Err(error);
            }
        }
        // The tool's frame decides where the TCP is.
        self.arm_shown = None;
        Ok(())
    }

    fn press(&mut self, now: Instant, action: Action) -> Result<(), Refused> {
        match self.machine.act(now, action) {
            Ok((effect, _)) => {
                self.runs.ends_by(cause_of(action));
                self.apply(now, effect);
                Ok(())
            }
            Err(_) => refused(self.newest_error()),
        }
    }

    fn newest_error(&self) -> String {
        self.machine.error().map_or_else(String::new, |error| error.message.clone())
    }

    fn run_at_pendant(&mut self, now: Instant, program: &str, speed: Option<f32>) -> Result<(), Refused> {
        let speed = match speed {
            None => None,
            Some(percent) => match Percent::new(percent) {
                Some(speed) => Some(speed),
                None => return refused(format!("speed_percent: {percent} is not within (0, 100]")),
            },
        };
        let Some(script) = self.script_named(program) else {
            return refused(format!("there is no program {program}; there are {}", self.script_names()));
        };
        if self.machine.check_run_at_pendant().is_err() {
            return refused(self.newest_error());
        }
        if speed.is_some() {
            // It is within its range.
            let _ = self.machine.set_speed(speed);
        }
        match self.start_program(now, &script, None, "pendant") {
            Ok(()) => Ok(()),
            Err(_) => refused(self.newest_error()),
        }
    }

    fn script_names(&self) -> String {
        let names: Vec<&str> = self.scripts.iter().map(Script::name).collect();
        if names.is_empty() { "none".to_owned() } else { names.join(", ") }
    }

    fn check_idle(&self, program: &str) -> Result<(), Refused> {
        match self.program_name() == Some(program) {
            true => refused(format!("{program} runs; stop it first")),
            false => Ok(()),
        }
    }

    fn upload(&mut self, program: &str, text: &str) -> Result<(), Refused> {
        self.check_idle(program)?;
        let is_name = !program.is_empty()
            && program.len() <= MAX_NAME
            && program.chars().all(|c| !c.is_control() && !"()\",".contains(c));
        if !is_name {
            return refused(format!(
                "program: {program:?} is no name: 1 to {MAX_NAME} characters without ( ) , \""
            ));
        }
        let place = self.scripts.iter().position(|script| script.name() == program);
        if place.is_none() && self.scripts.len() >= MAX_PROGRAMS {
            return refused(format!("there are {MAX_PROGRAMS} programs already"));
        }
        let script =
            Script::compile(program, text).map_err(|error| Refused(format!("{program}: {error}")))?;
        match place.and_then(|nth| self.scripts.get_mut(nth)) {
            Some(place) => *place = script,
            None => self.scripts.push(script),
        }
        Ok(())
    }

    fn remove(&mut self, program: &str) -> Result<(), Refused> {
        self.check_idle(program)?;
        let Some(nth) = self.scripts.iter().position(|script| script.name() == program) else {
            return refused(format!("there is no program {program}; there are {}", self.script_names()));
        };
        self.scripts.remove(nth);
        Ok(())
    }

    fn port_index(&self, name: &str) -> Result<usize, Refused> {
        self.port_named(name).map_err(Refused)
    }

    fn give_recipe(&mut self, now: Instant, port: &str, recipe: Option<&str>) -> Result<(), Refused> {
        let nth = self.port_index(port)?;
        let recipe = match recipe {
            None => None,
            Some(name) => {
                let recipes = &self.config.recipes;
                let Some(index) = recipes.iter().position(|recipe| recipe.name == name) else {
                    let names: Vec<_> = recipes.iter().map(|recipe| recipe.name.as_str()).collect();
                    return refused(format!("there is no recipe {name}; there are {}", names.join(", ")));
                };
                Some(index)
            }
        };
        self.assign_recipe(now, nth, recipe).map_err(|error| Refused(format!("{port}: {error}")))
    }

    fn give_cycle(&mut self, now: Instant, port: &str, ms: f64) -> Result<(), Refused> {
        let nth = self.port_index(port)?;
        if !(4.0..=MAX_CYCLE_MS).contains(&ms) {
            return refused(format!("ms: {ms} is not within 4 to {MAX_CYCLE_MS}"));
        }
        let epoch = self.port_epoch(nth, now);
        if let Some(port) = self.ports.get_mut(nth) {
            port.set_cycle(now, epoch, Duration::from_micros((ms * 1_000.0).round() as u64));
        }
        Ok(())
    }

    fn begin_fault(&mut self, fault: &Fault) -> Result<(), Refused> {
        let Fault { server, port, item, transitions, kind, .. } = fault;
        check_arguments(fault)?;
        match (server, port, item, transitions, kind) {
            (Some(server), None, None, None, Some(kind)) => self.begin_server_fault(*server, *kind, fault),
            (None, Some(port), None, None, Some(kind)) => {
                let nth = self.port_index(port)?;
                match kind {
                    Kind::Mute => self.mute_port(nth),
                    Kind::Disconnect if self.ports.get(nth).is_some_and(|port| port.is_tcp_client()) => {
                        self.close_port(nth);
                    }
                    Kind::Disconnect => return refused(format!("{port} is no TCP client: only mute")),
                    _ => return refused(format!("kind: a port can mute or disconnect, not {}", kind.name())),
                }
                Ok(())
            }
            (None, None, Some(item), None, Some(Kind::Spoil)) => {
                let Some(value) = fault.value else { return refused("value is missing") };
                self.spoil(item, value.value()).map_err(|error| Refused(error.to_string()))
            }
            (None, None, Some(_), None, _) => refused("kind: an item can only spoil"),
            (None, None, None, Some(seconds), None) => {
                self.delay_transitions(duration("transitions", *seconds)?);
                Ok(())
            }
            _ => refused(
                "a fault is on one of server, port and item, with its kind, or on transitions with seconds",
            ),
        }
    }

    fn begin_server_fault(&mut self, server: Link, kind: Kind, fault: &Fault) -> Result<(), Refused> {
        match (kind, server) {
            (Kind::Mute, _) => self.mute(server),
            (Kind::Refuse, _) => self.refuse(server),
            (Kind::Disconnect, _) => self.disconnect(server),
            (Kind::Garbage, _) => self.faults.set_garbage(server, true),
            (Kind::Delay, Link::Command | Link::Modbus) => {
                let Some(seconds) = fault.seconds else { return refused("seconds are missing") };
                self.delay_answers(server, duration("seconds", seconds)?);
            }
            (Kind::Exception, Link::Modbus) => {
                let Some(code) = fault.code else { return refused("code is missing") };
                let Some(exception) = (1..=11).contains(&code).then(|| Exception::from_code(code)) else {
                    return refused(format!("code: {code} is not within 1 to 11"));
                };
                self.answer_modbus_with(Some(exception));
            }
            (Kind::Freeze, Link::State) => self.faults.freeze(true),
            (Kind::Cut, Link::State) => {
                let Some(bytes) = fault.bytes else { return refused("bytes are missing") };
                self.cut_next_state_packet(bytes);
            }
            _ => return refused(format!("{server} has no fault {}", kind.name())),
        }
        Ok(())
    }

    fn heal_some(
        &mut self,
        server: Option<Link>,
        port: Option<&str>,
        item: Option<&str>,
        transitions: bool,
    ) -> Result<(), Refused> {
        let port = port.map(|name| self.port_index(name)).transpose()?;
        if let Some(item) = item {
            self.heal(item).map_err(|error| Refused(error.to_string()))?;
        }
        if let Some(port) = port {
            self.unmute_port(port);
        }
        if let Some(server) = server {
            self.faults.heal_server(server);
        }
        if transitions {
            self.delay_transitions(Duration::ZERO);
        }
        if server.is_none() && port.is_none() && item.is_none() && !transitions {
            self.faults.heal_all();
            self.machine.delay_transitions(Duration::ZERO);
        }
        Ok(())
    }
}

/// Arguments that do not belong to the kind are refused: they would be overlooked.
fn check_arguments(fault: &Fault) -> Result<(), Refused> {
    let given = [
        ("seconds", fault.seconds.is_some(), Kind::Delay),
        ("code", fault.code.is_some(), Kind::Exception),
        ("bytes", fault.bytes.is_some(), Kind::Cut),
        ("value", fault.value.is_some(), Kind::Spoil),
    ];
    for (name, is_given, kind) in given {
        if is_given && fault.kind != Some(kind) {
            return refused(format!("{name} belongs to the kind {}", kind.name()));
        }
    }
    Ok(())
}

/// Whether all kinds exist.
///
/// # Errors
/// The first that does not, with those that do.
pub fn check_kinds(kinds: &[String]) -> Result<(), Refused> {
    match kinds.iter().find(|kind| !KINDS.contains(&kind.as_str())) {
        Some(wrong) => refused(format!("kinds: there are no events {wrong}; there are {}", KINDS.join(", "))),
        None => Ok(()),
    }
}

pub(super) fn target(name: &str) -> Result<InitialTarget, Refused> {
    name.parse().map_err(|error| Refused(format!("{name}: {error}")))
}

fn duration(name: &str, seconds: f64) -> Result<Duration, Refused> {
    if !(0.0..=MAX_SECONDS).contains(&seconds) {
        return refused(format!("{name}: {seconds} is not within 0 to {MAX_SECONDS}"));
    }
    Ok(Duration::from_micros((seconds * 1e6).round() as u64))
}

/// A whole number without a fraction, as registers and bits are.
pub(super) fn number(value: f64) -> Value {
    let is_whole = value.fract() == 0.0 && value.abs() < 9e15;
    if is_whole { json!(value as i64) } else { json!(value) }
}

/// The reason that `last_run` shows for a program that an action ends.
pub(super) fn cause_of(action: Action) -> &'static str {
    match action {
        Action::Disable => "disable",
        Action::PowerOff => "power_off",
        Action::Shutdown => "shutdown",
        _ => "stop",
    }
}

const fn default_max() -> usize {
    1_000
}

const fn default_timeout() -> f64 {
    5.0
}

/// Maximum length of a program's name.
const MAX_NAME: usize = 200;
/// Maximum number of programs.
const MAX_PROGRAMS: usize = 256;
const MAX_CYCLE_MS: f64 = 3_600_000.0;
const MAX_SECONDS: f64 = 86_400.0;
