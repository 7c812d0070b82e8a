//! Who gets the UDP server's frames (docs/simulated-controller.md section 5, D24).

use std::net::SocketAddr;

use proto_core::time::Instant;

/// The addresses a UDP server streams to.
#[derive(Debug, Clone, Default)]
pub(super) struct Clients {
    known: Vec<(SocketAddr, Instant)>,
}

/// Most of them at a time.
pub const MAX_UDP_CLIENTS: usize = 8;

impl Clients {
    /// A datagram came from `peer`. Returns whether another client had to make room: the one that
    /// has been silent longest.
    pub(super) fn heard(&mut self, now: Instant, peer: SocketAddr) -> bool {
        if let Some(client) = self.known.iter_mut().find(|client| client.0 == peer) {
            client.1 = now;
            return false;
        }
        let full = self.known.len() >= MAX_UDP_CLIENTS;
        if full {
            let oldest = self.known.iter().enumerate().min_by_key(|(_, client)| client.1);
            if let Some(nth) = oldest.map(|(nth, _)| nth) {
                self.known.remove(nth);
            }
        }
        self.known.push((peer, now));
        full
    }

    /// `peer` cannot be reached: nobody listens there any more. Returns whether it was a client.
    pub(super) fn unreachable(&mut self, peer: SocketAddr) -> bool {
        let before = self.known.len();
        self.known.retain(|client| client.0 != peer);
        self.known.len() != before
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = SocketAddr> + '_ {
        self.known.iter().map(|client| client.0)
    }

    pub(super) fn clear(&mut self) {
        self.known.clear();
    }
}
