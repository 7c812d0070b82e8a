//! The edge node: sessions, births, data, deaths.
//!
//! In: [`Input`]s with the current time. Out: [`NodeOutput`]s. A session is one connection: CONNECT with the death as
//! will, the subscription to commands, births of the node and of each device that is alive, then data by exception.
//! Changes without a session are stored and published later, marked as historical.

mod io;
mod messages;
mod poll;
mod settings;

use heapless::{Deque, Vec};
use proto_core::time::{Duration, Instant};

use crate::catalog::{Catalog, MAX_DEVICES, Owner};
use crate::clock::UtcClock;
use crate::history::{History, Past};
use crate::mqtt::{Inbox, Packet, ProtocolError};
use crate::payload::{self, Asked, HostState};
use crate::topic;
use crate::value::{DataType, Stamp, StoredValue, Value};
pub use io::{Input, NodeCounters, NodeError, NodeOutput, SessionFailure};
pub use messages::MAX_METRIC;
pub use settings::{Credential, MAX_TEXT, Settings};

/// The shortest buffer for [`EdgeNode::poll_output`]. A longer buffer gives fewer and longer packets.
pub const MIN_BUFFER: usize = 768;

/// The longest packet that is received. Longer publications are skipped.
const MAX_PACKET: usize = 512;

/// An edge node with room for `METRICS` metrics, and for `HISTORY` values while it has no session.
#[derive(Debug, Clone)]
pub struct EdgeNode<const METRICS: usize, const HISTORY: usize> {
    settings: Settings,
    slots: Vec<NodeMetric, METRICS>,
    /// Where the metrics of the node and of each device begin; the last entry is the end.
    starts: Vec<u16, { MAX_DEVICES + 2 }>,
    history: History<HISTORY>,
    clock: UtcClock,
    /// When the values were sampled.
    sampled_at: Instant,
    /// The time stamps of the birth that is being sent.
    dates: Dates,
    /// Devices that work. `born` has those that were born in this session.
    alive: u32,
    born: u32,
    device_births: [Option<Instant>; MAX_DEVICES],
    phase: NodePhase,
    inbox: Inbox<MAX_PACKET>,
    acks: Deque<u16, 8>,
    seq: u8,
    bd_seq: Option<u8>,
    ping_at: Instant,
    pong_until: Option<Instant>,
    birth_at: Option<Instant>,
    is_rebirth_wanted: bool,
    host: Maybe<HostState>,
    /// The connection has failed and must be closed.
    must_close: bool,
    is_ending: bool,
    online_since: Option<Instant>,
    attempts: u32,
    random: u64,
    failure: Maybe<SessionFailure>,
    counters: NodeCounters,
}

