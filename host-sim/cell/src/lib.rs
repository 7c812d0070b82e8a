//! A whole cell in virtual time: the gateway engine and the simulated controller, joined by simulated networks, RS-485
//! lines and CAN buses. One clock jumps from deadline to deadline.
//!
//! In: a gateway configuration, a controller configuration and a seed. Out: everything that happens, the same for the
//! same seed ([`Cell::trace`] has a digest to compare). Hours of a cell take seconds. Does not know sockets, devices or
//! the host's clock (docs/cell.md).
//!
//! ```
//! use proto_core::time::Duration;
//! use recipe_cell::Cell;
//! use recipe_config::file;
//!
//! let configs = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs");
//! let gateway = file::load_gateway(format!("{configs}/rs485-system.toml").as_ref(), &[]).unwrap();
//! let controller = file::load_controller(format!("{configs}/rs485-system-controller.toml").as_ref(), &[]).unwrap();
//! let mut cell = Cell::new(&gateway, &controller, 1).unwrap();
//! cell.run(Duration::from_secs(1));
//! let line = cell.line_of("rs485-1");
//! cell.send(line, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
//! cell.run(Duration::from_millis(50));
//! assert_eq!(cell.value("DO[1]"), 1.0);
//! ```
//!
//! Each fault is a method of [`Cell`] (such as [`Cell::refuse`] or [`Cell::half_open`]), a field of a [`Line`], a
//! [`CanBus`] or a [`Network`] (noise, loss, splits), or a method of [`Cell::controller_mut`]. [`FaultInjector`]
//! injects all of them at random.

mod access;
mod can;
mod connection;
#[cfg(test)]
mod corruption;
mod device;
mod drive;
mod due;
mod faults;
mod field;
mod floats;
mod injector;
mod judge;
mod line;
mod network;
mod oracle;
mod queue;
mod recording;
mod rng;
mod rtu;
mod sleep;
pub mod soak;
mod survey;
mod tcp;
mod tcp_device;
mod trace;
mod traffic;
mod wiring;

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use proto_core::config::GatewayConfig;
use proto_core::engine::{BuildError as EngineError, Engine, LinkId, OUTPUT_BUFFER, PortId};
use proto_core::time::{Duration, Instant};

pub use can::{BusCounters, CanBus};
pub use device::{Act, Device, Done, Order, PeriodicSender, Responder, Served, Server, SlaveDone};
pub use injector::{FaultInjector, FaultKind};
pub use judge::{Kind, OUTCOMES};
pub use line::{Chunking, Line, LineCounters, MAX_HEARD, Wiring};
pub use network::{Network, Way};
pub use oracle::{Invariant, Violation};
pub use recording::recording_difference;
pub use rng::Rng;
pub use tcp::TCP_TIMEOUT;
pub use trace::{Entry, Trace, What};

use connection::Connection;
use due::Due;
use network::Gate;
use oracle::Oracle;
use queue::Queue;
use recipe_config::SimConfig;
use recipe_controller::{BuildError, ConnId, Controller, ControllerInput};
use recording::Recorder;

/// One of the cell's RS-485 lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct LineId(usize);

/// One of the cell's CAN buses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct BusId(usize);

/// A port on a line or bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AnyPort {
    Gateway(PortId),
    Controller(usize),
}

/// The two ends of a line or bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum End {
    Port = 0,
    Device = 1,
}

/// Why a cell cannot be created.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum CellError {
    /// The gateway cannot run its configuration.
    Gateway(EngineError),
    /// The controller cannot run its configuration.
    Controller(BuildError),
}

impl std::fmt::Display for CellError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Gateway(error) => write!(f, "gateway: {error}"),
            Self::Controller(error) => write!(f, "controller: {error}"),
        }
    }
}

impl std::error::Error for CellError {}

/// A recipe port of the controller that communicates over the network.
#[derive(Debug)]
struct Client {
    /// The listening link of the gateway to which it connects or sends; `None` if there is none.
    link: Option<LinkId>,
    is_tcp: bool,
    conn: Option<u64>,
    /// The socket that it sends datagrams from.
    socket: u64,
}

