//! Who gets the UDP server's frames (docs/simulated-controller.md section 5, D24, D30).

use std::cmp::Reverse;
use std::net::SocketAddr;

use proto_core::time::{Duration, Instant};

/// The addresses a UDP server streams to.
#[derive(Debug, Clone, Default)]
pub(super) struct Clients {
    known: Vec<(SocketAddr, Instant)>,
}

/// Most of them at a time.
pub const MAX_UDP_CLIENTS: usize = 8;
/// Who is expected to send and has not for this long is streamed to no more (D30): whoever can forge an
/// address could point the stream at it for ever.
const SILENCE: Duration = Duration::from_secs(60);

impl Clients {
    /// A datagram came from `peer`. Returns whether another client had to make room: of the address that
    /// has the most clients, the newcomer among them, the one that has been silent longest. So a host that
    /// sends from ever new ports displaces itself.
    pub(super) fn heard(&mut self, now: Instant, peer: SocketAddr) -> bool {
        if let Some(client) = self.known.iter_mut().find(|client| client.0 == peer) {
            client.1 = now;
            return false;
        }
        let full = self.known.len() >= MAX_UDP_CLIENTS;
        if full {
            let of_its_address = |client: &SocketAddr| {
                let addresses = self.known.iter().map(|client| client.0.ip()).chain([peer.ip()]);
                addresses.filter(|&address| address == client.ip()).count()
            };
            let clients = self.known.iter().enumerate();
            let gives = clients.max_by_key(|(_, (client, heard))| (of_its_address(client), Reverse(*heard)));
            if let Some(nth) = gives.map(|(nth, _)| nth) {
                self.known.remove(nth);
            }
        }
        self.known.push((peer, now));
        full
    }

    /// Forgets those that have been silent for too long, and returns how many.
    pub(super) fn forget_silent(&mut self, now: Instant) -> usize {
        let before = self.known.len();
        self.known.retain(|&(_, heard)| now.saturating_since(heard) < SILENCE);
        before - self.known.len()
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

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::ZERO + Duration::from_millis(millis)
    }

    fn peer(host: u8, port: u16) -> SocketAddr {
        ([127, 0, 0, host], port).into()
    }

    #[test]
    fn the_one_that_has_been_silent_longest_makes_room() {
        let mut clients = Clients::default();
        for port in 0..8 {
            assert!(!clients.heard(at(u64::from(port)), peer(1, port)));
        }
        assert!(!clients.heard(at(10), peer(1, 0)));
        assert!(clients.heard(at(11), peer(1, 8)));
        assert!(clients.iter().all(|client| client != peer(1, 1)));
        assert_eq!(clients.iter().count(), MAX_UDP_CLIENTS);
    }

    #[test]
    fn a_host_with_ever_new_ports_displaces_only_itself() {
        let mut clients = Clients::default();
        clients.heard(at(0), peer(1, 1));
        clients.heard(at(1), peer(2, 1));
        for port in 0..1_000 {
            clients.heard(at(2 + u64::from(port)), peer(3, port));
        }
        let kept: Vec<_> = clients.iter().collect();
        assert!(kept.contains(&peer(1, 1)) && kept.contains(&peer(2, 1)), "{kept:?}");
        // And makes room for those that come from elsewhere.
        clients.heard(at(2_000), peer(4, 1));
        assert_eq!(clients.iter().filter(|client| client.ip() == peer(3, 0).ip()).count(), 5);
    }
}
