//! Inputs and outputs of a [`Controller`](crate::Controller).

use std::net::{IpAddr, SocketAddr};

use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;
use proto_core::wire::state;

/// The number of a connection. The caller assigns it; no two open connections have the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ConnId(pub u64);

/// An event that the caller reports.
///
/// `port` is an index into [`SimConfig::ports`](recipe_config::SimConfig::ports).
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
        /// A piece of the stream, of any size.
        bytes: &'a [u8],
    },
    /// The client of port 2000 disconnected.
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
    /// The client of port 2001 disconnected.
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
        /// A piece of the stream, of any size.
        bytes: &'a [u8],
    },
    /// The Modbus client disconnected.
    ModbusClosed {
        /// Its connection.
        conn: ConnId,
    },
    /// A datagram arrived at UDP 2011.
    Udp2011 {
        /// The sender's address.
        peer: SocketAddr,
        /// The whole datagram.
        bytes: &'a [u8],
    },
    /// An earlier datagram to this address could not be delivered (ICMP).
    Udp2011Unreachable {
        /// The address.
        peer: SocketAddr,
    },
    /// A port's device or connection is up.
    PortUp {
        /// The port.
        port: usize,
    },
    /// A port's device or connection is down.
    PortDown {
        /// The port.
        port: usize,
    },
    /// Bytes arrived at a serial or TCP port, or one datagram at a UDP client.
    PortBytes {
        /// The port.
        port: usize,
        /// A piece of the stream, of any size; a datagram as a whole.
        bytes: &'a [u8],
    },
    /// A frame arrived at a CAN port.
    PortCan {
        /// The port.
        port: usize,
        /// The frame.
        frame: CanFrame,
    },
    /// Everything sent on the port has left.
    PortSent {
        /// The port.
        port: usize,
    },
    /// No event: the deadline of [`ControllerOutput::Sleep`] has passed.
    Tick,
}

/// A task for the caller. The enum is exhaustive because the caller must execute all of them.
#[derive(Debug, Clone, PartialEq)]
pub enum ControllerOutput {
    /// Send bytes on a TCP connection.
    Send {
        /// The connection.
        conn: ConnId,
        /// The bytes.
        bytes: Vec<u8>,
    },
    /// Close a TCP connection after everything for it has left. Report nothing more about it.
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
    /// Send bytes, or one datagram, on a port, and report [`ControllerInput::PortSent`] when they were sent.
    PortSend {
        /// The port.
        port: usize,
        /// The bytes.
        bytes: Vec<u8>,
    },
    /// Send a frame on a CAN port. Up to 32 follow each other; report [`ControllerInput::PortSent`] once, when all of
    /// them were sent.
    PortSendCan {
        /// The port.
        port: usize,
        /// The frame.
        frame: CanFrame,
    },
    /// Close the connection of a TCP client port and connect again. Report [`ControllerInput::PortUp`] when
    /// it is up; the controller counts it as down already.
    PortClose {
        /// The port.
        port: usize,
    },
    /// The controller was shut down by a command: stop listening, and end.
    Shutdown,
    /// Nothing more to do: call again at this instant, or with the next input.
    Sleep {
        /// When to call again, or [`Instant::NEVER`].
        until: Instant,
    },
}
