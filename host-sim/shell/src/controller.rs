//! The simulated controller on real sockets and devices.

mod outward;
mod servers;

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::rc::Rc;

use proto_core::engine::BusState;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::Scalar;
use serde_json::{Value, json};
use tokio::net::{TcpListener, UdpSocket};
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{error, info, warn};

use super::host::{self, Handle, Shell};
use super::tcp::{Connection, Taken};
use super::{RunOptions, StartError, udp};
use recipe_config::{SimBus, SimConfig, SimParts};
use recipe_controller::{ConnId, Controller, ControllerInput, ControllerOutput, Link};
use recipe_device::bind::Bind;
use recipe_device::exchange::{PortEvent, PortTx};
use recipe_device::port::{Port, PortBus};
use recipe_net::quota::Quota;
use recipe_net::realtime::{self, Scheduling};
use recipe_net::timer::{Timer, now};

/// Runs the simulated controller until Ctrl-C, SIGTERM or SIGHUP, or until it is shut down over port 2000.
///
/// # Errors
/// What kept it from starting; nothing is left behind then.
pub fn run(config: SimConfig, options: RunOptions) -> Result<(), StartError> {
    let handle = spawn(config, options.binds.clone(), Scheduling::FifoIfAllowed)?;
    host::foreground(handle, &options)
}

/// Starts a simulated controller on a thread of its own and returns when everything listens; dropping
/// the handle ends it.
///
/// # Errors
/// What kept it from starting; nothing is left behind then.
pub fn start(config: SimConfig, binds: Vec<Bind>) -> Result<Handle, StartError> {
    spawn(config, binds, Scheduling::Ordinary)
}

fn spawn(config: SimConfig, binds: Vec<Bind>, scheduling: Scheduling) -> Result<Handle, StartError> {
    host::start("controller", async move || {
        let running = Running::open(config, &binds).await?;
        info!(scheduling = %realtime::apply(scheduling), "the simulated controller is running");
        Ok(running)
    })
}

/// A controller whose tasks have been made; they run once it is waited for.
struct Running {
    shell: Rc<ControllerShell>,
    tasks: JoinSet<()>,
    ready: Value,
}

impl Shell for Running {
    fn ready(&self) -> Value {
        self.ready.clone()
    }

    fn stats(&self) -> impl Fn() -> Value + 'static {
        let shell = Rc::clone(&self.shell);
        move || shell.stats()
    }

    async fn run(mut self) -> Result<(), StartError> {
        loop {
            tokio::select! {
                () = self.shell.ended.notified() => {
                    info!("shut down");
                    return Ok(());
                }
                Some(task) = self.tasks.join_next() => task.map_err(|error| {
                    StartError::new(format!("a task of the simulated controller ended: {error}"))
                })?,
            }
        }
    }
}

/// The controller and everything it talks through.
struct ControllerShell {
    controller: RefCell<Controller>,
    connections: RefCell<BTreeMap<ConnId, Client>>,
    next_connection: Cell<u64>,
    udp: UdpSocket,
    ports: Vec<Outward>,
    port_names: Vec<String>,
    /// What came of outputs and is told to the controller once it can listen again.
    pending: RefCell<VecDeque<Report>>,
    /// Closed, and still sending what was kept.
    lingering: RefCell<VecDeque<Rc<Connection>>>,
    busy: Cell<bool>,
    timer: Timer,
    ended: Notify,
    counters: Cell<ShellCounters>,
    refusals: Quota,
    complaints: Quota,
}

struct Client {
    link: Link,
    connection: Rc<Connection>,
    /// Not before the controller has seen it: it may turn it away.
    subscribed: bool,
}

/// What a recipe port sends through.
#[derive(Debug)]
enum Outward {
    /// A serial or CAN device.
    Device(Rc<PortTx>),
    /// The UDP server, which is addressed directly.
    UdpServer,
    /// A TCP client, while it is connected.
    Tcp(RefCell<Option<Rc<Connection>>>),
    /// A UDP client, while its peer's address is known.
    Udp(RefCell<Option<Rc<UdpSocket>>>),
}