#[derive(Debug, Clone, Copy)]
struct NodeMetric {
    data_type: DataType,
    is_pending: bool,
    current: StoredValue,
    /// The last published value, and when it was sampled: `Stamp::NEVER` if no value was published.
    published: StoredValue,
    published_at: Stamp,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum NodePhase {
    /// No connection before `until`. The first variant, so that an idle node is all zeros.
    Idle {
        until: Instant,
    },
    Opening {
        until: Instant,
    },
    /// The driver has to store the session number; then CONNECT is sent.
    Keep,
    Connect,
    Connecting {
        until: Instant,
    },
    Subscribe,
    Subscribing {
        until: Instant,
    },
    /// Waits for the primary host.
    Waiting,
    Birth(Birth),
    Online,
    /// The death of the node is sent next, then DISCONNECT.
    Death,
    Disconnect,
    Ended,
}

/// The time stamps of a birth. They are fixed when the birth begins, because its length is fixed too.
#[derive(Debug, Clone, Copy)]
struct Dates {
    now_ms: u64,
    /// When the published values were sampled.
    sampled_ms: u64,
    is_utc: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Birth {
    owner: Owner,
    stage: Stage,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// Nothing is written yet, and the values to publish are not chosen.
    Begin,
    /// The metrics before place `next` take `len` bytes.
    Measure { next: usize, len: usize },
    /// The metric at place `next` is written next; `left` bytes remain.
    Metrics { next: usize, left: usize },
}

impl<const METRICS: usize, const HISTORY: usize> EdgeNode<METRICS, HISTORY> {
    /// A node with all bytes zero, which does nothing until [`Self::configure`] is called.
    pub const fn idle() -> Self {
        Self {
            settings: Settings::empty(),
            slots: Vec::new(),
            starts: Vec::new(),
            history: History::new(),
            clock: UtcClock::unknown(),
            sampled_at: Instant::ZERO,
            dates: Dates { now_ms: 0, sampled_ms: 0, is_utc: false },
            alive: 0,
            born: 0,
            device_births: [None; MAX_DEVICES],
            phase: NodePhase::Idle { until: Instant::ZERO },
            inbox: Inbox::new(),
            acks: Deque::new(),
            seq: 0,
            bd_seq: None,
            ping_at: Instant::ZERO,
            pong_until: None,
            birth_at: None,
            is_rebirth_wanted: false,
            host: Maybe::Nothing,
            must_close: false,
            is_ending: false,
            online_since: None,
            attempts: 0,
            random: 0,
            failure: Maybe::Nothing,
            counters: NodeCounters::NONE,
        }
    }

    /// A node without a session. `bd_seq` is the number that [`NodeOutput::Keep`] gave before a restart. `seed` differs
    /// from node to node, so they do not all reconnect at the same time.
    ///
    /// # Errors
    /// If the catalog is too large, or has names that cannot be part of a topic.
    pub fn new(
        settings: Settings,
        catalog: &impl Catalog,
        bd_seq: Option<u8>,
        seed: u64,
    ) -> Result<Self, NodeError> {
        let mut node = Self::idle();
        node.configure(&settings, catalog, bd_seq, seed)?;
        Ok(node)
    }

    /// Configures an [idle](Self::idle) node in place, with the arguments of [`Self::new`].
    ///
    /// # Errors
    /// Those of [`Self::new`]. The node cannot be used then.
    pub fn configure(
        &mut self,
        settings: &Settings,
        catalog: &impl Catalog,
        bd_seq: Option<u8>,
        seed: u64,
    ) -> Result<(), NodeError> {
        let count = catalog.devices();
        if count > MAX_DEVICES {
            return Err(NodeError::Devices { count });
        }
        let mut end = 0_usize;
        for owner in owners(count) {
            let _ = self.starts.push(u16::try_from(end).unwrap_or(u16::MAX));
            end = end.saturating_add(catalog.metrics(owner));
        }
        if end > METRICS || end >= usize::from(u16::MAX) {
            return Err(NodeError::Metrics { count: end, room: METRICS });
        }
        let _ = self.starts.push(u16::try_from(end).unwrap_or(u16::MAX));
        for nth in 0..count {
            topic::check(catalog.device(nth)).map_err(|error| NodeError::Device { nth, error })?;
            if (0..nth).any(|other| catalog.device(other) == catalog.device(nth)) {
                return Err(NodeError::SameDevice { nth });
            }
        }
        for place in 0..end {
            let data_type = catalog.metric(place).ok_or(NodeError::Metric { place })?.data_type;
            let _ = self.slots.push(NodeMetric {
                data_type,
                is_pending: false,
                current: StoredValue::Unknown,
                published: StoredValue::Unknown,
                published_at: Stamp::NEVER,
            });
        }
        self.settings.clone_from(settings);
        (self.bd_seq, self.random, self.ping_at) = (bd_seq, seed | 1, Instant::NEVER);
        Ok(())
    }

