//! A controller in virtual time, for tests: its clients and devices are calls, and the clock jumps from
//! deadline to deadline.

use std::collections::BTreeMap;
use std::error::Error;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;
use proto_core::wire::state::StatePacket;
use recipe_config::file::{Text, parse_controller};
use recipe_config::{InitialTarget, SimConfig};

use super::faults::Link;
use super::{BuildError, ConnId, Controller, ControllerInput, ControllerOutput};

/// A controller, its clients and its devices on one clock. Nothing here opens a socket or waits.
///
/// ```
/// use proto_core::time::Duration;
/// use recipe_controller::{Link, TestController};
///
/// let mut robot = TestController::from_toml(r#"
///     [robot]
///     power = "enabled"
///     [[recipe]]
///     name = "outputs"
///     kind = "stream"
///     mode = "realtime"
///     [recipe.input]
///     head = [255, 255]
///     tail = [238, 238]
///     fields = ["DigitalOutputCommand[1]"]
///     [[port]]
///     name = "rs485"
///     bus = "rs485"
///     recipe = "outputs"
/// "#).unwrap();
///
/// // A device on its own recipe port switches DO1 on.
/// robot.port_bytes(0, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
/// robot.run(Duration::from_millis(20));
/// assert_eq!(robot.value("DO[1]"), 1.0);
///
/// // A client of port 2000 asks how it is.
/// let client = robot.connect(Link::Command);
/// robot.send(client, b"state\n");
/// robot.run(Duration::from_millis(20));
/// assert_eq!(robot.take(client), b"6:0:5:2");
/// ```
///
/// Faults are methods of [`Controller`]: see [`Self::controller_mut`].
#[derive(Debug)]
pub struct TestController {
    pub(crate) controller: Controller,
    pub(crate) now: Instant,
    links: BTreeMap<ConnId, Link>,
    /// Bytes that each connection has received and no call has returned.
    received: BTreeMap<ConnId, Vec<u8>>,
    pub(crate) closed: Vec<ConnId>,
    /// Data sent by ports, with the time.
    pub(crate) sent: Vec<(Instant, usize, Out)>,
    /// Packets sent to all clients of port 2001, with the time.
    pub(crate) packets: Vec<(Instant, StatePacket)>,
    /// How long a port takes to send.
    pub(crate) line_time: Duration,
    leaving: Vec<(Instant, usize)>,
    pub(crate) shut_down: bool,
    next_conn: u64,
}

/// Data sent by a port of a [`TestController`].
#[derive(Debug, Clone, PartialEq)]
pub enum Out {
    /// Bytes on a line or connection, or one datagram of a UDP client.
    Bytes(Vec<u8>),
    /// A frame on a CAN bus.
    Can(CanFrame),
    /// A datagram of the UDP server, and its receiver. The port number is [`usize::MAX`].
    Datagram(SocketAddr, Vec<u8>),
    /// It closed its connection.
    Closed,
}

impl TestController {
    /// A controller that was switched on a second ago; the devices of all its ports are up.
    ///
    /// # Errors
    /// Same as [`Controller::new`].
    pub fn new(config: &SimConfig) -> Result<Self, BuildError> {
        let mut robot = Self {
            controller: Controller::new(config)?,
            now: Instant::from_millis(1_000),
            links: BTreeMap::new(),
            received: BTreeMap::new(),
            closed: Vec::new(),
            sent: Vec::new(),
            packets: Vec::new(),
            line_time: Duration::from_micros(700),
            leaving: Vec::new(),
            shut_down: false,
            next_conn: 1,
        };
        for port in 0..config.ports.len() {
            robot.input(ControllerInput::PortUp { port });
        }
        Ok(robot)
    }

    /// The controller of a configuration file's text; [`Self::new`] takes one that was read before.
    ///
    /// # Errors
    /// The first mistake in the text, with its place, or what [`Controller::new`] refuses.
    pub fn from_toml(toml: &str) -> Result<Self, Box<dyn Error + Send + Sync>> {
        let config = parse_controller(Text { name: "controller", toml }, &[])?;
        Ok(Self::new(&config)?)
    }

    /// The present instant.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The controller itself.
    pub fn controller(&self) -> &Controller {
        &self.controller
    }

    /// The controller itself, mutable, to cause faults; the effects begin with the next
    /// [`Self::run`].
    pub fn controller_mut(&mut self) -> &mut Controller {
        &mut self.controller
    }

    /// Advances time, deadline by deadline, by a [`std::time::Duration`] or one of proto-core.
    ///
    /// # Panics
    /// If the controller does nothing at a deadline that it has set.
    pub fn run(&mut self, span: impl Into<Duration>) {
        let end = self.now + span.into();
        loop {
            let wake = self.drain();
            let left = self.leaving.iter().map(|leaving| leaving.0).min().unwrap_or(Instant::NEVER);
            let next = wake.min(left);
            assert!(next > self.now || left <= self.now, "a deadline that has come must be served");
            if next > end {
                self.now = end;
                self.drain();
                return;
            }
            self.now = next;
            if let Some(nth) = self.leaving.iter().position(|leaving| leaving.0 <= next) {
                let (_, port) = self.leaving.remove(nth);
                self.input(ControllerInput::PortSent { port });
            }
        }
    }

