//! TCP connections between the gateway and the controller or a device, with both directions.

use std::collections::VecDeque;

use proto_core::engine::LinkId;
use proto_core::time::Instant;

use super::device::Act;
use super::network::Way;
use super::tcp::Pipe;
use recipe_controller::Link;

/// The far end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Peer {
    /// One of the controller's servers.
    Server(Link),
    /// The TCP client of a recipe port of the controller.
    Client(usize),
    /// The device of a field port.
    Device,
}

/// A TCP connection.
#[derive(Debug)]
pub(super) struct Connection {
    pub link: LinkId,
    pub peer: Peer,
    pub up: Pipe,
    pub down: Pipe,
    /// The controller has accepted the connection.
    pub accepted: bool,
    /// The controller has closed its end.
    pub closing: bool,
    /// The gateway has closed its end, and the controller does not know this yet.
    pub abandoned: bool,
    /// The controller has lost its end in a power cut: data that arrives there is answered with a reset.
    pub forgotten: bool,
    /// The controller's TCP has to acknowledge received data.
    pub owes_ack: bool,
    /// The gateway's transport will check for a timeout: [`super::due::Due::UserTimeout`] is queued.
    pub is_watched: bool,
    /// Log entries of a device, each with the number of bytes that must have arrived before it, and when the last was
    /// sent.
    pub acts: VecDeque<(u64, Instant, Act)>,
}

impl Connection {
    pub(super) fn new(link: LinkId, peer: Peer) -> Self {
        Self {
            link,
            peer,
            up: Pipe::new(),
            down: Pipe::new(),
            accepted: false,
            closing: false,
            abandoned: false,
            forgotten: false,
            owes_ack: false,
            is_watched: false,
            acts: VecDeque::new(),
        }
    }

    pub(super) fn pipe(&mut self, way: Way) -> &mut Pipe {
        match way {
            Way::Up => &mut self.up,
            Way::Down => &mut self.down,
        }
    }
}