/// A cell.
#[derive(Debug)]
pub struct Cell {
    gateway: GatewayConfig,
    engine: Box<Engine>,
    engine_wake: Instant,
    controller: Controller,
    controller_wake: Instant,
    /// The model has seen the current registers of the controller.
    controller_is_seen: bool,
    /// The earliest deadline of all devices.
    devices_wake: Instant,
    /// Buffer for what the engine sends; `None` while it is in use.
    buffer: Option<Box<[u8; OUTPUT_BUFFER]>>,
    now: Instant,
    queue: Queue<Due>,
    gates: BTreeMap<LinkId, Gate>,
    conns: BTreeMap<u64, Connection>,
    next_conn: u64,
    clients: BTreeMap<usize, Client>,
    /// The devices of field ports that are TCP connections.
    servers: BTreeMap<LinkId, tcp_device::TcpDevice>,
    lines: Vec<Line>,
    buses: Vec<CanBus>,
    names: BTreeMap<String, Medium>,
    controller_names: BTreeMap<String, Medium>,
    /// Events that wait while the gateway is not called; `None` while it is called.
    asleep: Option<sleep::Waiting>,
    wakes_at: Instant,
    stalls: u64,
    /// Number of current faults of each of the controller's servers.
    server_faults: [u32; 3],
    rng: Rng,
    trace: Trace,
    recorder: Option<Recorder>,
    /// The model that checks everything; `None` before [`Cell::watch`].
    oracle: Option<Box<Oracle>>,
    /// Judges what the device executes, in a cell that is made for that.
    judge: Option<Box<judge::Judge>>,
    /// Changes inputs and outputs of the engine, to simulate a gateway with faults.
    #[cfg(test)]
    corruption: Option<corruption::Corruption>,
    /// What the controller has sent on the connection of [`Cell::send_command`].
    reply: Vec<u8>,
    /// Number of bytes that are missing at the start of the next state packet.
    state_bytes_lost: usize,
}

/// What a port is connected to.
#[derive(Debug, Clone, Copy)]
enum Medium {
    Line(LineId),
    Bus(BusId),
}

impl Cell {
    /// A cell that is switched on now. Field ports have no devices yet. Links come up as time advances.
    ///
    /// # Errors
    /// [`CellError`] if the gateway or the controller cannot run its configuration.
    pub fn new(gateway: &GatewayConfig, controller: &SimConfig, seed: u64) -> Result<Self, CellError> {
        Self::build(gateway, controller, seed, None)
    }

    /// As [`Self::new`], with a recording of all inputs and outputs of the engine from the start, for
    /// [`Self::into_recording`].
    ///
    /// # Errors
    /// The errors of [`Self::new`].
    pub fn recorded(gateway: &GatewayConfig, controller: &SimConfig, seed: u64) -> Result<Self, CellError> {
        Self::build(gateway, controller, seed, Some(Recorder::new(gateway)))
    }

    fn build(
        gateway: &GatewayConfig,
        controller: &SimConfig,
        seed: u64,
        recorder: Option<Recorder>,
    ) -> Result<Self, CellError> {
        let engine = Engine::new(gateway).map_err(CellError::Gateway)?;
        let mut cell = Self {
            gateway: gateway.clone(),
            engine: Box::new(engine),
            engine_wake: Instant::ZERO,
            controller: Controller::new(controller).map_err(CellError::Controller)?,
            controller_wake: Instant::ZERO,
            controller_is_seen: false,
            devices_wake: Instant::NEVER,
            buffer: None,
            now: START,
            queue: Queue::new(),
            gates: BTreeMap::new(),
            conns: BTreeMap::new(),
            next_conn: 1,
            clients: BTreeMap::new(),
            servers: BTreeMap::new(),
            lines: Vec::new(),
            buses: Vec::new(),
            names: BTreeMap::new(),
            controller_names: BTreeMap::new(),
            asleep: None,
            wakes_at: START,
            stalls: 0,
            server_faults: [0; 3],
            rng: Rng::new(seed),
            trace: Trace::new(),
            recorder,
            oracle: None,
            judge: None,
            #[cfg(test)]
            corruption: None,
            reply: Vec::new(),
            state_bytes_lost: 0,
        };
        cell.wire_gateway();
        cell.wire_controller(controller);
        cell.switch_on();
        Ok(cell)
    }

