//! The simulated controller on real sockets and devices.

mod control;
mod events;
mod open;
mod outward;
mod playing;
mod servers;
mod stats;
mod stepping;

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::rc::Rc;

use proto_core::engine::BusState;
use proto_core::time::{Duration, Instant};
use serde_json::Value;
use tokio::net::UdpSocket;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{error, info, warn};

use super::console::{ConsoleOptions, Consoled};
use super::events_file::EventsWriter;
use super::host::{self, Handle, Runtime};
use super::tcp::{Accepted, Connection};
use super::worker::RuntimePlace;
use super::{EventsFile, RunError, RunOptions};
use control::ControlClient;
use recipe_config::SimConfig;
use recipe_controller::operations::Operation;
use recipe_controller::timeline::Timeline;
use recipe_controller::{ConnId, Controller, ControllerInput, ControllerOutput, Link};
use recipe_io::bind::Bind;
use recipe_io::clock::{Alarm, Clock};
pub use recipe_io::clock::{MAX_FACTOR, MIN_FACTOR, Pace};
use recipe_io::exchange::{PortEvent, PortTx};
use recipe_io::log_limit::LogLimit;
use recipe_io::port::OpenPort;
use recipe_io::realtime::{self, Scheduling};
use recipe_io::timer::now;
use stepping::WaitingClient;

/// Options of a controller's run beside its file.
#[derive(Debug, Clone, Default)]
pub struct ControllerOptions {
    /// Options of any run.
    pub run: RunOptions,
    /// How its clock runs.
    pub pace: Pace,
    /// Chooses the phases of the state stream and of the ports' cycles; `None`: all are 0.
    pub seed: Option<u64>,
    /// The file for events.
    pub events: Option<EventsFile>,
    /// Operations at given times and under conditions.
    pub timeline: Option<Timeline>,
}

/// Runs the simulated controller until Ctrl-C, SIGTERM or SIGHUP, or until it is shut down over port 2000.
pub fn run(config: SimConfig, options: ControllerOptions) -> Result<(), RunError> {
    let run = options.run.clone();
    let bound = run.console.as_ref().map(ConsoleOptions::bind).transpose()?;
    let handle = start_with(config, options)?;
    match bound {
        Some(bound) => host::foreground(Box::new(Consoled::start(bound, handle, run.log.clone())?), &run),
        None => host::foreground(Box::new(handle), &run),
    }
}

/// Starts a simulated controller on a thread of its own and returns when everything is listening. Dropping
/// the handle ends it.
pub fn start(config: SimConfig, binds: Vec<Bind>) -> Result<Handle, RunError> {
    start_with(
        config,
        ControllerOptions { run: RunOptions { binds, ..RunOptions::default() }, ..Default::default() },
    )
}

/// As [`start`], with options. Options for a run in the foreground have no effect.
pub fn start_with(config: SimConfig, options: ControllerOptions) -> Result<Handle, RunError> {
    host::start(&RuntimePlace::alone(), "controller", async move |_| {
        let scheduling = match options.pace {
            // With real-time priority, it would poll before the clients that it waits for.
            Pace::Stepped => Scheduling::Ordinary,
            Pace::Real | Pace::Factor(_) => options.run.scheduling,
        };
        let running = RunningController::open(config, options).await?;
        // Not inside `info!`, which evaluates its arguments only if the line is printed.
        let scheduling = realtime::apply(scheduling);
        info!(%scheduling, "the simulated controller is running");
        Ok(running)
    })
}

struct RunningController {
    runtime: Rc<ControllerRuntime>,
    tasks: JoinSet<()>,
    ready: Value,
}

impl Runtime for RunningController {
    fn ready(&self) -> Value {
        self.ready.clone()
    }

    fn stats(&self) -> impl Fn() -> Value + 'static {
        let runtime = Rc::clone(&self.runtime);
        move || runtime.stats()
    }

    async fn run(mut self) -> Result<(), RunError> {
        loop {
            tokio::select! {
                () = self.runtime.ended.notified() => {
                    info!("shut down");
                    return Ok(());
                }
                Some(task) = self.tasks.join_next() => task.map_err(|error| {
                    RunError::new(format!("a task of the simulated controller ended: {error}"))
                })?,
            }
        }
    }
}

