//! Which client is disconnected when a new client connects to a full server (docs/devices.md section 7).
//!
//! A host that only holds connections open must neither keep out clients that send requests nor displace them.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::IpAddr;

use proto_core::time::{Duration, Instant};

use super::{ConnId, Link};

#[derive(Debug, Default)]
pub(super) struct ClientActivities(BTreeMap<ConnId, ClientActivity>);

#[derive(Debug, Clone, Copy)]
struct ClientActivity {
    link: Link,
    from: IpAddr,
    has_asked: bool,
    /// Time of the newest request or reply, or of the connection's start.
    newest: Instant,
}

impl ClientActivities {
    pub(super) fn opened(&mut self, now: Instant, link: Link, conn: ConnId, from: IpAddr) {
        self.0.insert(conn, ClientActivity { link, from, has_asked: false, newest: now });
    }

    /// Records a complete request of the client, or a reply to it.
    pub(super) fn active(&mut self, now: Instant, conn: ConnId) {
        if let Some(place) = self.0.get_mut(&conn) {
            place.has_asked = true;
            place.newest = now;
        }
    }

    pub(super) fn closed(&mut self, conn: ConnId) {
        self.0.remove(&conn);
    }

    /// The client to disconnect from a full server of `max` clients for a new client from this address; `None` if the
    /// new client is refused.
    pub(super) fn to_displace(&self, now: Instant, link: Link, from: IpAddr, max: usize) -> Option<ConnId> {
        let here = || self.0.iter().filter(|(_, place)| place.link == link);
        // Number of clients of an address, including the new one.
        let share =
            |of: IpAddr| here().filter(|(_, place)| place.from == of).count() + usize::from(of == from);
        let own = share(from);
        let shares = here().map(|(&conn, place)| (conn, place, share(place.from)));
        // Idle clients of the address with the most clients: first those that never sent a request, then the one whose
        // request is oldest. Clients of port 2001 send no requests and are never idle.
        let idle = shares.clone().filter(|(_, place, share)| {
            link != Link::State && now.saturating_since(place.newest) >= IDLE && *share >= own
        });
        let idle = idle.max_by_key(|(conn, place, share)| {
            (*share, !place.has_asked, Reverse(place.newest), Reverse(*conn))
        });
        // Even active clients, if one host holds more than half of all connections.
        let hog = || {
            let hogs = shares.filter(|(_, place, share)| place.from != from && *share > max / 2);
            hogs.min_by_key(|(_, place, _)| place.newest)
        };
        idle.or_else(hog).map(|(conn, ..)| conn)
    }
}

/// A client without a request for this long is idle.
const IDLE: Duration = Duration::from_secs(5);
