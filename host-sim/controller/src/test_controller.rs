//! The simulated controller in virtual time, for tests: clients and devices are method calls, and the clock
//! jumps from deadline to deadline.

use std::collections::BTreeMap;
use std::error::Error;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;
use proto_core::wire::state::StatePacket;
use recipe_config::SimConfig;
use recipe_config::file::{Text, parse_controller};
use serde_json::Value;

use super::common::Link;
use super::operations::{Operation, Refused};
use super::{BuildError, ConnId, Controller, ControllerInput, ControllerOutput};

/// A simulated controller with its clients and devices, on a virtual clock. It opens no socket and never
/// waits, so a test takes milliseconds and every run is the same.
///
/// Calls that send return at once; what follows happens in [`Self::run`]. Errors of the test itself, such as
/// the name of an item that does not exist, panic at the caller's line.
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
/// // A client of port 2000 asks for the states: enabled, stopped, run, remote.
/// let client = robot.connect(Link::Command);
/// robot.send(client, b"state\n");
/// robot.run(Duration::from_millis(20));
/// assert_eq!(robot.take(client), b"6:0:5:2");
/// ```
///
/// Faults, such as a mute server or an emergency stop, are methods of [`Controller`]: see [`Self::controller_mut`].
#[derive(Debug)]
pub struct TestController {
    pub(crate) controller: Controller,
    pub(crate) now: Instant,
    links: BTreeMap<ConnId, Link>,
    /// Bytes that each client has received and [`Self::take`] has not returned.
    pub(crate) received: BTreeMap<ConnId, Vec<u8>>,
    pub(crate) closed: Vec<ConnId>,
    pub(crate) sent: Vec<(Instant, usize, Out)>,
    /// Packets sent to all clients of port 2001, with the time.
    pub(crate) packets: Vec<(Instant, StatePacket)>,
    pub(crate) line_time: Duration,
    /// Ports that are sending, with the time of their end.
    sending: Vec<(Instant, usize)>,
    pub(crate) shut_down: bool,
    next_conn: u64,
}

/// What a port of a [`TestController`] has sent, as [`TestController::take_sent`] returns it.
#[derive(Debug, Clone, PartialEq)]
pub enum Out {
    /// One frame on an RS-485 line or a TCP connection, or one datagram of a UDP client port.
    Bytes(Vec<u8>),
    /// A frame on a CAN bus.
    Can(CanFrame),
    /// A datagram of the UDP server (port 2011), with its receiver. Its port index is [`usize::MAX`].
    Datagram(SocketAddr, Vec<u8>),
    /// The port closed its TCP connection.
    Closed,
}

