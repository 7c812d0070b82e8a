//! Connections and datagrams between the gateway and the controller.

use std::collections::VecDeque;

use proto_core::engine::{LinkId, LinkKind};
use proto_core::time::{Duration, Instant};

use super::rng::Rng;
use crate::controller::Link;

/// How one link's network behaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Network {
    /// From one end to the other.
    pub delay: Duration,
    /// Up to this much is added, by chance, to each segment or datagram. Segments keep their
    /// order, datagrams do not.
    pub jitter: Duration,
    /// What is sent on a connection is cut into segments of 1 to so many bytes, by chance.
    pub longest_segment: Option<usize>,
    /// A segment waits up to this long, by chance, for the next one, and comes in one piece with
    /// it.
    pub merge: Duration,
    /// How many datagrams of a million are lost.
    pub loss_ppm: u32,
    /// How many of a million come twice.
    pub duplicate_ppm: u32,
}

impl Default for Network {
    /// A quiet wire: 200 µs, nothing split, nothing lost.
    fn default() -> Self {
        Self {
            delay: Duration::from_micros(200),
            jitter: Duration::ZERO,
            longest_segment: None,
            merge: Duration::ZERO,
            loss_ppm: 0,
            duplicate_ppm: 0,
        }
    }
}

/// Which way something goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// From the gateway to the controller.
    Up,
    /// From the controller to the gateway.
    Down,
}

/// What becomes of an attempt to connect.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Door {
    Open,
    Refuses,
    Silent,
}

/// One link as the network sees it.
#[derive(Debug)]
pub(super) struct Gate {
    pub id: LinkId,
    pub kind: LinkKind,
    pub network: Network,
    pub door: Door,
    pub is_open: bool,
    pub is_up: bool,
    /// One more with each opening and closing: reports of an earlier turn are dropped.
    pub turn: u64,
    pub conn: Option<u64>,
    pub rng: Rng,
}

impl Gate {
    pub(super) fn new(id: LinkId, kind: LinkKind, rng: Rng) -> Self {
        let network = Network::default();
        Self { id, kind, network, door: Door::Open, is_open: false, is_up: false, turn: 0, conn: None, rng }
    }

    pub(super) fn set_open(&mut self, is_open: bool) {
        self.is_open = is_open;
        self.is_up = false;
        self.turn += 1;
        self.conn = None;
    }

    /// When a datagram that leaves now arrives: never, once or twice.
    pub(super) fn datagram_arrivals(&mut self, now: Instant) -> Vec<Instant> {
        let Network { delay, jitter, loss_ppm, duplicate_ppm, .. } = self.network;
        if self.door != Door::Open || self.rng.chance(loss_ppm) {
            return Vec::new();
        }
        let copies = 1 + usize::from(self.rng.chance(duplicate_ppm));
        (0..copies).map(|_| now + delay + self.rng.up_to(jitter)).collect()
    }
}

/// Who is at the controller's end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Peer {
    /// One of its servers.
    Server(Link),
    /// The TCP client of a recipe port.
    Client(usize),
}

/// What travels on a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Item {
    /// The other end is there.
    Opened,
    Bytes(Vec<u8>),
    /// The other end closed, or turned the connection away.
    Closed,
}

/// A TCP connection.
#[derive(Debug)]
pub(super) struct Connection {
    pub link: LinkId,
    pub peer: Peer,
    pub up: Pipe,
    pub down: Pipe,
    /// The controller was told of it.
    pub accepted: bool,
    /// The controller has closed its end.
    pub closing: bool,
}

impl Connection {
    pub(super) fn new(link: LinkId, peer: Peer) -> Self {
        Self { link, peer, up: Pipe::default(), down: Pipe::default(), accepted: false, closing: false }
    }

    pub(super) fn pipe(&mut self, way: Way) -> &mut Pipe {
        match way {
            Way::Up => &mut self.up,
            Way::Down => &mut self.down,
        }
    }
}

/// One direction of a connection.
#[derive(Debug, Default)]
pub(super) struct Pipe {
    items: VecDeque<(Instant, Item)>,
    newest: Instant,
    /// Nothing arrives until it is released.
    pub held: bool,
    /// Nothing arrives any more.
    pub dead: bool,
    /// The connection is reset when so many more bytes have arrived.
    pub reset_after: Option<usize>,
}

/// What has arrived.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Arrived {
    Nothing,
    Item(Item),
    /// The bytes were the last before a reset.
    Reset(Vec<u8>),
}

impl Pipe {
    /// Sends an item; when something of it arrives.
    pub(super) fn send(&mut self, now: Instant, item: Item, gate: &mut Gate) -> Vec<Instant> {
        if self.dead {
            return Vec::new();
        }
        let network = gate.network;
        let mut segments = Vec::new();
        match (item, network.longest_segment) {
            (Item::Bytes(bytes), Some(longest)) => {
                let mut rest = bytes.as_slice();
                while !rest.is_empty() {
                    let len = (gate.rng.between(1, longest.max(1) as u64) as usize).min(rest.len());
                    let (segment, after) = rest.split_at(len);
                    segments.push(Item::Bytes(segment.to_vec()));
                    rest = after;
                }
            }
            (item, _) => segments.push(item),
        }
        let mut arrivals = Vec::new();
        for segment in segments {
            let late = gate.rng.up_to(network.jitter) + gate.rng.up_to(network.merge);
            let mut at = (now + network.delay + late).max(self.newest);
            if network.longest_segment.is_some() && at == self.newest {
                // A segment of its own arrives at a time of its own.
                at += Duration::from_micros(1);
            }
            self.newest = at;
            self.items.push_back((at, segment));
            arrivals.push(at);
        }
        arrivals
    }

    /// The next thing that has arrived; bytes that came together are one piece.
    pub(super) fn next_arrived(&mut self, now: Instant) -> Arrived {
        if self.held || self.dead {
            return Arrived::Nothing;
        }
        let mut joined = Vec::new();
        while let Some((at, item)) = self.items.front_mut()
            && *at <= now
        {
            match item {
                Item::Bytes(bytes) => joined.append(bytes),
                _ if !joined.is_empty() => break,
                _ => {}
            }
            let Some((_, item)) = self.items.pop_front() else { break };
            if !matches!(item, Item::Bytes(_)) {
                return Arrived::Item(item);
            }
        }
        if joined.is_empty() {
            return Arrived::Nothing;
        }
        if let Some(left) = &mut self.reset_after {
            if joined.len() >= *left {
                joined.truncate(*left);
                self.dead = true;
                return Arrived::Reset(joined);
            }
            *left -= joined.len();
        }
        Arrived::Item(Item::Bytes(joined))
    }
}