    /// Checks everything that the gateway does from now on against an independent model
    /// (docs/cell.md section 4). Time stops after the first violation. Call it before time advances.
    pub fn watch(&mut self) {
        let mut oracle = Box::new(Oracle::new(&self.gateway));
        oracle.begin(&self.engine, self.engine_wake, self.now);
        self.oracle = Some(oracle);
        self.queue.push(self.now, Due::Survey);
    }

    /// The first violation; `None` if there was none.
    pub fn violation(&self) -> Option<&Violation> {
        let judged = self.judge.as_ref().and_then(|judge| judge.violation());
        self.oracle.as_ref().and_then(|oracle| oracle.violation()).or(judged)
    }

    /// Number of checks of each invariant.
    pub fn checks(&self) -> BTreeMap<Invariant, u64> {
        let mut checks = self.oracle.as_ref().map(|oracle| oracle.checks()).unwrap_or_default();
        for (&what, count) in self.judge.iter().flat_map(|judge| judge.checks()) {
            *checks.entry(what).or_default() += count;
        }
        checks
    }

    /// Number of values written to the controller that were checked.
    pub fn watched_writes(&self) -> u64 {
        self.oracle.as_ref().map_or(0, |oracle| oracle.writes)
    }

    /// Number of frames received and sent on a field port, counted across restarts of the gateway.
    pub fn watched_frames(&self, port: PortId) -> (u64, u64) {
        let frames = self.oracle.as_ref().and_then(|oracle| oracle.frames.get(usize::from(port.0)));
        frames.copied().unwrap_or_default()
    }

    /// Number of sends and receives on a link.
    pub fn watched_link(&self, link: LinkId) -> (u64, u64) {
        self.oracle.as_ref().map(|oracle| oracle.traffic[oracle::place(link)]).unwrap_or_default()
    }

    /// Sends a command from a client other than the gateway; returns the controller's reply, empty if
    /// there is none within 500 ms.
    pub fn send_command(&mut self, command: &str) -> String {
        let line = format!("{command}\r\n");
        self.reply.clear();
        self.controller_input(ControllerInput::CommandOpened { conn: COMMAND_CLIENT, from: CLIENT_IP });
        self.controller_input(ControllerInput::CommandBytes { conn: COMMAND_CLIENT, bytes: line.as_bytes() });
        self.run_until(Duration::from_millis(500), |cell| !cell.reply.is_empty());
        self.controller_input(ControllerInput::CommandClosed { conn: COMMAND_CLIENT });
        String::from_utf8_lossy(&self.reply).into_owned()
    }

    /// Advances time until `done` returns true, but at most by `limit`. Returns whether it did. `done` is called every
    /// millisecond.
    pub fn run_until(&mut self, limit: Duration, mut done: impl FnMut(&Self) -> bool) -> bool {
        let end = self.now + limit;
        loop {
            if done(self) {
                return true;
            }
            if self.now >= end {
                return false;
            }
            self.run(Duration::from_millis(1).min(end.saturating_since(self.now)));
        }
    }

    /// As [`Self::run`], in milliseconds.
    pub fn run_ms(&mut self, millis: u64) {
        self.run(Duration::from_millis(millis));
    }

    #[track_caller]
    fn gate(&mut self, link: LinkId) -> &mut Gate {
        match self.gates.get_mut(&link) {
            Some(gate) => gate,
            None => panic!("the gateway has no {link:?}"),
        }
    }
}

/// The gateway's address for the controller's UDP server. Each time the link is opened, the address changes, like that
/// of a new socket.
fn udp_peer(generation: u64) -> SocketAddr {
    (CLIENT_IP, 40_000 + (generation % 10_000) as u16).into()
}

/// The address of every client of the controller.
const CLIENT_IP: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
/// The connection of [`Cell::send_command`].
const COMMAND_CLIENT: ConnId = ConnId(u64::MAX);
/// Neither zero nor on a time grid of the engine, so that nothing can depend on the origin of the clock.
const START: Instant = Instant::from_micros(1_000_000_300);
/// How long the controller's TCP client waits before it connects again.
const CLIENT_RETRY: Duration = Duration::from_millis(250);

#[cfg(test)]
mod network_tests;
#[cfg(test)]
mod sleep_tests;
#[cfg(test)]
mod tests;
