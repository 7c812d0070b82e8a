//! What a driver records for the doctor: the newest bytes and ids of a port, and facts about a link.
//!
//! Everything is bounded. Recording a chunk costs a copy of its bytes.

use std::collections::VecDeque;

use proto_core::engine::{LinkId, PortCounters, PortId};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};

/// Number of newest bytes of a port that are kept.
pub const KEPT: usize = 1024;
/// Maximum number of CAN ids that are counted; further ids are ignored.
const MAX_IDS: usize = 64;
/// Counters of earlier instants that are kept: those of one window, noted twice a second.
const NOTES: usize = 16;
/// Capacity for the name of a device.
const DEVICE: usize = 128;
/// Findings cover this much time before now.
pub const WINDOW: Duration = Duration::from_secs(5);

/// Input of a field port.
#[derive(Debug)]
pub struct PortRecord {
    /// The port.
    pub port: PortId,
    bytes: VecDeque<u8>,
    /// Frames of each id in this window and in the previous one.
    ids: Vec<SeenId>,
    turned_at: Instant,
    /// Counters at earlier instants, the oldest first.
    before: VecDeque<(Instant, PortCounters)>,
    /// Number of commands that values have picked, and when the newest was picked, if that was observed.
    commands: Option<(u32, Option<Instant>)>,
    /// CAN FD frames, which no recipe uses.
    pub fd_frames: u64,
    /// The device of the port's `--bind`, such as `serial:/dev/ttyUSB0`; may be empty.
    pub device: String,
}

impl Clone for PortRecord {
    fn clone(&self) -> Self {
        let mut copy = Self::new(self.port);
        copy.clone_from(self);
        copy
    }

    /// Reuses allocations: the thread that moves the data makes a copy every second.
    fn clone_from(&mut self, from: &Self) {
        let Self { port, bytes, ids, turned_at, before, commands, fd_frames, device } = from;
        (self.port, self.turned_at, self.fd_frames) = (*port, *turned_at, *fd_frames);
        self.commands = *commands;
        self.bytes.clone_from(bytes);
        self.ids.clone_from(ids);
        self.before.clone_from(before);
        self.device.clone_from(device);
    }
}

/// Frames of an id.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SeenId {
    pub(crate) id: CanId,
    /// Length of the newest frame.
    pub(crate) len: usize,
    now: u32,
    before: u32,
}

impl SeenId {
    pub(crate) fn count(&self) -> u32 {
        self.now.saturating_add(self.before)
    }
}

impl PortRecord {
    /// An empty record of a port.
    pub fn new(port: PortId) -> Self {
        Self {
            port,
            bytes: VecDeque::with_capacity(KEPT),
            ids: Vec::with_capacity(MAX_IDS),
            turned_at: Instant::ZERO,
            before: VecDeque::with_capacity(NOTES),
            commands: None,
            fd_frames: 0,
            device: String::with_capacity(DEVICE),
        }
    }

    /// Records received bytes. The newest [`KEPT`] are kept.
    pub fn heard(&mut self, bytes: &[u8]) {
        let bytes = &bytes[bytes.len().saturating_sub(KEPT)..];
        let excess = (self.bytes.len() + bytes.len()).saturating_sub(KEPT);
        self.bytes.drain(..excess);
        self.bytes.extend(bytes);
    }

    /// Records a received CAN frame.
    pub fn frame(&mut self, frame: &CanFrame) {
        let (id, len) = (frame.id(), frame.data().len());
        if let Some(seen) = self.ids.iter_mut().find(|seen| seen.id == id) {
            (seen.now, seen.len) = (seen.now.saturating_add(1), len);
        } else if self.ids.len() < MAX_IDS {
            self.ids.push(SeenId { id, len, now: 1, before: 0 });
        }
    }

    /// Records the counters of this instant; to be called about once a second.
    pub fn note(&mut self, now: Instant, counters: &PortCounters) {
        self.commands = match self.commands {
            None => Some((counters.commands, None)),
            Some((count, _)) if count != counters.commands => Some((counters.commands, Some(now))),
            same => same,
        };
        // If it is called more often, the window is shorter.
        if self.before.len() == NOTES {
            self.before.pop_front();
        }
        self.before.push_back((now, *counters));
        while self.before.len() >= 2 && now.saturating_since(self.before[1].0) >= WINDOW {
            self.before.pop_front();
        }
        if now.saturating_since(self.turned_at) >= WINDOW {
            self.turned_at = now;
            self.ids.retain_mut(|seen| {
                seen.before = std::mem::take(&mut seen.now);
                seen.before > 0
            });
        }
    }

    /// The counters at the beginning of the window; zeros if the run has started since.
    pub(crate) fn counters_before(&self, now: Instant) -> PortCounters {
        let is_old = |at: Instant| now.saturating_since(at) >= WINDOW;
        match self.before.front() {
            Some((at, counters)) if is_old(*at) => *counters,
            _ => PortCounters::default(),
        }
    }

    /// When the newest command was picked, to a second; `None` if that was not observed.
    pub(crate) fn newest_command(&self) -> Option<Instant> {
        self.commands?.1
    }

    /// The newest bytes, the oldest first.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        self.bytes.iter().copied().collect()
    }

    pub(crate) fn ids(&self) -> &[SeenId] {
        &self.ids
    }
}

/// What a driver knows of a link beyond the engine's status.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkFacts {
    /// The link.
    pub link: LinkId,
    /// How the newest attempt to reach it ended, if there was one.
    pub reach: Option<Reach>,
    /// Connections and datagrams from other addresses than the controller's.
    pub strangers: u64,
}

/// How an attempt to reach the controller ended.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reach {
    /// A connection was made, or a datagram came.
    Reached,
    /// The connection was refused.
    Refused,
    /// There was no answer.
    NoAnswer,
    /// The name cannot be resolved.
    NoSuchHost,
    /// The peer cannot be probed without sending something.
    Untried,
    /// Another error, in the system's words.
    Failed(String),
}
