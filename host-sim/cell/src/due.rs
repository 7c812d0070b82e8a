//! What is to happen in the cell at a later instant.

use std::net::SocketAddr;

use proto_core::engine::LinkId;
use proto_core::time::Duration;

use super::line::Chunk;
use super::network::{Speaker, Way};
use super::{BusId, LineId};

/// What is to happen at a later instant.
#[derive(Debug)]
pub(super) enum Due {
    LinkUp {
        link: LinkId,
        turn: u64,
    },
    LinkDown {
        link: LinkId,
        turn: u64,
    },
    LinkSent {
        link: LinkId,
        turn: u64,
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
        from: Speaker,
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
    /// What the line has gathered is handed over.
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
    /// TCP itself gives a dead connection up.
    TimedOut {
        conn: u64,
    },
    /// A connection is asked for again.
    Knock {
        link: LinkId,
        turn: u64,
        pause: Duration,
    },
    /// The gateway's reset comes to the controller.
    ResetUp {
        conn: u64,
    },
    /// The controller's comes to the gateway.
    ResetDown {
        conn: u64,
    },
    /// What was lost of a connection is sent again.
    SendAgain {
        conn: u64,
        way: Way,
    },
    /// The controller's TCP acknowledges what has come.
    AckLeaves {
        conn: u64,
    },
    /// Its acknowledgement comes to the gateway.
    Ack {
        conn: u64,
        upto: u64,
    },
    /// The gateway's transport looks whether nothing was acknowledged for too long.
    UserTimeout {
        conn: u64,
    },
    /// The gateway's driver looks at what is acknowledged.
    Look {
        link: LinkId,
        turn: u64,
    },
    /// The gateway is called again.
    Wake {
        turn: u64,
    },
    /// The model that watches looks at how everything is.
    Survey,
}
