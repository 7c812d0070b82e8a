//! One direction of a TCP connection. Data arrives once and in order, or not at all; data lost in the network is
//! retransmitted after growing pauses.
//!
//! In: the sent data, and whether the path is cut. Out: when something arrives or is retransmitted. Does not know
//! windows or congestion: after a loss everything waits for the next retransmission, as in a real stack while nothing
//! is acknowledged.

use std::collections::VecDeque;

use proto_core::time::{Duration, Instant};

use super::network::{Gate, Item, Way};

/// One direction of a connection.
#[derive(Debug)]
pub(super) struct Pipe {
    segments: VecDeque<Segment>,
    /// When the newest segment arrives; later segments do not overtake it.
    newest: Instant,
    /// Nothing arrives until [`super::Cell::release`].
    pub held: bool,
    /// Nothing arrives any more.
    pub dead: bool,
    /// The connection is reset after this many more bytes have arrived.
    pub reset_after: Option<usize>,
    /// Number of bytes that were sent.
    pub sent: u64,
    /// Number of sent bytes that have arrived.
    pub arrived: u64,
    /// Number of sent bytes that the sender knows to be acknowledged.
    pub acked: u64,
    /// When the oldest unacknowledged byte was sent, or the newest acknowledgement came.
    pub unacked_since: Instant,
    /// Retransmission timeout.
    rto: Duration,
    /// When the sender retransmits; `None` if nothing was lost.
    pub retransmit_at: Option<Instant>,
}

#[derive(Debug)]
struct Segment {
    sent_at: Instant,
    /// When the segment arrives; [`Instant::NEVER`] if it was lost.
    arrives: Instant,
    /// Number of bytes of the other direction that the segment acknowledges.
    acks: u64,
    item: Item,
}

/// What has arrived.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Arrived {
    Nothing,
    Item(Item),
    /// The bytes were the last before a reset.
    Reset(Vec<u8>),
}

/// The result of a retransmission.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Retransmission {
    /// There was nothing to retransmit.
    Nothing,
    /// The lost data arrives at this instant.
    Arrives(Instant),
    /// No data was lost: the acknowledgement arrives at this instant.
    Acked(Instant),
    /// The path is still cut: the next retransmission is at this instant.
    Later(Instant),
    /// The sender gives up the connection.
    GivenUp,
}

impl Pipe {
    pub(super) fn new() -> Self {
        Self {
            segments: VecDeque::new(),
            newest: Instant::ZERO,
            held: false,
            dead: false,
            reset_after: None,
            sent: 0,
            arrived: 0,
            acked: 0,
            unacked_since: Instant::ZERO,
            rto: INITIAL_RTO,
            retransmit_at: None,
        }
    }

    /// Sends an item. `arrives` gets the arrival time of each of its segments; it gets none while an earlier segment is
    /// lost.
    pub(super) fn send(
        &mut self,
        now: Instant,
        item: Item,
        acks: u64,
        gate: &mut Gate,
        way: Way,
        mut arrives: impl FnMut(Instant),
    ) {
        if let Item::Bytes(bytes) = &item {
            if self.unacked() == 0 {
                self.unacked_since = now;
            }
            self.sent += bytes.len() as u64;
        }
        if self.dead {
            return;
        }
        if gate.is_cut(way) || self.retransmit_at.is_some() {
            self.segments.push_back(Segment { sent_at: now, arrives: Instant::NEVER, acks, item });
            self.retransmit_at.get_or_insert(now + self.rto);
            return;
        }
        let network = gate.network;
        let mut arrive = |gate: &mut Gate, item| {
            let late = gate.rng.up_to(network.jitter) + gate.rng.up_to(network.merge);
            let mut at = (now + network.delay + late).max(self.newest);
            if network.longest_segment.is_some() && at == self.newest {
                // Segments that arrive at the same instant would be received as one.
                at += Duration::from_micros(1);
            }
            self.newest = at;
            self.segments.push_back(Segment { sent_at: now, arrives: at, acks, item });
            arrives(at);
        };
        match (item, network.longest_segment) {
            (Item::Bytes(bytes), Some(longest)) => {
                let mut rest = bytes.as_slice();
                while !rest.is_empty() {
                    let len = (gate.rng.between(1, longest.max(1) as u64) as usize).min(rest.len());
                    let (segment, after) = rest.split_at(len);
                    arrive(gate, Item::Bytes(segment.to_vec()));
                    rest = after;
                }
            }
            (item, _) => arrive(gate, item),
        }
    }

