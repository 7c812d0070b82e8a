//! The network between the gateway and the controller, as each link of the gateway sees it.

use proto_core::engine::{LinkId, LinkKind};
use proto_core::time::{Duration, Instant};

use super::rng::Rng;

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
    /// The controller's TCP acknowledges this long after something has come, unless it has something
    /// to send before.
    pub ack_delay: Duration,
    /// The gateway's driver looks this often at what is acknowledged, and each time before it hands
    /// over what was received; zero: it is told at once.
    pub ack_report: Duration,
    /// How many bytes the gateway's transport keeps that are not acknowledged; behind that the driver
    /// waits for room before it reports a transmission as taken.
    pub send_buffer: u64,
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
            ack_delay: Duration::ZERO,
            ack_report: Duration::ZERO,
            send_buffer: 64 * 1024,
        }
    }
}

impl Network {
    /// How long a segment or datagram takes at most when nothing is broken.
    pub fn slowest(&self) -> Duration {
        self.delay + self.jitter + self.merge
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

impl Way {
    /// Both.
    pub(super) const BOTH: [Self; 2] = [Self::Up, Self::Down];

    pub(super) const fn back(self) -> Self {
        match self {
            Self::Up => Self::Down,
            Self::Down => Self::Up,
        }
    }
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
    /// What goes this way is lost, by [`Way`]: so many faults want it so.
    pub cuts: [u32; 2],
    pub is_open: bool,
    pub is_up: bool,
    /// One more with each opening and closing: reports of an earlier turn are dropped.
    pub turn: u64,
    pub conn: Option<u64>,
    /// The transport has no room for what was handed over last: nothing was reported of it yet.
    pub is_full: bool,
    /// The driver is going to look at what is acknowledged.
    pub looks: bool,
    /// Whom the gateway answers, where it listens for datagrams.
    pub partner: Option<Speaker>,
    pub rng: Rng,
}

/// Who sends datagrams to a port where the gateway listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Speaker {
    /// The controller's client; its socket is another one after each restart.
    Client { socket: u64 },
    /// Another program on the controller's host.
    Stranger,
}

impl Gate {
    pub(super) fn new(id: LinkId, kind: LinkKind, rng: Rng) -> Self {
        let network = Network::default();
        Self {
            id,
            kind,
            network,
            door: Door::Open,
            cuts: [0; 2],
            is_open: false,
            is_up: false,
            turn: 0,
            conn: None,
            is_full: false,
            looks: false,
            partner: None,
            rng,
        }
    }

    pub(super) fn is_cut(&self, way: Way) -> bool {
        self.cuts[way as usize] > 0
    }

    /// Datagrams that go this way are lost altogether.
    pub(super) fn swallows(&self, way: Way) -> bool {
        self.door != Door::Open || self.is_cut(way)
    }

    pub(super) fn set_open(&mut self, is_open: bool) {
        self.is_open = is_open;
        self.is_up = false;
        self.turn += 1;
        self.conn = None;
        self.is_full = false;
        self.looks = false;
        self.partner = None;
    }

    /// When a datagram that leaves now arrives: never, once or twice.
    pub(super) fn datagram_arrivals(&mut self, now: Instant, way: Way) -> Vec<Instant> {
        let Network { delay, jitter, loss_ppm, duplicate_ppm, .. } = self.network;
        if self.swallows(way) || self.rng.chance(loss_ppm) {
            return Vec::new();
        }
        let copies = 1 + usize::from(self.rng.chance(duplicate_ppm));
        (0..copies).map(|_| now + delay + self.rng.up_to(jitter)).collect()
    }
}

/// What travels on a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Item {
    /// The other end is there.
    Opened,
    Bytes(Vec<u8>),
    /// The other end closed: after what it had sent, or at once, with a reset.
    Closed,
}
