//! The network between the gateway and the controller, with one model per link.

use proto_core::engine::{LinkId, LinkKind};
use proto_core::time::{Duration, Instant};

use super::rng::Rng;

/// The behaviour of the network of one link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Network {
    /// Delay from one end to the other.
    pub delay: Duration,
    /// Up to this much random delay is added to each segment or datagram. Segments keep their order, datagrams do not.
    pub jitter: Duration,
    /// Data sent on a connection is cut into segments of 1 to this many bytes, at random.
    pub longest_segment: Option<usize>,
    /// A segment waits up to this long, at random, for the next one, and arrives together with it.
    pub merge: Duration,
    /// Number of datagrams per million that are lost.
    pub loss_ppm: u32,
    /// Number of datagrams per million that arrive twice.
    pub duplicate_ppm: u32,
    /// The controller's TCP acknowledges this long after data has arrived, unless it sends something before that.
    pub ack_delay: Duration,
    /// The gateway's driver reports acknowledgements this long after they arrive, and before it reports received data.
    pub ack_report: Duration,
    /// How many unacknowledged bytes the gateway's transport buffers. Beyond that, the driver reports a transmission as
    /// sent only when there is room again.
    pub send_buffer: u64,
}

impl Default for Network {
    /// 200 µs of delay, nothing split, nothing lost.
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
    /// The longest delay of a segment or datagram without faults.
    pub fn slowest(&self) -> Duration {
        self.delay + self.jitter + self.merge
    }
}

/// A direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// From the gateway to the controller.
    Up,
    /// From the controller to the gateway.
    Down,
}

impl Way {
    /// Both directions.
    pub(super) const BOTH: [Self; 2] = [Self::Up, Self::Down];

    pub(super) const fn back(self) -> Self {
        match self {
            Self::Up => Self::Down,
            Self::Down => Self::Up,
        }
    }
}

/// What happens to connection requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ConnectPolicy {
    Open,
    Refuse,
    Silent,
}

/// The network state of one link.
#[derive(Debug)]
pub(super) struct Gate {
    pub id: LinkId,
    pub kind: LinkKind,
    pub network: Network,
    pub connect_policy: ConnectPolicy,
    /// Number of faults that currently cut each direction, by [`Way`].
    pub cuts: [u32; 2],
    pub is_open: bool,
    pub is_up: bool,
    /// Incremented each time the link is opened or closed; events of an older generation are dropped.
    pub generation: u64,
    pub conn: Option<u64>,
    /// The transport had no room for the newest transmission, which is not reported as sent yet.
    pub is_full: bool,
    /// The driver will read the acknowledgements: [`super::due::Due::ReadAcks`] is queued.
    pub reads_acks: bool,
    /// The sender that the gateway answers, if it listens for datagrams.
    pub answers_to: Option<Sender>,
    pub rng: Rng,
}

/// Senders of datagrams to a port where the gateway listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sender {
    /// The controller's client; it has a new socket after each restart.
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
            connect_policy: ConnectPolicy::Open,
            cuts: [0; 2],
            is_open: false,
            is_up: false,
            generation: 0,
            conn: None,
            is_full: false,
            reads_acks: false,
            answers_to: None,
            rng,
        }
    }

    pub(super) fn is_cut(&self, way: Way) -> bool {
        self.cuts[way as usize] > 0
    }

    /// All datagrams in this direction are lost.
    pub(super) fn swallows(&self, way: Way) -> bool {
        self.connect_policy != ConnectPolicy::Open || self.is_cut(way)
    }

    pub(super) fn set_open(&mut self, is_open: bool) {
        self.is_open = is_open;
        self.is_up = false;
        self.generation += 1;
        self.conn = None;
        self.is_full = false;
        self.reads_acks = false;
        self.answers_to = None;
    }

    /// When a datagram sent now arrives; empty if it is lost, two instants if it is duplicated.
    pub(super) fn datagram_arrivals(&mut self, now: Instant, way: Way) -> Vec<Instant> {
        let Network { delay, jitter, loss_ppm, duplicate_ppm, .. } = self.network;
        if self.swallows(way) || self.rng.chance(loss_ppm) {
            return Vec::new();
        }
        let copies = 1 + usize::from(self.rng.chance(duplicate_ppm));
        (0..copies).map(|_| now + delay + self.rng.up_to(jitter)).collect()
    }
}

/// An item sent on a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Item {
    /// The other end has opened the connection.
    Opened,
    Bytes(Vec<u8>),
    /// The other end has closed the connection.
    Closed,
}