    /// Handles one input. `now` must never go back; the catalog must always be the same.
    pub fn handle(&mut self, now: Instant, input: Input<'_>, catalog: &impl Catalog) {
        match input {
            Input::Opened => {
                if let NodePhase::Opening { .. } = self.phase {
                    self.bd_seq = Some(self.bd_seq.map_or(0, |last| last.wrapping_add(1)));
                    self.inbox.clear();
                    self.acks.clear();
                    (self.host, self.pong_until, self.ping_at) = (Maybe::Nothing, None, Instant::NEVER);
                    self.phase = NodePhase::Keep;
                }
            }
            Input::Closed => {
                if !matches!(self.phase, NodePhase::Idle { .. } | NodePhase::Ended) {
                    self.note(SessionFailure::Closed);
                    self.leave_session(now);
                }
            }
            Input::Bytes(bytes) => self.receive(now, bytes),
            Input::Sample { values, alive } => {
                self.slots.iter_mut().skip(values.len()).for_each(|slot| slot.current = StoredValue::Unknown);
                self.take_values(0, values);
                self.sampled(now, alive, catalog);
            }
            Input::Values { first, values } => self.take_values(first, values),
            Input::Sampled { alive } => self.sampled(now, alive, catalog),
            Input::Time { utc_ms } => {
                let is_new = self.clock.set(now, utc_ms);
                // Values that were published without UTC have no valid time stamp.
                self.is_rebirth_wanted |= is_new && self.publishes();
            }
            Input::End => self.is_ending = true,
        }
    }

    /// Counters since the node was made.
    pub fn counters(&self) -> NodeCounters {
        NodeCounters { lost: self.history.lost(), kept: self.history.len(), ..self.counters }
    }

    /// Why the last session or attempt failed; `None` while a session is established.
    pub const fn failure(&self) -> Option<SessionFailure> {
        self.failure.get()
    }

    /// Whether the births were sent and data is published.
    pub const fn is_online(&self) -> bool {
        matches!(self.phase, NodePhase::Online)
    }

    /// Whether there is a connection, according to the driver.
    pub const fn is_connected(&self) -> bool {
        !matches!(self.phase, NodePhase::Idle { .. } | NodePhase::Opening { .. } | NodePhase::Ended)
    }

    /// Whether the node has ended, as [`Input::End`] requested.
    pub const fn has_ended(&self) -> bool {
        matches!(self.phase, NodePhase::Ended)
    }

    /// The `bdSeq` number of the newest session; `None` before the first.
    pub const fn bd_seq(&self) -> Option<u8> {
        self.bd_seq
    }

    /// Whether changes are published; otherwise they are stored.
    const fn publishes(&self) -> bool {
        matches!(self.phase, NodePhase::Birth(_) | NodePhase::Online)
    }

    fn take_values(&mut self, first: usize, values: &[Option<Value>]) {
        for (slot, value) in self.slots.iter_mut().skip(first).zip(values) {
            let value = value.and_then(Value::known).filter(|value| value.data_type() == slot.data_type);
            slot.current = StoredValue::of(value);
        }
    }

    fn sampled(&mut self, now: Instant, alive: u32, catalog: &impl Catalog) {
        let publishes = self.publishes();
        (self.sampled_at, self.alive) = (now, alive);
        for (index, owner) in (0..).zip(owners(MAX_DEVICES)) {
            let (Some(&start), Some(&end)) =
                (self.starts.get(index), self.starts.get(index.saturating_add(1)))
            else {
                break;
            };
            let is_alive = match owner {
                Owner::Node => true,
                Owner::Device(nth) => has(alive, nth),
            };
            for place in start..end {
                let Some(slot) = self.slots.get_mut(usize::from(place)) else { break };
                let report = catalog.report(place.into());
                let at = slot.published_at();
                let is_due = at.is_none_or(|at| now.saturating_since(at) >= report.min_interval);
                slot.is_pending = is_alive && is_due && slot.is_changed(report.dead_band);
                if slot.is_pending && !publishes {
                    // The first value is not a change.
                    let is_change = at.is_some();
                    slot.tell(now);
                    if is_change {
                        self.history.push(Past { place, value: slot.published, at: slot.published_at });
                    }
                }
            }
        }
    }