/// The controller, with its sockets and devices.
struct ControllerRuntime {
    controller: RefCell<Controller>,
    connections: RefCell<BTreeMap<ConnId, ServerClient>>,
    next_connection: Cell<u64>,
    udp: UdpSocket,
    ports: Vec<Outward>,
    port_names: Vec<String>,
    /// Results of outputs, reported to the controller after the outputs before them.
    reports: RefCell<VecDeque<TaskReport>>,
    /// Closed connections that are still sending.
    lingering: RefCell<VecDeque<Rc<Connection>>>,
    busy: Cell<bool>,
    /// The controller's clock. Log limits and timeouts of sockets are in the machine's time.
    clock: Clock,
    timer: Alarm,
    /// Clients that wait for an instant or a condition.
    waits: RefCell<Vec<WaitingClient>>,
    /// Signalled when a wait begins.
    moved: Notify,
    /// The ports that are CAN interfaces of the kernel.
    kernel_can: Vec<usize>,
    /// Since when frames wait at CAN interfaces of the kernel, by port number.
    kernel_sends: RefCell<BTreeMap<usize, Instant>>,
    activity: Cell<u64>,
    timeline: RefCell<Option<Timeline>>,
    timeline_alarm: Alarm,
    /// A step of the timeline is being executed.
    is_playing: Cell<bool>,
    reported: Cell<u64>,
    events_file: Option<EventsWriter>,
    control_clients: RefCell<Vec<Rc<ControlClient>>>,
    refused_control_clients: Cell<usize>,
    ended: Notify,
    counters: Cell<RuntimeCounters>,
    refusal_log: LogLimit,
    log_limit: LogLimit,
}

struct ServerClient {
    link: Link,
    connection: Rc<Connection>,
    /// Whether it is an accepted client of port 2001, which gets state packets.
    subscribed: bool,
}

/// The device or socket of a recipe port.
#[derive(Debug)]
enum Outward {
    /// A serial or CAN device.
    Device(Rc<PortTx>),
    /// The UDP server; its socket is in [`ControllerRuntime`].
    UdpServer,
    /// A TCP client, while it is connected.
    Tcp(RefCell<Option<Rc<Connection>>>),
    /// A UDP client, while its peer's address is known.
    Udp(RefCell<Option<Rc<UdpSocket>>>),
}

#[derive(Debug, Clone, Copy)]
enum TaskReport {
    PortSent(usize),
    Unreachable(SocketAddr),
    Dropped(Link, ConnId),
}

/// Counters of the runtime itself.
#[derive(Debug, Clone, Copy, Default, serde::Serialize)]
struct RuntimeCounters {
    /// Connections closed because the peer did not read.
    slow_clients: u64,
    /// State packets not sent to a connection because the one before was still waiting.
    skipped_state_packets: u64,
    /// Datagrams that the system did not accept.
    dropped_datagrams: u64,
    /// Closed connections whose last answers were dropped because too many such connections were sending.
    cut_answers: u64,
    /// Failed accepts, probably for lack of descriptors.
    accept_failures: u64,
}