    /// Takes the next item that has arrived; bytes that arrived together are one item. Also returns how many bytes of
    /// the other direction are acknowledged.
    pub(super) fn next_arrived(&mut self, now: Instant) -> (Arrived, u64) {
        let mut acks = 0;
        if self.held || self.dead {
            return (Arrived::Nothing, acks);
        }
        let mut joined = Vec::new();
        while let Some(segment) = self.segments.front_mut()
            && segment.arrives <= now
        {
            match &mut segment.item {
                Item::Bytes(bytes) if joined.is_empty() => joined = std::mem::take(bytes),
                Item::Bytes(_) if joined.len() >= MAX_READ => break,
                Item::Bytes(bytes) => joined.append(bytes),
                _ if !joined.is_empty() => break,
                _ => {}
            }
            let Some(segment) = self.segments.pop_front() else { break };
            acks = acks.max(segment.acks);
            self.rto = MIN_RTO;
            if !matches!(segment.item, Item::Bytes(_)) {
                return (Arrived::Item(segment.item), acks);
            }
        }
        if joined.is_empty() {
            return (Arrived::Nothing, acks);
        }
        self.arrived += joined.len() as u64;
        if let Some(left) = &mut self.reset_after {
            if joined.len() >= *left {
                joined.truncate(*left);
                self.dead = true;
                return (Arrived::Reset(joined), acks);
            }
            *left -= joined.len();
        }
        (Arrived::Item(Item::Bytes(joined)), acks)
    }

    /// Loses the data that would arrive now. Returns when it is retransmitted, if that was not known yet.
    pub(super) fn lose(&mut self, now: Instant) -> Option<Instant> {
        let mut first = None;
        for segment in self.segments.iter_mut().filter(|segment| segment.arrives <= now) {
            segment.arrives = Instant::NEVER;
            first.get_or_insert(segment.sent_at);
        }
        self.schedule_retransmission(now, first?)
    }

    /// Data sent at `sent_at` was not acknowledged. Returns when it is retransmitted, if that was not known yet.
    pub(super) fn schedule_retransmission(&mut self, now: Instant, sent_at: Instant) -> Option<Instant> {
        if self.retransmit_at.is_some() {
            return None;
        }
        let at = (sent_at + self.rto).max(now + Duration::from_micros(1));
        self.retransmit_at = Some(at);
        Some(at)
    }

    /// Retransmits lost data.
    pub(super) fn retransmit(&mut self, now: Instant, gate: &mut Gate, way: Way) -> Retransmission {
        if self.dead || self.retransmit_at != Some(now) {
            return Retransmission::Nothing;
        }
        self.retransmit_at = None;
        let is_lost = |segment: &&mut Segment| segment.arrives == Instant::NEVER;
        let any_lost = self.segments.iter_mut().any(|segment| is_lost(&segment));
        if !any_lost && self.unacked() == 0 {
            return Retransmission::Nothing;
        }
        // If only acknowledgements were lost, data that has arrived is retransmitted to get them again.
        if gate.is_cut(way) || !any_lost && gate.is_cut(way.back()) {
            self.rto = self.rto.saturating_mul(2);
            if self.rto > MAX_RTO {
                return Retransmission::GivenUp;
            }
            let next = now + self.rto;
            self.retransmit_at = Some(next);
            return Retransmission::Later(next);
        }
        let at = (now + gate.network.delay + gate.rng.up_to(gate.network.jitter)).max(self.newest);
        self.newest = at;
        for segment in self.segments.iter_mut().filter(is_lost) {
            segment.arrives = at;
            segment.sent_at = now;
        }
        if any_lost { Retransmission::Arrives(at) } else { Retransmission::Acked(at + gate.network.delay) }
    }

    /// The sender has reset the connection: data that has not arrived is lost.
    pub(super) fn forget(&mut self) {
        self.segments.clear();
        self.retransmit_at = None;
        self.newest = Instant::ZERO;
    }

    /// The sender receives an acknowledgement. Returns whether it covers more than the previous one.
    pub(super) fn acknowledge(&mut self, now: Instant, upto: u64) -> bool {
        let is_news = upto > self.acked;
        if is_news {
            self.acked = upto;
            self.unacked_since = now;
        }
        is_news
    }

    /// Number of unacknowledged bytes.
    pub(super) fn unacked(&self) -> u64 {
        self.sent - self.acked
    }

    /// Number of bytes that have not arrived.
    pub(super) fn on_the_way(&self) -> u64 {
        self.sent - self.arrived
    }
}

/// The retransmission timeout of a new connection.
const INITIAL_RTO: Duration = Duration::from_secs(1);
/// The retransmission timeout after data has arrived. Each retransmission doubles it.
const MIN_RTO: Duration = Duration::from_millis(200);
/// A connection that would need a longer retransmission timeout is given up.
const MAX_RTO: Duration = Duration::from_secs(16);
/// Maximum number of bytes per read of a program, rounded up to a segment.
const MAX_READ: usize = 16 * 1024;
/// Time without acknowledgements after which TCP gives up a connection.
pub const TCP_TIMEOUT: Duration = Duration::from_secs(30);
/// The gateway's transport gives up a connection on which nothing was acknowledged for this long.
pub(super) const USER_TIMEOUT: Duration = Duration::from_secs(2);
