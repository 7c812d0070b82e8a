#![doc = include_str!("../README.md")]
//!
//! # The run loop
//!
//! [`Controller`] is ports 2000 and 2001, Modbus, UDP 2011, recipe ports and programs behind one run loop.
//!
//! In: events of connections and devices, and the time. Out: data to send, and when to call again.
//! Does not know sockets, devices or clocks: its caller does. That is a shell with sockets, or a
//! test, which jumps from deadline to deadline.
//!
//! One rule: [`Controller::handle`] changes the state, then [`Controller::poll_output`] is drained
//! until it returns [`ControllerOutput::Sleep`]. Polling early is harmless. Errors of a peer are
//! counted and do no harm.
//!
//! All registers and IO are in [`registers`]; what is allowed when is in [`machine`], the arm's
//! position in [`motion`], scripts in [`program`], recipe ports in `ports`, connections in
//! `server`, and the faults for tests in `faults`.

mod counters;
mod faults;
pub mod machine;
pub mod motion;
mod ports;
pub mod program;
pub mod registers;
mod run;
mod server;
mod spoiled;
mod test_controller;

use std::collections::VecDeque;
use std::net::{IpAddr, SocketAddr};

use proto_core::schedule::Grid;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;
use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::{self, OperationMode};

pub use counters::{Counters, ServerCounters};
use faults::Faults;
pub use faults::{CommandClients, Link};
use machine::Machine;
use motion::Arm;
use ports::Port;
pub use ports::{MAX_INBOX, MAX_UDP_CLIENTS, PortCounters, RecipeError};
use program::{Script, ScriptError, Variables};
use recipe_config::{InitialTarget, RobotMode, SimConfig};
use registers::Registers;
use run::Running;
use server::Server;
pub use server::{MAX_COMMAND_CONNECTIONS, MAX_MODBUS_CONNECTIONS, MAX_ORDERS, MAX_STATE_CONNECTIONS};

pub use spoiled::NoSuchFloat;
pub use test_controller::{Out, TestController};

/// A connection, by a number that the caller assigns; no two open connections have the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ConnId(pub u64);

/// An event that the caller reports.
///
/// A port is an index into [`SimConfig::ports`].
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub enum ControllerInput<'a> {
    /// A client of port 2000 connected.
    CommandOpened {
        /// Its connection.
        conn: ConnId,
        /// Its address.
        from: IpAddr,
    },
    /// The client of port 2000 sent bytes.
    CommandBytes {
        /// Its connection.
        conn: ConnId,
        /// In pieces of any size.
        bytes: &'a [u8],
    },
    /// The client of port 2000 is gone.
    CommandClosed {
        /// Its connection.
        conn: ConnId,
    },
    /// A client of port 2001 connected.
    StateOpened {
        /// Its connection.
        conn: ConnId,
        /// Its address.
        from: IpAddr,
    },
    /// The client of port 2001 is gone.
    StateClosed {
        /// Its connection.
        conn: ConnId,
    },
    /// A Modbus client connected.
    ModbusOpened {
        /// Its connection.
        conn: ConnId,
        /// Its address.
        from: IpAddr,
    },
    /// The Modbus client sent bytes.
    ModbusBytes {
        /// Its connection.
        conn: ConnId,
        /// In pieces of any size.
        bytes: &'a [u8],
    },
    /// The Modbus client is gone.
    ModbusClosed {
        /// Its connection.
        conn: ConnId,
    },
    /// A datagram came to the UDP server.
    Udp2011 {
        /// The sender's address.
        peer: SocketAddr,
        /// The whole datagram.
        bytes: &'a [u8],
    },
    /// An earlier datagram to this address was returned as unreachable.
    Udp2011Unreachable {
        /// The address.
        peer: SocketAddr,
    },
    /// A port's device or connection can be used.
    PortUp {
        /// The port.
        port: usize,
    },
    /// A port's device or connection cannot be used any more.
    PortDown {
        /// The port.
        port: usize,
    },
    /// Bytes arrived at a serial or TCP port, or one datagram at a UDP client.
    PortBytes {
        /// The port.
        port: usize,
        /// In pieces of any size; a datagram whole.
        bytes: &'a [u8],
    },
    /// A frame arrived at a CAN port.
    PortCan {
        /// The port.
        port: usize,
        /// The frame.
        frame: CanFrame,
    },
    /// Everything handed over to the port has left.
    PortSent {
        /// The port.
        port: usize,
    },
    /// Time has passed.
    Tick,
}