#[derive(Debug, Clone, Copy)]
enum Report {
    PortSent(usize),
    Unreachable(SocketAddr),
    Dropped(Link, ConnId),
}

/// What the shell itself gave up.
#[derive(Debug, Clone, Copy, Default, serde::Serialize)]
struct ShellCounters {
    /// Connections closed because the peer did not take what was sent.
    slow_clients: u64,
    /// State packets that a connection missed because it had not taken the one before.
    skipped_state_packets: u64,
    /// Datagrams that the system did not take.
    dropped_datagrams: u64,
    /// Closed connections whose last answers were given up to make room for those of others.
    cut_answers: u64,
    /// Connections that the system could not hand over, for want of descriptors most likely.
    accept_failures: u64,
}

impl Running {
    async fn open(config: SimConfig, binds: &[Bind]) -> Result<Self, StartError> {
        let controller = Controller::new(&config).map_err(|error| StartError::new(error.to_string()))?;
        let devices = open_devices(&config, binds).await?;
        let address = config.listen.address;
        let listen = async |key: &str, port: u16| {
            let listener = TcpListener::bind((address, port)).await;
            let local = listener.and_then(|listener| Ok((listener.local_addr()?, listener)));
            local.map_err(|error| not_listening(key, SocketAddr::new(address, port), &error))
        };
        let (command_at, command) = listen("command", config.listen.command).await?;
        let (state_at, state) = listen("state", config.listen.state).await?;
        let (modbus_at, modbus) = listen("modbus", config.listen.modbus).await?;
        let udp_wanted = SocketAddr::new(address, config.listen.udp2011);
        let udp = UdpSocket::bind(udp_wanted).await;
        let (udp, udp_at) = udp
            .and_then(|udp| {
                udp::keep_errors(&udp)?;
                let at = udp.local_addr()?;
                Ok((udp, at))
            })
            .map_err(|error| not_listening("udp2011", udp_wanted, &error))?;
        let mut places = serde_json::Map::new();
        let mut ports = Vec::new();
        for (port, device) in config.ports.iter().zip(&devices) {
            let (outward, place) = match (&port.bus, device) {
                (_, Some(device)) => (Outward::Device(device.tx()), device.place()),
                (SimBus::TcpClient { to }, _) => (Outward::Tcp(RefCell::default()), to.clone()),
                (SimBus::UdpClient { to }, _) => (Outward::Udp(RefCell::default()), to.clone()),
                _ => (Outward::UdpServer, udp_at.to_string()),
            };
            ports.push(outward);
            places.insert(port.name.clone(), json!(place));
        }
        let ready = json!({
            "command": command_at,
            "state": state_at,
            "modbus": modbus_at,
            "udp2011": udp_at,
            "ports": places,
        });
        let shell = Rc::new(ControllerShell {
            controller: RefCell::new(controller),
            connections: RefCell::default(),
            next_connection: Cell::new(0),
            udp,
            ports,
            port_names: config.ports.iter().map(|port| port.name.clone()).collect(),
            pending: RefCell::default(),
            lingering: RefCell::default(),
            busy: Cell::new(false),
            timer: Timer::new()
                .map_err(|error| StartError::new(format!("cannot create a timer: {error}")))?,
            ended: Notify::new(),
            counters: Cell::default(),
            refusals: Quota::default(),
            complaints: Quota::default(),
        });
        let mut tasks = JoinSet::new();
        tasks.spawn_local(Rc::clone(&shell).serve(Link::Command, command));
        tasks.spawn_local(Rc::clone(&shell).serve(Link::State, state));
        tasks.spawn_local(Rc::clone(&shell).serve(Link::Modbus, modbus));
        tasks.spawn_local(Rc::clone(&shell).serve_udp());
        tasks.spawn_local(Rc::clone(&shell).keep_time());
        for (index, (port, device)) in config.ports.into_iter().zip(devices).enumerate() {
            let shell = Rc::clone(&shell);
            match (port.bus, device) {
                (_, Some(device)) => drop(tasks.spawn_local(shell.drive(index, device))),
                (SimBus::TcpClient { to }, _) => drop(tasks.spawn_local(shell.connect_out(index, to))),
                (SimBus::UdpClient { to }, _) => drop(tasks.spawn_local(shell.send_out(index, to))),
                _ => {}
            }
        }
        shell.input(ControllerInput::Tick);
        Ok(Self { shell, tasks, ready })
    }
}

