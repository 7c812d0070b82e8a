//! TCP connections between the gateway and the controller, both directions of each.

use proto_core::engine::LinkId;

use super::network::Way;
use super::tcp::Pipe;
use recipe_controller::Link;

/// The controller's end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Peer {
    /// One of its servers.
    Server(Link),
    /// The TCP client of a recipe port.
    Client(usize),
}

/// A TCP connection.
#[derive(Debug)]
pub(super) struct Connection {
    pub link: LinkId,
    pub peer: Peer,
    pub up: Pipe,
    pub down: Pipe,
    /// The controller has been told of the connection.
    pub accepted: bool,
    /// The controller has closed its end.
    pub closing: bool,
    /// The gateway has closed its end, and the controller does not know it yet.
    pub abandoned: bool,
    /// The controller has lost its end in a power cut: data that arrives there is answered with a reset.
    pub forgotten: bool,
    /// The controller's TCP has to acknowledge received data.
    pub owes_ack: bool,
    /// The gateway's transport will check for a timeout: [`super::due::Due::UserTimeout`] is queued.
    pub is_watched: bool,
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
        }
    }

    pub(super) fn pipe(&mut self, way: Way) -> &mut Pipe {
        match way {
            Way::Up => &mut self.up,
            Way::Down => &mut self.down,
        }
    }
}