/// A task for the caller. Exhaustive, because each of them must be carried out.
#[derive(Debug, Clone, PartialEq)]
pub enum ControllerOutput {
    /// Send bytes on a TCP connection.
    Send {
        /// The connection.
        conn: ConnId,
        /// The bytes.
        bytes: Vec<u8>,
    },
    /// Close a TCP connection after everything handed over for it has been sent. Report nothing
    /// more about it.
    Close {
        /// The connection.
        conn: ConnId,
    },
    /// Send a packet to every client of port 2001.
    StatePacket {
        /// The packet.
        bytes: Box<[u8; state::LEN]>,
    },
    /// Send a datagram from the UDP server.
    UdpSend {
        /// The receiver's address.
        peer: SocketAddr,
        /// The whole datagram.
        bytes: Vec<u8>,
    },
    /// Send bytes, or one datagram, on a port, and report [`ControllerInput::PortSent`] after.
    PortSend {
        /// The port.
        port: usize,
        /// The bytes.
        bytes: Vec<u8>,
    },
    /// Send a frame on a CAN port; up to 32 of them come before
    /// [`ControllerInput::PortSent`] must be reported, once, after the last.
    PortSendCan {
        /// The port.
        port: usize,
        /// The frame.
        frame: CanFrame,
    },
    /// Close a TCP client's connection and connect again; reported as `PortDown` and `PortUp`.
    PortClose {
        /// The port.
        port: usize,
    },
    /// The controller was shut down: stop listening and end.
    Shutdown,
    /// Nothing more to do before this instant, unless there is an input.
    Sleep {
        /// When to call again, or [`Instant::NEVER`].
        until: Instant,
    },
}

/// Why a controller cannot be made from a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum BuildError {
    /// There is no dialect of this name.
    Dialect(String),
    /// A port cannot have its recipe.
    Port {
        /// The port's name.
        port: String,
        /// The reason.
        error: RecipeError,
    },
    /// More than one port is the UDP server.
    SecondUdpServer {
        /// The second one's name.
        port: String,
    },
    /// A program does not compile.
    Program {
        /// Its name.
        program: String,
        /// The reason.
        error: ScriptError,
    },
    /// An initial value does not fit.
    Initial {
        /// The target.
        target: InitialTarget,
        /// The reason.
        reason: String,
    },
}

impl std::fmt::Display for BuildError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Dialect(name) => {
                write!(f, "there is no dialect {name}; there are {}", Dialect::NAMES.join(", "))
            }
            Self::Port { port, error } => write!(f, "port {port}: {error}"),
            Self::SecondUdpServer { port } => {
                write!(f, "port {port}: another port is the UDP server already")
            }
            Self::Program { program, error } => write!(f, "program {program}: {error}"),
            Self::Initial { target, reason } => write!(f, "{target}: {reason}"),
        }
    }
}

impl std::error::Error for BuildError {}

/// The simulated controller.
#[derive(Debug)]
pub struct Controller {
    config: SimConfig,
    dialect: Dialect,
    scripts: Vec<Script>,
    registers: Registers,
    machine: Machine,
    arm: Arm,
    /// When the registers last got the arm's state.
    arm_shown: Option<Instant>,
    running: Option<Running>,
    /// The newest program's variables, after it has ended.
    variables: Variables,
    log: VecDeque<String>,
    ports: Vec<Port>,
    server: Server,
    state_grid: Grid,
    /// The origin of all grids: the first instant of a call.
    epoch: Option<Instant>,
    faults: Faults,
    counters: Counters,
    outputs: VecDeque<ControllerOutput>,
    gone: bool,
}

impl Controller {
    /// A controller in the configuration's state.
    ///
    /// # Errors
    /// [`BuildError`] names what is wrong.
    pub fn new(config: &SimConfig) -> Result<Self, BuildError> {
        let dialect = Dialect::named(&config.robot.dialect)
            .ok_or_else(|| BuildError::Dialect(config.robot.dialect.clone()))?;
        let mut ports = Vec::new();
        for port in &config.ports {
            let name = || port.name.clone();
            let port = Port::new(config, port).map_err(|error| BuildError::Port { port: name(), error })?;
            if port.is_udp_server() && ports.iter().any(Port::is_udp_server) {
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
            faults: Faults::new(config.robot.command_clients),
            counters: Counters::default(),
            outputs: VecDeque::new(),
            gone: false,
        })
    }

