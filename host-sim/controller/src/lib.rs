#![doc = include_str!("../README.md")]
//!
//! # The run loop
//!
//! [`Controller`] has port 2000, port 2001, Modbus, UDP 2011, recipe ports and programs behind one run loop.
//!
//! In: events of connections and devices, and the time. Out: data to send, and when to call again. Does not know
//! sockets, devices or clocks; its caller does: a runtime with sockets, or a test that jumps from deadline to deadline.
//!
//! One rule: call [`Controller::handle`], then [`Controller::poll_output`] until it returns
//! [`ControllerOutput::Sleep`]. Polling early is harmless. Errors of a peer are counted and ignored.
//!
//! Registers and IO are in [`registers`], the states and the commands that each allows in [`machine`], the
//! arm's position in [`motion`], scripts in [`program`], recipe ports in `ports`, connections in `server`,
//! functions of inputs in `functions`, items by their names in `items`, and faults for tests in `faults`.

mod build;
mod common;
mod condition;
mod corrupted;
mod counters;
mod events;
mod faults;
mod functions;
mod io;
mod items;
pub mod machine;
pub mod motion;
pub mod operations;
mod ports;
pub mod program;
mod quiet;
mod random;
pub mod registers;
mod run;
mod runs;
mod server;
mod snapshot;
mod test_controller;
pub mod timeline;
mod unmet;

use std::collections::VecDeque;

use proto_core::schedule::Grid;
use proto_core::time::{Duration, Instant};
use proto_core::wire::dialect::Dialect;

pub use build::BuildError;
use build::{check_functions, mode, start_values};
pub use common::{KINDS, Link};
pub use condition::Condition;
pub use counters::{ControllerCounters, RecipePortCounters, ServerCounters};
use events::Recorder;
pub use events::{ControllerEvent, Happened, MAX_EVENTS};
pub use faults::CommandClients;
use faults::Faults;
pub use io::{ConnId, ControllerInput, ControllerOutput};
pub use items::ItemError;
use machine::Machine;
use motion::Arm;
use ports::RecipePort;
pub use ports::{MAX_INBOX, MAX_UDP_CLIENTS, RecipeError};
use program::{Script, Variables};
use quiet::Quiet;
use random::Random;
use recipe_config::{Power, SimConfig};
use registers::Registers;
use run::RunningProgram;
use runs::Runs;
pub use runs::{Run, RunOutcome};
pub use server::{MAX_COMMAND_CONNECTIONS, MAX_MODBUS_CONNECTIONS, MAX_ORDERS, MAX_STATE_CONNECTIONS};
use server::{Requested, Server};

pub use corrupted::NoSuchFloat;
pub use test_controller::{Out, TestController};

/// The simulated controller (docs/simulated-controller.md).
#[derive(Debug)]
pub struct Controller {
    config: SimConfig,
    dialect: Dialect,
    scripts: Vec<Script>,
    registers: Registers,
    machine: Machine,
    arm: Arm,
    /// When the arm's state was last copied to the registers.
    arm_shown: Option<Instant>,
    running: Option<RunningProgram>,
    /// The variables of the newest program, after its end.
    variables: Variables,
    log: VecDeque<String>,
    ports: Vec<RecipePort>,
    server: Server,
    state_grid: Grid,
    /// The origin of all grids: the first instant of a call.
    epoch: Option<Instant>,
    /// Offset of each port's grid from the origin.
    phases: Vec<Duration>,
    state_phase: Duration,
    faults: Faults,
    recorder: Recorder,
    runs: Runs,
    counters: ControllerCounters,
    outputs: VecDeque<ControllerOutput>,
    quiet: Quiet,
    /// After `shutdown()` on port 2000.
    is_shut_down: bool,
}

