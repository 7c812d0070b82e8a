//! Events of the cell at a later instant.

use std::net::SocketAddr;

use proto_core::engine::LinkId;
use proto_core::time::Duration;

use super::line::Chunk;
use super::network::{Sender, Way};
use super::{BusId, LineId};

/// An event at a later instant.
#[derive(Debug)]
pub(super) enum Due {
    LinkUp {
        link: LinkId,
        generation: u64,
    },
    LinkDown {
        link: LinkId,
        generation: u64,
    },
    LinkSent {
        link: LinkId,
        generation: u64,
    },
    Arrival {
        conn: u64,
        way: Way,
    },
    DatagramUp {
        link: LinkId,
        peer: SocketAddr,
        tag: u64,
        bytes: Vec<u8>,
    },
    DatagramDown {
        link: LinkId,
        peer: SocketAddr,
        bytes: Vec<u8>,
    },
    ClientDatagramUp {
        port: usize,
        tag: u64,
        bytes: Vec<u8>,
    },
    ClientDatagramDown {
        link: LinkId,
        from: Sender,
        bytes: Vec<u8>,
    },
    Unreachable {
        peer: SocketAddr,
    },
    ClientTries {
        port: usize,
    },
    Chunk {
        line: LineId,
        chunk: Chunk,
    },
    /// Bytes that a line has gathered are reported.
    Gathered {
        line: LineId,
    },
    CanDone {
        bus: BusId,
    },
    DeviceSends {
        line: LineId,
        bytes: Vec<u8>,
    },
    /// TCP gives up a half-open connection.
    TimedOut {
        conn: u64,
    },
    /// A connection attempt is repeated.
    Connect {
        link: LinkId,
        generation: u64,
        pause: Duration,
    },
    /// The gateway's reset arrives at the controller.
    ResetUp {
        conn: u64,
    },
    /// The controller's reset arrives at the gateway.
    ResetDown {
        conn: u64,
    },
    /// Lost data of a connection is retransmitted.
    Retransmit {
        conn: u64,
        way: Way,
    },
    /// The controller's TCP acknowledges received data.
    AckLeaves {
        conn: u64,
    },
    /// An acknowledgement arrives at the gateway.
    Ack {
        conn: u64,
        upto: u64,
    },
    /// The gateway's transport checks whether nothing was acknowledged for too long.
    UserTimeout {
        conn: u64,
    },
    /// The gateway's driver reads how much is acknowledged.
    ReadAcks {
        link: LinkId,
        generation: u64,
    },
    /// The gateway is called again.
    Wake {
        generation: u64,
    },
    /// The model checks what should have arrived.
    Survey,
}