    fn receive(&mut self, now: Instant, bytes: &[u8]) {
        let mut rest = bytes;
        while !rest.is_empty() && !self.must_close && self.is_connected() {
            let taken = self.inbox.push(rest);
            rest = rest.get(taken..).unwrap_or_default();
            loop {
                let skipped = self.inbox.skipped();
                let packet = match self.inbox.next_packet() {
                    Ok(Some(packet)) => packet,
                    Ok(None) => {
                        let skipped = self.inbox.skipped().saturating_sub(skipped);
                        self.counters.unreadable = self.counters.unreadable.saturating_add(skipped);
                        break;
                    }
                    Err(error) => return self.fail(SessionFailure::Protocol(error)),
                };
                let event = match packet {
                    Packet::ConnAck { code } => PacketContent::Accepted(code),
                    Packet::SubAck { is_accepted } => PacketContent::Subscribed(is_accepted),
                    Packet::PingResp => PacketContent::Pong,
                    Packet::Publish { topic, payload, id } => {
                        if let Some(id) = id {
                            // If it does not fit, the server could only repeat the message after this session has
                            // ended.
                            let _ = self.acks.push_back(id);
                        }
                        let Settings { group, node, primary_host, .. } = &self.settings;
                        if topic::is_command(topic, group, node) {
                            payload::command(payload)
                                .map_or(PacketContent::Unreadable, PacketContent::Command)
                        } else if primary_host.as_ref().is_some_and(|host| topic::is_state(topic, host)) {
                            payload::host_state(payload)
                                .map_or(PacketContent::Unreadable, PacketContent::Host)
                        } else {
                            PacketContent::Unreadable
                        }
                    }
                };
                self.take(now, event);
            }
            if taken == 0 {
                // Cannot happen: the buffer always has room for a complete packet.
                return self.fail(SessionFailure::Broken);
            }
        }
    }

    fn take(&mut self, now: Instant, event: PacketContent) {
        let counters = &mut self.counters;
        match (event, self.phase) {
            (PacketContent::Accepted(0), NodePhase::Connecting { .. }) => {
                counters.sessions = counters.sessions.saturating_add(1);
                self.ping_at = now + self.settings.ping_interval();
                self.phase = NodePhase::Subscribe;
            }
            (PacketContent::Accepted(code @ 1..), NodePhase::Connecting { .. }) => {
                self.fail(SessionFailure::Refused { code })
            }
            (PacketContent::Subscribed(true), NodePhase::Subscribing { .. }) => {
                self.phase = NodePhase::Waiting;
                self.look_for_host();
            }
            (PacketContent::Subscribed(false), NodePhase::Subscribing { .. }) => {
                self.fail(SessionFailure::SubscriptionRefused)
            }
            (PacketContent::Pong, _) => self.pong_until = None,
            (PacketContent::Command(asked), _) => {
                counters.refused = counters.refused.saturating_add(asked.others);
                self.is_rebirth_wanted |= asked.is_rebirth && self.publishes();
            }
            (PacketContent::Host(state), _) => {
                // An older state may arrive late.
                if self.host.get().is_none_or(|known| state.timestamp >= known.timestamp) {
                    self.host = Maybe::Just(state);
                    self.look_for_host();
                }
            }
            (PacketContent::Unreadable, _) => counters.unreadable = counters.unreadable.saturating_add(1),
            // A reply without a request.
            (PacketContent::Accepted(_), _) => {
                self.fail(SessionFailure::Protocol(ProtocolError::Unexpected { first: 0x20 }))
            }
            (PacketContent::Subscribed(_), _) => {
                self.fail(SessionFailure::Protocol(ProtocolError::Unexpected { first: 0x90 }));
            }
        }
    }

