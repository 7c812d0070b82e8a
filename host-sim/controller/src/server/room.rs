//! Who makes room at a server that has no place left (docs/devices.md section 7).
//!
//! A host that only holds connections must not keep out those that have something to ask, and must
//! not get their places either.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::IpAddr;

use proto_core::time::{Duration, Instant};

use super::{ConnId, Link};

/// What is known of the clients of all servers.
#[derive(Debug, Default)]
pub(super) struct Places(BTreeMap<ConnId, Place>);

#[derive(Debug, Clone, Copy)]
struct Place {
    link: Link,
    from: IpAddr,
    has_asked: bool,
    /// When it asked last or, before that, came.
    newest: Instant,
}

impl Places {
    pub(super) fn opened(&mut self, now: Instant, link: Link, conn: ConnId, from: IpAddr) {
        self.0.insert(conn, Place { link, from, has_asked: false, newest: now });
    }

    /// It asked for something whole, or was answered.
    pub(super) fn asked(&mut self, now: Instant, conn: ConnId) {
        if let Some(place) = self.0.get_mut(&conn) {
            place.has_asked = true;
            place.newest = now;
        }
    }

    pub(super) fn closed(&mut self, conn: ConnId) {
        self.0.remove(&conn);
    }

    /// Who makes room for a client from this address, of a server with `most` places and none left.
    pub(super) fn gives(&self, now: Instant, link: Link, from: IpAddr, most: usize) -> Option<ConnId> {
        let here = || self.0.iter().filter(|(_, place)| place.link == link);
        // With the newcomer.
        let share =
            |of: IpAddr| here().filter(|(_, place)| place.from == of).count() + usize::from(of == from);
        let own = share(from);
        let shares = here().map(|(&conn, place)| (conn, place, share(place.from)));
        // Of the address that has most: first who never asked, then who asked longest ago. Who only
        // listens is never idle.
        let idle = shares.clone().filter(|(_, place, share)| {
            link != Link::State && now.saturating_since(place.newest) >= IDLE && *share >= own
        });
        let idle = idle.max_by_key(|(conn, place, share)| {
            (*share, !place.has_asked, Reverse(place.newest), Reverse(*conn))
        });
        // Even those that ask all the time, when one host has more than half of all places.
        let hog = || {
            let hogs = shares.filter(|(_, place, share)| place.from != from && *share > most / 2);
            hogs.min_by_key(|(_, place, _)| place.newest)
        };
        idle.or_else(hog).map(|(conn, ..)| conn)
    }
}

/// Who has asked for nothing for this long makes room when there is none.
const IDLE: Duration = Duration::from_secs(5);