impl TestController {
    /// A controller with this configuration. The clock is at 1 s, and the devices of all ports are up.
    ///
    /// # Errors
    /// [`BuildError`], as [`Controller::new`].
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
            sending: Vec::new(),
            shut_down: false,
            next_conn: 1,
        };
        for port in 0..config.ports.len() {
            robot.input(ControllerInput::PortUp { port });
        }
        Ok(robot)
    }

    /// As [`Self::new`], from the text of a configuration file (docs/configuration.md section 5).
    ///
    /// # Errors
    /// The first mistake in the text, with its line, or a [`BuildError`].
    pub fn from_toml(toml: &str) -> Result<Self, Box<dyn Error + Send + Sync>> {
        let config = parse_controller(Text { name: "controller", toml }, &[])?;
        Ok(Self::new(&config)?)
    }

    /// The virtual time, in microseconds; [`Self::run`] advances it.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The controller: its registers, states, counters and program log.
    pub fn controller(&self) -> &Controller {
        &self.controller
    }

    /// The controller, for faults and operations at the teach pendant. Their effects begin with the next [`Self::run`].
    pub fn controller_mut(&mut self) -> &mut Controller {
        &mut self.controller
    }

    /// Advances the clock by `span`, a [`std::time::Duration`] or a [`proto_core::time::Duration`], and
    /// handles every deadline on the way. A span of zero handles what is due now.
    ///
    /// # Panics
    /// If the controller does not handle its deadline, which would be a bug of this crate.
    pub fn run(&mut self, span: impl Into<Duration>) {
        let end = self.now + span.into();
        loop {
            let wake = self.drain();
            let sent = self.sending.iter().map(|sending| sending.0).min().unwrap_or(Instant::NEVER);
            let next = wake.min(sent);
            assert!(next > self.now || sent <= self.now, "the controller has not handled its deadline");
            if next > end {
                self.now = end;
                self.drain();
                return;
            }
            self.now = next;
            if let Some(nth) = self.sending.iter().position(|sending| sending.0 <= next) {
                let (_, port) = self.sending.remove(nth);
                self.input(ControllerInput::PortSent { port });
            }
        }
    }

    /// Connects a client to one of the servers, from 127.0.0.1. Returns its connection even if the server
    /// refuses it: [`Self::is_closed`] is true then.
    pub fn connect(&mut self, link: Link) -> ConnId {
        let conn = self.new_conn();
        self.links.insert(conn, link);
        let from = CLIENT_ADDRESS;
        self.input(match link {
            Link::Command => ControllerInput::CommandOpened { conn, from },
            Link::State => ControllerInput::StateOpened { conn, from },
            Link::Modbus => ControllerInput::ModbusOpened { conn, from },
        });
        conn
    }

    /// Sends bytes from a client, in one piece: commands (proto-core/docs/wire/command.md section 2), or a
    /// Modbus TCP request (proto-core/docs/wire/modbus.md section 2). Without effect on a closed connection,
    /// and on port 2001, which reads nothing.
    ///
    /// A command ends with a line end, or when nothing follows it (section 5).
    pub fn send(&mut self, conn: ConnId, bytes: &[u8]) {
        match self.links.get(&conn) {
            Some(Link::Command) => self.input(ControllerInput::CommandBytes { conn, bytes }),
            Some(Link::Modbus) => self.input(ControllerInput::ModbusBytes { conn, bytes }),
            Some(Link::State) | None => {}
        }
    }

    /// Closes a client's connection. Without effect if it is closed already.
    pub fn close(&mut self, conn: ConnId) {
        match self.links.remove(&conn) {
            Some(Link::Command) => self.input(ControllerInput::CommandClosed { conn }),
            Some(Link::State) => self.input(ControllerInput::StateClosed { conn }),
            Some(Link::Modbus) => self.input(ControllerInput::ModbusClosed { conn }),
            None => {}
        }
    }

    /// The bytes that the client has received since the last call; empty if there are none. On port 2001 they
    /// are packets of 1468 bytes (proto-core/docs/wire/state.md section 2).
    pub fn take(&mut self, conn: ConnId) -> Vec<u8> {
        self.received.remove(&conn).unwrap_or_default()
    }

    /// Whether the controller has closed the connection. `false` if [`Self::close`] did.
    pub fn is_closed(&self, conn: ConnId) -> bool {
        self.closed.contains(&conn)
    }

    /// Delivers bytes to an RS-485 or TCP client port, in one piece, or one datagram to a UDP client port.
    /// `port` is its index in the configuration, from 0; without effect if there is no such port.
    pub fn port_bytes(&mut self, port: usize, bytes: &[u8]) {
        self.input(ControllerInput::PortBytes { port, bytes });
    }

    /// Delivers a frame to a CAN port. `port` is its index in the configuration, from 0; without effect if
    /// there is no such port.
    pub fn port_frame(&mut self, port: usize, frame: CanFrame) {
        self.input(ControllerInput::PortCan { port, frame });
    }

    /// Delivers a datagram from `peer` to the UDP server (port 2011). The server streams to `peer` from then
    /// on (docs/simulated-controller.md section 5).
    pub fn datagram(&mut self, peer: SocketAddr, bytes: &[u8]) {
        self.input(ControllerInput::Udp2011 { peer, bytes });
    }

    /// Everything that ports have sent since the last call, in order: time, port index, data.
    pub fn take_sent(&mut self) -> Vec<(Instant, usize, Out)> {
        std::mem::take(&mut self.sent)
    }

    /// The value of a system variable or an input or output, such as `FloatInputReg[3]` or `DO[1]`, of a state such as
    /// `running`, or of an item of the state packet such as `drive_error[2]` ([`Controller::item`]). A bit is 0.0 or
    /// 1.0; other units are those of the item (docs/configuration.md section 5).
    ///
    /// # Panics
    /// If there is no such item.
    #[track_caller]
    pub fn value(&self, name: &str) -> f64 {
        self.controller.item(name).unwrap_or_else(|error| panic!("{error}"))
    }

    /// Sets a system variable or an input or output, as outside wiring would, or an item of the state packet
    /// ([`Controller::force_item`]). Name and unit are as in [`Self::value`].
    ///
    /// # Panics
    /// If there is no such item, or the value is out of its range.
    #[track_caller]
    pub fn set_value(&mut self, name: &str, value: f64) {
        if let Err(error) = self.controller.force_item(name, value) {
            panic!("{error} (to be set to {value})");
        }
    }

    /// Executes an operation, given as JSON (docs/control.md section 2), and returns its result.
    ///
    /// # Errors
    /// [`Refused`]: why it was refused; nothing changed.
    pub fn operate(&mut self, operation: &str) -> Result<Value, Refused> {
        let object = serde_json::from_str(operation).map_err(|error| Refused(error.to_string()))?;
        let result = self.controller.operate(self.now, &Operation::from_json(object)?);
        self.drain();
        result
    }

    /// Whether the controller was shut down by the command `shutdown`.
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

    /// Executes all outputs and returns when to call again.
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
                    self.sending.push((self.now + self.line_time, port));
                }
                ControllerOutput::PortSendCan { port, frame } => {
                    self.sent.push((self.now, port, Out::Can(frame)));
                    if !self.sending.iter().any(|sending| sending.1 == port) {
                        self.sending.push((self.now + self.line_time, port));
                    }
                }
                ControllerOutput::PortClose { port } => self.sent.push((self.now, port, Out::Closed)),
                ControllerOutput::Shutdown => self.shut_down = true,
                ControllerOutput::Sleep { until } => return until,
            }
        }
    }
}

pub(crate) const CLIENT_ADDRESS: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