    /// Begins the births when the primary host is online, or if there is none.
    fn look_for_host(&mut self) {
        let is_there = match (&self.settings.primary_host, self.host.get()) {
            (None, _) => true,
            (Some(_), host) => host.is_some_and(|host| host.is_online),
        };
        match self.phase {
            NodePhase::Waiting if is_there => {
                self.phase = NodePhase::Birth(Birth { owner: Owner::Node, stage: Stage::Begin });
            }
            // A packet that was begun is completed first.
            _ => {}
        }
    }

    /// Whether the primary host reports that it is offline.
    fn is_host_gone(&self) -> bool {
        self.host.get().is_some_and(|host| !host.is_online)
    }

    fn note(&mut self, failure: SessionFailure) {
        self.failure = Maybe::Just(failure);
        self.counters.failures = self.counters.failures.saturating_add(1);
    }

    fn fail(&mut self, failure: SessionFailure) {
        self.note(failure);
        self.must_close = true;
    }

    /// Leaves the session and starts the pause before the next attempt.
    fn leave_session(&mut self, now: Instant) {
        let was_steady = self.online_since.take().is_some_and(|since| now.saturating_since(since) >= STEADY);
        self.attempts = if was_steady { 1 } else { self.attempts.saturating_add(1) };
        self.phase = match self.is_ending {
            true => NodePhase::Ended,
            false => NodePhase::Idle { until: now + self.pause() },
        };
        (self.born, self.is_rebirth_wanted, self.must_close) = (0, false, false);
        for slot in &mut self.slots {
            slot.is_pending = false;
        }
    }

    /// The pause before the next attempt: longer each time, and random, so that not all nodes reconnect at once.
    fn pause(&mut self) -> Duration {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        let doublings = self.attempts.saturating_sub(1).min(5);
        let most = FIRST_PAUSE.as_micros().checked_shl(doublings).unwrap_or(0);
        let random = self.random.checked_rem(most.max(1)).unwrap_or(0);
        Duration::from_micros((most >> 2).saturating_add(random.saturating_sub(random >> 2)))
    }
}

impl NodeMetric {
    fn current(&self) -> Option<Value> {
        self.current.get(self.data_type)
    }

    fn published(&self) -> Option<Value> {
        self.published.get(self.data_type)
    }

    fn published_at(&self) -> Option<Instant> {
        Some(self.published_at.get()).filter(|at| *at != Instant::NEVER)
    }

    fn is_changed(&self, dead_band: f64) -> bool {
        match (self.current(), self.published()) {
            (Some(current), Some(told)) => current.differs(told, dead_band),
            (current, told) => current.is_some() != told.is_some(),
        }
    }

    /// The current value was published; it was sampled at `at`.
    fn tell(&mut self, at: Instant) {
        (self.published, self.published_at, self.is_pending) = (self.current, Stamp::of(at), false);
    }
}

/// An option whose empty state is all zeros for any `T`, so an idle node takes no flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum Maybe<T> {
    Nothing,
    Just(T),
}

impl<T: Copy> Maybe<T> {
    const fn get(self) -> Option<T> {
        match self {
            Self::Nothing => None,
            Self::Just(value) => Some(value),
        }
    }
}

enum PacketContent {
    Accepted(u8),
    Subscribed(bool),
    Pong,
    Command(Asked),
    Host(HostState),
    Unreadable,
}

/// The node, then its devices.
fn owners(devices: usize) -> impl Iterator<Item = Owner> {
    let devices = u8::try_from(devices).unwrap_or(u8::MAX);
    core::iter::once(Owner::Node).chain((0..devices).map(Owner::Device))
}

/// Whether a device is in the bit set.
fn has(set: u32, nth: u8) -> bool {
    set.checked_shr(nth.into()).unwrap_or(0) & 1 != 0
}

/// After a session of at least this length, the pause is short again.
const STEADY: Duration = Duration::from_secs(60);
/// The longest pause before the first attempt.
const FIRST_PAUSE: Duration = Duration::from_secs(2);