impl Controller {
    /// A controller with the configuration's initial state.
    ///
    /// # Errors
    /// [`BuildError`]: the first mistake in the configuration.
    pub fn new(config: &SimConfig) -> Result<Self, BuildError> {
        let dialect = Dialect::named(&config.robot.dialect)
            .ok_or_else(|| BuildError::Dialect(config.robot.dialect.clone()))?;
        let mut ports = Vec::new();
        for port in &config.ports {
            let name = || port.name.clone();
            let port =
                RecipePort::new(config, port).map_err(|error| BuildError::Port { port: name(), error })?;
            if port.is_udp_server() && ports.iter().any(RecipePort::is_udp_server) {
                return Err(BuildError::SecondUdpServer { port: name() });
            }
            ports.push(port);
        }
        let mut scripts = Vec::new();
        for program in &config.programs {
            let script = Script::compile(&program.name, &program.script)
                .map_err(|error| BuildError::Program { program: program.name.clone(), error })?;
            scripts.push(script);
        }
        check_functions(config)?;
        let (registers, arm) = start_values(config)?;
        Ok(Self {
            machine: Machine::new(config.robot.power, mode(config)),
            config: config.clone(),
            dialect,
            scripts,
            registers,
            arm,
            arm_shown: None,
            running: None,
            variables: Variables::new(),
            log: VecDeque::new(),
            ports,
            server: Server::default(),
            state_grid: Grid::starting_at(Instant::ZERO, STATE_PERIOD),
            epoch: None,
            phases: Vec::new(),
            state_phase: Duration::ZERO,
            faults: Faults::new(config.robot.command_clients),
            recorder: Recorder::default(),
            runs: Runs::default(),
            counters: ControllerCounters::default(),
            outputs: VecDeque::new(),
            quiet: Quiet::default(),
            is_shut_down: false,
        })
    }

    /// Lets a seed choose the phases of the state stream and of the ports' cycles, and the data of random faults. Call
    /// it before anything else.
    pub fn seed(&mut self, seed: u64) {
        self.quiet.ends();
        let mut random = Random::seeded(seed);
        self.faults.seed(random.next());
        self.state_phase = Duration::from_micros(random.below(STATE_PERIOD.as_micros()));
        let phase = |port: &RecipePort| Duration::from_micros(random.below(port.cycle().as_micros()));
        self.phases = self.ports.iter().map(phase).collect();
    }

    /// The origin of a port's grid.
    fn port_epoch(&self, port: usize, now: Instant) -> Instant {
        self.epoch.unwrap_or(now) + self.phases.get(port).copied().unwrap_or(Duration::ZERO)
    }

    /// Handles one input. Call [`Self::poll_output`] until it returns [`ControllerOutput::Sleep`] after it.
    /// `now` must not be earlier than in the last call.
    pub fn handle(&mut self, now: Instant, input: ControllerInput<'_>) {
        self.begin(now);
        if self.is_shut_down {
            return;
        }
        if let ControllerInput::ModbusBytes { conn, bytes } = input
            && self.quiet.lasts(now)
        {
            // Nothing is due, and requests that only read change nothing.
            let (before, effect) = self.modbus_bytes(now, conn, bytes);
            if effect == Requested::Changes {
                self.quiet.ends();
            }
            return self.note_writes(now, before, "modbus");
        }
        self.quiet.ends();
        self.advance(now);
        let mut before = match input {
            // Most requests only read; the first write makes the copy.
            ControllerInput::ModbusBytes { .. } => None,
            _ => self.writer_of(&input).and_then(|_| self.recorder.before(&self.registers)),
        };
        match input {
            ControllerInput::CommandOpened { conn, from } => self.opened(now, Link::Command, conn, from),
            ControllerInput::StateOpened { conn, from } => self.opened(now, Link::State, conn, from),
            ControllerInput::ModbusOpened { conn, from } => self.opened(now, Link::Modbus, conn, from),
            ControllerInput::CommandClosed { conn } => self.closed(now, Link::Command, conn),
            ControllerInput::StateClosed { conn } => self.closed(now, Link::State, conn),
            ControllerInput::ModbusClosed { conn } => self.closed(now, Link::Modbus, conn),
            ControllerInput::CommandBytes { conn, bytes } => self.command_bytes(now, conn, bytes),
            ControllerInput::ModbusBytes { conn, bytes } => before = self.modbus_bytes(now, conn, bytes).0,
            ControllerInput::Udp2011 { peer, bytes } => self.udp_bytes(now, peer, bytes),
            ControllerInput::Udp2011Unreachable { peer } => {
                for port in &mut self.ports {
                    port.unreachable(peer);
                }
            }
            ControllerInput::PortUp { port } => {
                let epoch = self.port_epoch(port, now);
                if let Some(port) = self.ports.get_mut(port) {
                    port.came_up(now, epoch);
                }
            }
            ControllerInput::PortDown { port } => {
                if let Some(port) = self.ports.get_mut(port) {
                    port.went_down();
                }
            }
            ControllerInput::PortBytes { port, bytes } => {
                let listening = self.listening();
                if let Some(port) = self.ports.get_mut(port) {
                    port.receive(now, bytes, &mut self.registers, listening);
                }
            }
            ControllerInput::PortCan { port, frame } => {
                let listening = self.listening();
                if let Some(port) = self.ports.get_mut(port) {
                    port.receive_can(&frame, &mut self.registers, listening);
                }
            }
            ControllerInput::PortSent { port } => {
                if let Some(port) = self.ports.get_mut(port) {
                    port.sent();
                }
            }
            ControllerInput::Tick => {}
        }
        if before.is_some()
            && let Some(by) = self.writer_of(&input).map(str::to_owned)
        {
            self.note_writes(now, before, &by);
        }
        // `poll_output` does the rest.
    }