impl ControllerRuntime {
    /// Runs a port's device and reports its events to the controller.
    async fn drive(self: Rc<Self>, port: usize, device: OpenPort) {
        let is_kernel_can = device.is_kernel_can();
        let ended = device.run(|event| {
            if is_kernel_can && !matches!(event, PortEvent::Frame { .. }) {
                self.kernel_sends.borrow_mut().remove(&port);
            }
            self.input(match event {
                PortEvent::Up => ControllerInput::PortUp { port },
                PortEvent::Down => ControllerInput::PortDown { port },
                PortEvent::Bytes(bytes) => ControllerInput::PortBytes { port, bytes },
                PortEvent::Frame { frame, .. } => ControllerInput::PortCan { port, frame },
                // The simulated controller knows no CAN error states.
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

    /// Calls the controller at its deadlines.
    async fn keep_time(self: Rc<Self>) {
        loop {
            if let Err(error) = self.timer.expired().await {
                error!(%error, "the timer failed");
                return;
            }
            self.input(ControllerInput::Tick);
        }
    }

    /// Reports an event to the controller and executes its outputs.
    fn input(&self, input: ControllerInput<'_>) {
        let now = self.clock.now();
        self.note_activity();
        self.controller.borrow_mut().handle(now, input);
        self.drain(now);
    }

    /// Executes an operation, with its outputs.
    fn operate(&self, operation: &Operation) -> Result<Value, String> {
        let now = self.clock.now();
        self.note_activity();
        let done = self.controller.borrow_mut().operate(now, operation);
        self.drain(now);
        done.map_err(|refused| refused.to_string())
    }

    fn note_activity(&self) {
        self.activity.set(self.activity.get().wrapping_add(1));
    }

    fn drain(&self, now: Instant) {
        // An output can cause a report; it must wait until the outputs before it are executed.
        if self.busy.replace(true) {
            return;
        }
        let until = loop {
            let output = self.controller.borrow_mut().poll_output(now);
            if let ControllerOutput::Sleep { until } = output {
                let Some(report) = self.reports.borrow_mut().pop_front() else { break until };
                let input = match report {
                    TaskReport::PortSent(port) => ControllerInput::PortSent { port },
                    TaskReport::Unreachable(peer) => ControllerInput::Udp2011Unreachable { peer },
                    TaskReport::Dropped(link, conn) => closed(link, conn),
                };
                self.controller.borrow_mut().handle(now, input);
            } else {
                self.execute(output);
            }
        };
        self.busy.set(false);
        if let Err(error) = self.timer.arm(until) {
            error!(%error, "cannot set the timer");
        }
        self.play();
        self.check_waits();
        self.report_events();
    }

    fn execute(&self, output: ControllerOutput) {
        match output {
            ControllerOutput::Send { conn, bytes } => self.send(conn, &bytes),
            ControllerOutput::Close { conn } => {
                if let Some(client) = self.connections.borrow_mut().remove(&conn) {
                    self.close(client.connection);
                }
            }
            ControllerOutput::StatePacket { bytes } => self.send_state(&bytes[..], now()),
            ControllerOutput::UdpSend { peer, bytes } => self.send_datagram(peer, &bytes),
            ControllerOutput::PortSend { port, bytes } => self.send_port(port, &bytes),
            ControllerOutput::PortSendCan { port, frame } => {
                if let Some(Outward::Device(tx)) = self.ports.get(port) {
                    tx.send_frame(frame);
                    if self.kernel_can.contains(&port) {
                        self.kernel_sends.borrow_mut().entry(port).or_insert_with(now);
                    }
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

    /// Closes a connection after its waiting data was sent. If too many are waiting for that, the oldest is aborted.
    fn close(&self, connection: Rc<Connection>) {
        connection.close();
        if connection.has_unsent() {
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
        if client.connection.send(bytes) == Accepted::Failed {
            self.give_up(&mut connections, conn);
        }
    }

    /// Sends a packet to every client of port 2001 that has accepted the one before. A client that has not
    /// for [`STATE_TIMEOUT`] is disconnected (D9).
    fn send_state(&self, packet: &[u8], now: Instant) {
        let mut connections = self.connections.borrow_mut();
        let mut dropped = Vec::new();
        for (&conn, client) in connections.iter().filter(|(_, client)| client.subscribed) {
            match client.connection.blocked_since() {
                Some(since) if now.saturating_since(since) >= STATE_TIMEOUT => dropped.push(conn),
                Some(_) => self.count(|counters| counters.skipped_state_packets += 1),
                None => {
                    if client.connection.send(packet) == Accepted::Failed {
                        dropped.push(conn);
                    }
                }
            }
        }
        for conn in dropped {
            self.give_up(&mut connections, conn);
        }
    }

    fn give_up(&self, connections: &mut BTreeMap<ConnId, ServerClient>, conn: ConnId) {
        if let Some(client) = connections.remove(&conn) {
            client.connection.abort();
            if let Some(more) = self.log_limit.allow(now()) {
                warn!(link = ?client.link, conn = conn.0, more, "disconnected: does not read what is sent");
            }
            self.count(|counters| counters.slow_clients += 1);
            self.reports.borrow_mut().push_back(TaskReport::Dropped(client.link, conn));
        }
    }

    fn count(&self, change: impl FnOnce(&mut RuntimeCounters)) {
        let mut counters = self.counters.get();
        change(&mut counters);
        self.counters.set(counters);
    }
}

fn closed(link: Link, conn: ConnId) -> ControllerInput<'static> {
    match link {
        Link::Command => ControllerInput::CommandClosed { conn },
        Link::State => ControllerInput::StateClosed { conn },
        Link::Modbus => ControllerInput::ModbusClosed { conn },
    }
}

/// How long a client of port 2001 may read nothing (D9).
const STATE_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum number of closed connections that are still sending.
const MAX_LINGERING: usize = 16;

#[cfg(test)]
#[path = "controller_tests.rs"]
mod tests;