impl ControllerShell {
    /// Runs a port's device and tells the controller what it does.
    async fn drive(self: Rc<Self>, port: usize, device: Port) {
        let ended = device.run(|event| {
            self.input(match event {
                PortEvent::Up => ControllerInput::PortUp { port },
                PortEvent::Down => ControllerInput::PortDown { port },
                PortEvent::Bytes(bytes) => ControllerInput::PortBytes { port, bytes },
                PortEvent::Frame { frame, .. } => ControllerInput::PortCan { port, frame },
                // The simulated controller's port has no error states of its own.
                PortEvent::Bus(BusState::BusOff) => ControllerInput::PortDown { port },
                PortEvent::Bus(_) => ControllerInput::PortUp { port },
                PortEvent::Sent => ControllerInput::PortSent { port },
            });
        });
        if let Err(error) = ended.await {
            error!(port = %self.port_names[port], %error, "the device failed permanently");
            self.input(ControllerInput::PortDown { port });
        }
    }

    /// Wakes the controller at its deadlines.
    async fn keep_time(self: Rc<Self>) {
        loop {
            if let Err(error) = self.timer.expired().await {
                error!(%error, "the timer failed");
                return;
            }
            self.input(ControllerInput::Tick);
        }
    }

    /// Tells the controller what happened and carries out what it wants.
    fn input(&self, input: ControllerInput<'_>) {
        let now = now();
        self.controller.borrow_mut().handle(now, input);
        self.drain(now);
    }

    fn drain(&self, now: Instant) {
        // What carrying out an output causes is told after the outputs before it, never in between.
        if self.busy.replace(true) {
            return;
        }
        let until = loop {
            let output = self.controller.borrow_mut().poll_output(now);
            if let ControllerOutput::Sleep { until } = output {
                let Some(report) = self.pending.borrow_mut().pop_front() else { break until };
                let input = match report {
                    Report::PortSent(port) => ControllerInput::PortSent { port },
                    Report::Unreachable(peer) => ControllerInput::Udp2011Unreachable { peer },
                    Report::Dropped(link, conn) => closed(link, conn),
                };
                self.controller.borrow_mut().handle(now, input);
            } else {
                self.carry_out(output, now);
            }
        };
        self.busy.set(false);
        if let Err(error) = self.timer.arm(until) {
            error!(%error, "cannot set the timer");
        }
    }

    fn carry_out(&self, output: ControllerOutput, now: Instant) {
        match output {
            ControllerOutput::Send { conn, bytes } => self.send(conn, &bytes),
            ControllerOutput::Close { conn } => {
                if let Some(client) = self.connections.borrow_mut().remove(&conn) {
                    self.close(client.connection);
                }
            }
            ControllerOutput::StatePacket { bytes } => self.send_state(&bytes[..], now),
            ControllerOutput::UdpSend { peer, bytes } => self.send_datagram(peer, &bytes),
            ControllerOutput::PortSend { port, bytes } => self.send_port(port, &bytes),
            ControllerOutput::PortSendCan { port, frame } => {
                if let Some(Outward::Device(tx)) = self.ports.get(port) {
                    tx.send_frame(frame);
                }
            }
            ControllerOutput::PortClose { port } => {
                if let Some(Outward::Tcp(connection)) = self.ports.get(port)
                    && let Some(connection) = connection.borrow().as_ref()
                {
                    connection.abort();
                }
            }
            ControllerOutput::Shutdown => self.ended.notify_one(),
            ControllerOutput::Sleep { .. } => {}
        }
    }

