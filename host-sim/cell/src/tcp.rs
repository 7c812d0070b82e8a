//! One direction of a TCP connection: data arrives once and in order, or not at all; data lost in
//! the network is sent again after growing waits.
//!
//! In: what the sender hands over, and whether the path is cut. Out: when something arrives or is
//! to be sent again. Does not model windows or congestion: after a loss everything waits for the
//! next retransmission, as in the network stacks of both ends while nothing is acknowledged.

use std::collections::VecDeque;

use proto_core::time::{Duration, Instant};

use super::network::{Gate, Item, Way};

/// One direction of a connection.
#[derive(Debug)]
pub(super) struct Pipe {
    segments: VecDeque<Segment>,
    /// When the newest segment arrives.
    newest: Instant,
    /// Nothing arrives until it is released.
    pub held: bool,
    /// Nothing arrives any more.
    pub dead: bool,
    /// The connection is reset when so many more bytes have arrived.
    pub reset_after: Option<usize>,
    /// Bytes that were handed over, ...
    pub sent: u64,
    /// ... of these arrived at the other end, ...
    pub arrived: u64,
    /// ... of these acknowledged, as the sender knows.
    pub acked: u64,
    /// Since when something is not.
    pub unacked_since: Instant,
    /// How long the sender waits for an acknowledgement before it sends again.
    patience: Duration,
    /// When it does so, if something was lost.
    pub again_at: Option<Instant>,
}

#[derive(Debug)]
struct Segment {
    sent_at: Instant,
    /// [`Instant::NEVER`] when it was lost.
    arrives: Instant,
    /// How much of the other direction it acknowledges.
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

/// What comes of sending again.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Again {
    /// There is no need for it.
    Nothing,
    /// What was lost arrives then.
    Arrives(Instant),
    /// All had arrived: its acknowledgement comes then.
    Acked(Instant),
    /// The path is cut still.
    Later(Instant),
    /// The sender takes the connection for lost.
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
            patience: FIRST_PATIENCE,
            again_at: None,
        }
    }

    /// Hands an item over; when something of it arrives. Nothing does while something before it is
    /// lost.
    pub(super) fn send(
        &mut self,
        now: Instant,
        item: Item,
        acks: u64,
        gate: &mut Gate,
        way: Way,
    ) -> Vec<Instant> {
        if let Item::Bytes(bytes) = &item {
            if self.unacked() == 0 {
                self.unacked_since = now;
            }
            self.sent += bytes.len() as u64;
        }
        if self.dead {
            return Vec::new();
        }
        if gate.is_cut(way) || self.again_at.is_some() {
            self.segments.push_back(Segment { sent_at: now, arrives: Instant::NEVER, acks, item });
            self.again_at.get_or_insert(now + self.patience);
            return Vec::new();
        }
        let network = gate.network;
        let mut arrivals = Vec::new();
        let mut arrive = |gate: &mut Gate, item| {
            let late = gate.rng.up_to(network.jitter) + gate.rng.up_to(network.merge);
            let mut at = (now + network.delay + late).max(self.newest);
            if network.longest_segment.is_some() && at == self.newest {
                // A segment of its own arrives at a time of its own.
                at += Duration::from_micros(1);
            }
            self.newest = at;
            self.segments.push_back(Segment { sent_at: now, arrives: at, acks, item });
            arrivals.push(at);
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
        arrivals
    }

    /// The next thing that has arrived; bytes that came together are one piece. With it, how much of
    /// the other direction is acknowledged.
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
                Item::Bytes(_) if joined.len() >= MOST_AT_ONCE => break,
                Item::Bytes(bytes) => joined.append(bytes),
                _ if !joined.is_empty() => break,
                _ => {}
            }
            let Some(segment) = self.segments.pop_front() else { break };
            acks = acks.max(segment.acks);
            self.patience = PATIENCE;
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

    /// What should arrive now is lost: when it is to be sent again, if that is news.
    pub(super) fn lose(&mut self, now: Instant) -> Option<Instant> {
        let mut first = None;
        for segment in self.segments.iter_mut().filter(|segment| segment.arrives <= now) {
            segment.arrives = Instant::NEVER;
            first.get_or_insert(segment.sent_at);
        }
        self.sends_again(now, first?)
    }

    /// Something that was sent then is not acknowledged: when the sender sends again, if that is news.
    pub(super) fn sends_again(&mut self, now: Instant, sent_at: Instant) -> Option<Instant> {
        if self.again_at.is_some() {
            return None;
        }
        let at = (sent_at + self.patience).max(now + Duration::from_micros(1));
        self.again_at = Some(at);
        Some(at)
    }

    /// It is time to send again; what comes of it.
    pub(super) fn send_again(&mut self, now: Instant, gate: &mut Gate, way: Way) -> Again {
        if self.dead || self.again_at != Some(now) {
            return Again::Nothing;
        }
        self.again_at = None;
        let is_lost = |segment: &&mut Segment| segment.arrives == Instant::NEVER;
        let any_lost = self.segments.iter_mut().any(|segment| is_lost(&segment));
        if !any_lost && self.unacked() == 0 {
            return Again::Nothing;
        }
        // What has arrived is sent again as well, for the sake of its acknowledgement.
        if gate.is_cut(way) || !any_lost && gate.is_cut(way.back()) {
            self.patience = self.patience.saturating_mul(2);
            if self.patience > LAST_PATIENCE {
                return Again::GivenUp;
            }
            let next = now + self.patience;
            self.again_at = Some(next);
            return Again::Later(next);
        }
        let at = (now + gate.network.delay + gate.rng.up_to(gate.network.jitter)).max(self.newest);
        self.newest = at;
        for segment in self.segments.iter_mut().filter(is_lost) {
            segment.arrives = at;
            segment.sent_at = now;
        }
        if any_lost { Again::Arrives(at) } else { Again::Acked(at + gate.network.delay) }
    }

    /// The sender has reset the connection: nothing that has not arrived ever does.
    pub(super) fn forget(&mut self) {
        self.segments.clear();
        self.again_at = None;
        self.newest = Instant::ZERO;
    }

    /// The sender knows now that so much has arrived; whether that is news.
    pub(super) fn acknowledge(&mut self, now: Instant, upto: u64) -> bool {
        let is_news = upto > self.acked;
        if is_news {
            self.acked = upto;
            self.unacked_since = now;
        }
        is_news
    }

    /// Bytes that the sender does not know to have arrived.
    pub(super) fn unacked(&self) -> u64 {
        self.sent - self.acked
    }

    /// Bytes that have not arrived.
    pub(super) fn on_the_way(&self) -> u64 {
        self.sent - self.arrived
    }
}

/// How long a new connection waits before it sends again.
const FIRST_PATIENCE: Duration = Duration::from_secs(1);
/// The shortest wait on one that exists; it is doubled each time.
const PATIENCE: Duration = Duration::from_millis(200);
/// When it would be longer, the connection is given up.
const LAST_PATIENCE: Duration = Duration::from_secs(16);
/// A program reads so much at once, rounded up to a segment.
const MOST_AT_ONCE: usize = 16 * 1024;
/// When TCP gives up a connection on which nothing is acknowledged.
pub const TCP_TIMEOUT: Duration = Duration::from_secs(30);
/// The gateway's transport ends a connection on which nothing was acknowledged for so long.
pub(super) const USER_TIMEOUT: Duration = Duration::from_secs(2);