    /// Handles one input. Drain [`Self::poll_output`] afterwards.
    pub fn handle(&mut self, now: Instant, input: ControllerInput<'_>) {
        self.begin(now);
        if self.gone {
            return;
        }
        self.advance(now);
        match input {
            ControllerInput::CommandOpened { conn, from } => self.opened(now, Link::Command, conn, from),
            ControllerInput::StateOpened { conn, from } => self.opened(now, Link::State, conn, from),
            ControllerInput::ModbusOpened { conn, from } => self.opened(now, Link::Modbus, conn, from),
            ControllerInput::CommandClosed { conn } => self.closed(Link::Command, conn),
            ControllerInput::StateClosed { conn } => self.closed(Link::State, conn),
            ControllerInput::ModbusClosed { conn } => self.closed(Link::Modbus, conn),
            ControllerInput::CommandBytes { conn, bytes } => self.command_bytes(now, conn, bytes),
            ControllerInput::ModbusBytes { conn, bytes } => self.modbus_bytes(now, conn, bytes),
            ControllerInput::Udp2011 { peer, bytes } => self.udp_bytes(now, peer, bytes),
            ControllerInput::Udp2011Unreachable { peer } => {
                for port in &mut self.ports {
                    port.unreachable(peer);
                }
            }
            ControllerInput::PortUp { port } => {
                let epoch = self.epoch.unwrap_or(now);
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
        // The consequences happen when the outputs are drained.
    }

    /// The next task; [`ControllerOutput::Sleep`] if there is nothing more.
    pub fn poll_output(&mut self, now: Instant) -> ControllerOutput {
        self.begin(now);
        if let Some(output) = self.outputs.pop_front() {
            return output;
        }
        if !self.gone {
            self.advance(now);
        }
        match self.outputs.pop_front() {
            Some(output) => output,
            None if self.gone => ControllerOutput::Sleep { until: Instant::NEVER },
            None => ControllerOutput::Sleep { until: self.deadline() },
        }
    }

    /// The registers and IO.
    pub fn registers(&self) -> &Registers {
        &self.registers
    }

    /// The state machines.
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// The variables of the running program, or of the newest one.
    pub fn program_variables(&self) -> Variables {
        self.running.as_ref().map_or_else(|| self.variables.clone(), Running::variables)
    }

    /// The program that has not ended.
    pub fn program_name(&self) -> Option<&str> {
        self.running.as_ref().map(Running::name)
    }

    /// The log of programs, the newest [`MAX_LOG`] lines.
    pub fn program_log(&self) -> impl Iterator<Item = &str> {
        self.log.iter().map(String::as_str)
    }

    /// All counters.
    pub fn counters(&self) -> Counters {
        let ports = self.ports.iter().map(|port| (port.name().to_owned(), port.counters()));
        let mut counters = Counters { ports: ports.collect(), ..self.counters.clone() };
        counters.command.open = self.server.open(Link::Command);
        counters.state.open = self.server.open(Link::State);
        counters.modbus.open = self.server.open(Link::Modbus);
        counters
    }

    /// The first instant sets the grids.
    fn begin(&mut self, now: Instant) {
        if self.epoch.is_none() {
            self.epoch = Some(now);
            self.state_grid = Grid::starting_at(now + STATE_PERIOD, STATE_PERIOD);
            for port in &mut self.ports {
                if port.is_udp_server() {
                    port.came_up(now, now);
                }
            }
        }
    }
}

/// The registers and the arm as the configuration has them.
fn start_values(config: &SimConfig) -> Result<(Registers, Arm), BuildError> {
    let mut registers = Registers::default();
    let mut joints = motion::HOME;
    let mut pose = [None; 6];
    for initial in &config.initial {
        registers
            .force(initial.target, initial.value)
            .map_err(|error| BuildError::Initial { target: initial.target, reason: error.to_string() })?;
        let InitialTarget::Var(var) = initial.target else { continue };
        if var.group() != "RobotState" {
            continue;
        }
        match usize::from(var.index()) {
            nth @ 1..=6 if initial.value.abs() <= motion::JOINT_RANGE_RAD => joints[nth - 1] = initial.value,
            1..=6 => {
                let reason = format!("a joint position is within ±{:.4} rad", motion::JOINT_RANGE_RAD);
                return Err(BuildError::Initial { target: initial.target, reason });
            }
            nth @ 8..=13 => pose[nth - 8] = Some(initial.value),
            _ => {}
        }
    }
    let mut arm = Arm::at(joints);
    arm.calibrate(pose, &registers.tool());
    Ok((registers, arm))
}

fn mode(config: &SimConfig) -> OperationMode {
    match config.robot.mode {
        RobotMode::Manual => OperationMode::Manual,
        RobotMode::Auto => OperationMode::Auto,
        RobotMode::Remote => OperationMode::Remote,
    }
}

/// Port 2001 sends ten packets a second.
const STATE_PERIOD: Duration = Duration::from_millis(100);
/// Log lines kept.
pub const MAX_LOG: usize = 200;

/// The example of README.md is a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(test)]
mod tests;