    /// Closes behind what was kept. Of too many such connections the oldest is cut.
    fn close(&self, connection: Rc<Connection>) {
        connection.close();
        if connection.has_kept() {
            let mut lingering = self.lingering.borrow_mut();
            lingering.push_back(connection);
            if lingering.len() > MAX_LINGERING
                && let Some(oldest) = lingering.pop_front()
            {
                oldest.abort();
                self.count(|counters| counters.cut_answers += 1);
            }
        }
    }

    fn send(&self, conn: ConnId, bytes: &[u8]) {
        let mut connections = self.connections.borrow_mut();
        let Some(client) = connections.get(&conn) else { return };
        if client.connection.send(bytes) == Taken::Failed {
            self.give_up(&mut connections, conn);
        }
    }

    /// To every client of port 2001 that has taken the packet before; who has not for [`STATE_PATIENCE`] is
    /// dropped (D9).
    fn send_state(&self, packet: &[u8], now: Instant) {
        let mut connections = self.connections.borrow_mut();
        let mut dropped = Vec::new();
        for (&conn, client) in connections.iter().filter(|(_, client)| client.subscribed) {
            match client.connection.blocked_since() {
                Some(since) if now.saturating_since(since) >= STATE_PATIENCE => dropped.push(conn),
                Some(_) => self.count(|counters| counters.skipped_state_packets += 1),
                None => {
                    if client.connection.send(packet) == Taken::Failed {
                        dropped.push(conn);
                    }
                }
            }
        }
        for conn in dropped {
            self.give_up(&mut connections, conn);
        }
    }

    fn give_up(&self, connections: &mut BTreeMap<ConnId, Client>, conn: ConnId) {
        if let Some(client) = connections.remove(&conn) {
            client.connection.abort();
            if let Some(more) = self.complaints.take(now()) {
                warn!(link = ?client.link, conn = conn.0, more, "disconnected: does not read what is sent");
            }
            self.count(|counters| counters.slow_clients += 1);
            self.pending.borrow_mut().push_back(Report::Dropped(client.link, conn));
        }
    }

    fn count(&self, change: impl FnOnce(&mut ShellCounters)) {
        let mut counters = self.counters.get();
        change(&mut counters);
        self.counters.set(counters);
    }
}

impl ControllerShell {
    /// One line of statistics.
    fn stats(&self) -> Value {
        let controller = self.controller.borrow();
        let machine = controller.machine();
        let registers: serde_json::Map<_, _> = SysVar::all()
            .map(|var| (var, controller.registers().var(var)))
            .filter(|(_, value)| value.as_f64() != 0.0)
            .map(|(var, value)| (var.to_string(), number(value)))
            .collect();
        let mut stats = json!(controller.counters());
        if let Value::Object(stats) = &mut stats {
            if let Some(Value::Object(ports)) = stats.get_mut("ports") {
                for (name, outward) in self.port_names.iter().zip(&self.ports) {
                    if let (Some(Value::Object(port)), Outward::Device(tx)) = (ports.get_mut(name), outward) {
                        port.insert("device".to_owned(), json!(tx.counters()));
                    }
                }
            }
            stats.insert("time_us".to_owned(), json!(now().as_micros()));
            stats.insert("connections".to_owned(), json!(self.counters.get()));
            stats.insert("mode".to_owned(), json!(machine.mode().code()));
            stats.insert("robot".to_owned(), json!(machine.robot().code()));
            stats.insert("program_state".to_owned(), json!(machine.program().code()));
            stats.insert("safety".to_owned(), json!(machine.safety().code()));
            stats.insert("program".to_owned(), json!(controller.program_name()));
            stats.insert("variables".to_owned(), json!(controller.program_variables()));
            stats.insert("registers".to_owned(), Value::Object(registers));
        }
        stats
    }
}