    /// A client on this host connects to one of the servers. If it is refused, its connection is
    /// closed: [`Self::is_closed`].
    pub fn connect(&mut self, link: Link) -> ConnId {
        let conn = self.new_conn();
        self.links.insert(conn, link);
        let from = NEAR;
        self.input(match link {
            Link::Command => ControllerInput::CommandOpened { conn, from },
            Link::State => ControllerInput::StateOpened { conn, from },
            Link::Modbus => ControllerInput::ModbusOpened { conn, from },
        });
        conn
    }

    /// The client sends bytes, in one piece. Port 2001 takes none.
    pub fn send(&mut self, conn: ConnId, bytes: &[u8]) {
        match self.links.get(&conn) {
            Some(Link::Command) => self.input(ControllerInput::CommandBytes { conn, bytes }),
            Some(Link::Modbus) => self.input(ControllerInput::ModbusBytes { conn, bytes }),
            Some(Link::State) | None => {}
        }
    }

    /// The client closes its connection.
    pub fn close(&mut self, conn: ConnId) {
        match self.links.remove(&conn) {
            Some(Link::Command) => self.input(ControllerInput::CommandClosed { conn }),
            Some(Link::State) => self.input(ControllerInput::StateClosed { conn }),
            Some(Link::Modbus) => self.input(ControllerInput::ModbusClosed { conn }),
            None => {}
        }
    }

    /// The bytes that the client has received since the last call.
    pub fn take(&mut self, conn: ConnId) -> Vec<u8> {
        self.received.remove(&conn).unwrap_or_default()
    }

    /// Whether the controller has closed the connection.
    pub fn is_closed(&self, conn: ConnId) -> bool {
        self.closed.contains(&conn)
    }

    /// Bytes arrive at a serial or TCP port, in one piece, or one datagram at a UDP client. Ports
    /// are numbered in the order of their file.
    pub fn port_bytes(&mut self, port: usize, bytes: &[u8]) {
        self.input(ControllerInput::PortBytes { port, bytes });
    }

    /// A frame arrives at a CAN port.
    pub fn port_frame(&mut self, port: usize, frame: CanFrame) {
        self.input(ControllerInput::PortCan { port, frame });
    }

    /// A datagram arrives at the UDP server.
    pub fn datagram(&mut self, peer: SocketAddr, bytes: &[u8]) {
        self.input(ControllerInput::Udp2011 { peer, bytes });
    }

    /// The data that ports have sent since the last call, each with its time and port.
    pub fn take_sent(&mut self) -> Vec<(Instant, usize, Out)> {
        std::mem::take(&mut self.sent)
    }

    /// The present value of an item, such as `DO[1]` or `FloatInputReg[3]`.
    ///
    /// # Panics
    /// If there is no such item.
    #[track_caller]
    pub fn value(&self, name: &str) -> f64 {
        self.controller.registers().value(target(name))
    }

    /// Sets an item from outside, such as an input that is wired.
    ///
    /// # Panics
    /// If there is no such item, or it does not take the value.
    #[track_caller]
    pub fn set_value(&mut self, name: &str, value: f64) {
        if let Err(error) = self.controller.force(target(name), value) {
            panic!("{name} = {value}: {error}");
        }
    }

    /// Whether the controller was shut down, by a command.
    pub fn is_shut_down(&self) -> bool {
        self.shut_down
    }

    pub(crate) fn new_conn(&mut self) -> ConnId {
        self.next_conn += 1;
        ConnId(self.next_conn)
    }

    pub(crate) fn input(&mut self, input: ControllerInput<'_>) {
        self.controller.handle(self.now, input);
        self.drain();
    }

    /// Takes all outputs and returns when to call again.
    pub(crate) fn drain(&mut self) -> Instant {
        loop {
            match self.controller.poll_output(self.now) {
                ControllerOutput::Send { conn, bytes } => {
                    self.received.entry(conn).or_default().extend_from_slice(&bytes);
                }
                ControllerOutput::Close { conn } => {
                    self.links.remove(&conn);
                    self.closed.push(conn);
                }
                ControllerOutput::StatePacket { bytes } => {
                    for (conn, _) in self.links.iter().filter(|(_, link)| **link == Link::State) {
                        self.received.entry(*conn).or_default().extend_from_slice(&bytes[..]);
                    }
                    self.packets.extend(StatePacket::parse(&bytes[..]).map(|packet| (self.now, packet)));
                }
                ControllerOutput::UdpSend { peer, bytes } => {
                    self.sent.push((self.now, usize::MAX, Out::Datagram(peer, bytes)));
                }
                ControllerOutput::PortSend { port, bytes } => {
                    self.sent.push((self.now, port, Out::Bytes(bytes)));
                    self.leaving.push((self.now + self.line_time, port));
                }
                ControllerOutput::PortSendCan { port, frame } => {
                    self.sent.push((self.now, port, Out::Can(frame)));
                    if !self.leaving.iter().any(|leaving| leaving.1 == port) {
                        self.leaving.push((self.now + self.line_time, port));
                    }
                }
                ControllerOutput::PortClose { port } => self.sent.push((self.now, port, Out::Closed)),
                ControllerOutput::Shutdown => self.shut_down = true,
                ControllerOutput::Sleep { until } => return until,
            }
        }
    }
}

/// # Panics
/// If there is no such item.
#[track_caller]
fn target(name: &str) -> InitialTarget {
    name.parse().unwrap_or_else(|error| panic!("{error}"))
}

/// The address of clients.
pub(crate) const NEAR: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
