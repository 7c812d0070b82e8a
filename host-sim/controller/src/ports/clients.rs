//! The clients of the UDP server (docs/simulated-controller.md section 5, D24, D30).

use std::cmp::Reverse;
use std::net::SocketAddr;

use proto_core::time::{Duration, Instant};

/// The addresses that the UDP server streams to.
#[derive(Debug, Clone, Default)]
pub(super) struct Clients {
    /// Addresses with the time of the newest datagram.
    known: Vec<(SocketAddr, Instant)>,
}

/// Maximum number of UDP clients.
pub const MAX_UDP_CLIENTS: usize = 8;
/// A client that should send is removed after this silence (D30). Otherwise a forged address would get the stream for
/// ever.
const SILENCE: Duration = Duration::from_secs(60);

impl Clients {
    /// Handles a datagram from `peer`. Returns whether another client was displaced: the one silent for longest, of the
    /// address with the most clients, including the new one. A host that sends from many ports thus displaces its own
    /// clients.
    pub(super) fn add(&mut self, now: Instant, peer: SocketAddr) -> bool {
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
            let displaced =
                clients.max_by_key(|(_, (client, heard))| (of_its_address(client), Reverse(*heard)));
            if let Some(nth) = displaced.map(|(nth, _)| nth) {
                self.known.remove(nth);
            }
        }
        self.known.push((peer, now));
        full
    }

    /// Removes clients that have been silent for too long and returns their number.
    pub(super) fn forget_silent(&mut self, now: Instant) -> usize {
        let before = self.known.len();
        self.known.retain(|&(_, heard)| now.saturating_since(heard) < SILENCE);
        before - self.known.len()
    }

    /// Removes `peer`, which cannot be reached. Returns whether it was a client.
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
    fn the_client_silent_for_longest_is_displaced() {
        let mut clients = Clients::default();
        for port in 0..8 {
            assert!(!clients.add(at(u64::from(port)), peer(1, port)));
        }
        assert!(!clients.add(at(10), peer(1, 0)));
        assert!(clients.add(at(11), peer(1, 8)));
        assert!(clients.iter().all(|client| client != peer(1, 1)));
        assert_eq!(clients.iter().count(), MAX_UDP_CLIENTS);
    }

    #[test]
    fn a_host_with_many_ports_displaces_only_itself() {
        let mut clients = Clients::default();
        clients.add(at(0), peer(1, 1));
        clients.add(at(1), peer(2, 1));
        for port in 0..1_000 {
            clients.add(at(2 + u64::from(port)), peer(3, port));
        }
        let kept: Vec<_> = clients.iter().collect();
        assert!(kept.contains(&peer(1, 1)) && kept.contains(&peer(2, 1)), "{kept:?}");
        // It is also displaced by clients of other hosts.
        clients.add(at(2_000), peer(4, 1));
        assert_eq!(clients.iter().filter(|client| client.ip() == peer(3, 0).ip()).count(), 5);
    }
}