/// A register as people write it: bits and words without a fraction.
fn number(value: Scalar) -> Value {
    match value {
        Scalar::Byte(bits) => json!(bits),
        Scalar::Word(word) => json!(word),
        other => json!(other.as_f64()),
    }
}

/// Opens the device of every port that needs one; the others have none.
async fn open_devices(config: &SimConfig, binds: &[Bind]) -> Result<Vec<Option<Port>>, StartError> {
    for (index, bind) in binds.iter().enumerate() {
        let refused = |why: &str| Err(StartError::new(format!("--bind {bind}: {why}")));
        match config.ports.iter().find(|port| port.name == bind.port) {
            None => return refused(&format!("there is no such port; {}", bindable(config))),
            Some(port) if bus_of(&port.bus).is_none() => {
                return refused("this port is reached over the network and takes no device");
            }
            Some(_) if binds[..index].iter().any(|other| other.port == bind.port) => {
                return refused("the port is already bound");
            }
            Some(_) => {}
        }
    }
    let mut devices = Vec::new();
    for port in &config.ports {
        devices.push(match bus_of(&port.bus) {
            Some(bus) => {
                let mut device = open_device(&port.name, bus, binds).await?;
                let recipe = port.recipe.and_then(|recipe| config.recipes.get(recipe));
                if let Some(SimParts::Can { input, output }) = recipe.map(|recipe| &recipe.parts) {
                    device.listen_to(input.iter().chain(output).map(|frame| frame.id).collect());
                }
                Some(device)
            }
            None => None,
        });
    }
    Ok(devices)
}

async fn open_device(name: &str, bus: PortBus, binds: &[Bind]) -> Result<Port, StartError> {
    let Some(bind) = binds.iter().find(|bind| bind.port == name) else {
        let (kind, forms) = match bus {
            PortBus::Serial(_) => {
                ("serial line", "pty:PATH, serial:PATH, tcp:HOST:PORT or tcp-listen:HOST:PORT")
            }
            PortBus::Can { .. } => ("CAN bus", "socketcan:INTERFACE, slcan-pty:PATH or slcan-tcp:HOST:PORT"),
        };
        return Err(StartError::new(format!(
            "port {name} is a {kind} without a device: add --bind {name}=DEVICE, where DEVICE is {forms}"
        )));
    };
    let opened = Port::open(&bind.device, bus).await;
    opened.map_err(|error| StartError::new(format!("--bind {bind}: {error}")))
}

fn bindable(config: &SimConfig) -> String {
    let ports = config.ports.iter().filter(|port| bus_of(&port.bus).is_some());
    let names: Vec<_> = ports.map(|port| port.name.as_str()).collect();
    if names.is_empty() {
        "no port takes a device".to_owned()
    } else {
        format!("ports that take a device: {}", names.join(", "))
    }
}

fn not_listening(key: &str, address: SocketAddr, error: &std::io::Error) -> StartError {
    StartError::new(format!("listen.{key}: {address}: {error}"))
}

fn bus_of(bus: &SimBus) -> Option<PortBus> {
    match bus {
        SimBus::Rs485(settings) => Some(PortBus::Serial(*settings)),
        SimBus::Can { bitrate } => Some(PortBus::Can { bitrate: *bitrate }),
        SimBus::UdpServer | SimBus::TcpClient { .. } | SimBus::UdpClient { .. } => None,
    }
}

fn closed(link: Link, conn: ConnId) -> ControllerInput<'static> {
    match link {
        Link::Command => ControllerInput::CommandClosed { conn },
        Link::State => ControllerInput::StateClosed { conn },
        Link::Modbus => ControllerInput::ModbusClosed { conn },
    }
}

/// How long a client of port 2001 may take nothing (D9).
const STATE_PATIENCE: Duration = Duration::from_secs(2);
/// Most closed connections that still send.
const MAX_LINGERING: usize = 16;

#[cfg(test)]
#[path = "controller_tests.rs"]
mod tests;