    /// The writer of registers for this input, if it can write any.
    fn writer_of(&self, input: &ControllerInput<'_>) -> Option<&str> {
        match *input {
            ControllerInput::ModbusBytes { .. } => Some("modbus"),
            ControllerInput::Udp2011 { .. } => {
                self.ports.iter().find(|port| port.is_udp_server()).map(RecipePort::name)
            }
            ControllerInput::PortBytes { port, .. } | ControllerInput::PortCan { port, .. } => {
                self.ports.get(port).map(RecipePort::name)
            }
            _ => None,
        }
    }

    /// The next task for the caller; [`ControllerOutput::Sleep`] if there is none.
    pub fn poll_output(&mut self, now: Instant) -> ControllerOutput {
        self.begin(now);
        if let Some(output) = self.outputs.pop_front() {
            return output;
        }
        if self.is_shut_down {
            return ControllerOutput::Sleep { until: Instant::NEVER };
        }
        if let Some(until) = self.quiet.deadline(now) {
            return ControllerOutput::Sleep { until };
        }
        self.advance(now);
        match self.outputs.pop_front() {
            Some(output) => output,
            None if self.is_shut_down => ControllerOutput::Sleep { until: Instant::NEVER },
            None => ControllerOutput::Sleep { until: self.rest() },
        }
    }

    /// The registers, inputs and outputs.
    pub fn registers(&self) -> &Registers {
        &self.registers
    }

    /// The state machines.
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// The variables of the running program, or of the newest one.
    pub fn program_variables(&self) -> Variables {
        self.running.as_ref().map_or_else(|| self.variables.clone(), RunningProgram::variables)
    }

    /// The name of the program that runs or is paused; `None` if there is none.
    pub fn program_name(&self) -> Option<&str> {
        self.running.as_ref().map(RunningProgram::name)
    }

    /// The newest [`MAX_LOG`] lines that programs have logged, oldest first.
    pub fn program_log(&self) -> impl Iterator<Item = &str> {
        self.log.iter().map(String::as_str)
    }

    /// All counters since [`Self::new`].
    pub fn counters(&self) -> ControllerCounters {
        let ports = self.ports.iter().map(|port| (port.name().to_owned(), port.counters()));
        let mut counters = ControllerCounters { ports: ports.collect(), ..self.counters.clone() };
        counters.command.open = self.server.open(Link::Command);
        counters.state.open = self.server.open(Link::State);
        counters.modbus.open = self.server.open(Link::Modbus);
        counters
    }

    /// The first call sets the origin of all grids.
    fn begin(&mut self, now: Instant) {
        self.recorder.set_now(now);
        if self.epoch.is_none() {
            self.epoch = Some(now);
            if self.config.robot.power == Power::Boot {
                self.machine = Machine::booting(now, self.machine.mode());
            }
            self.state_grid = Grid::starting_at(now + STATE_PERIOD + self.state_phase, STATE_PERIOD);
            for nth in 0..self.ports.len() {
                let epoch = self.port_epoch(nth, now);
                if let Some(port) = self.ports.get_mut(nth).filter(|port| port.is_udp_server()) {
                    port.came_up(now, epoch);
                }
            }
        }
    }
}

/// Period of port 2001.
const STATE_PERIOD: Duration = Duration::from_millis(100);
/// Maximum number of log lines that are kept.
pub const MAX_LOG: usize = 200;

/// The example of README.md is a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(test)]
mod tests;
