//! The medium of a CAN bus (proto-core/docs/wire/slcan.md section 4).
//!
//! In: frames of its nodes, and the time. Out: transmitted frames, one after the other in the order of
//! arbitration. No clock, no I/O, and no bit errors: every node receives every frame.

use std::collections::{BTreeMap, VecDeque};

use embedded_can::Frame;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};

/// How long frames take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pacing {
    /// No time: a frame is transmitted as soon as it is queued.
    AtOnce,
    /// As long as their bits take at this rate, in bit/s.
    Bitrate(u32),
}

/// A node of the bus. A node that joined later is greater.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct NodeId(u64);

/// A frame that was transmitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Transmitted {
    pub(crate) from: NodeId,
    pub(crate) frame: CanFrame,
    /// The end of the transmission.
    pub(crate) at: Instant,
}

/// The node already has [`MAX_QUEUED`] waiting frames; the frame was not queued.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Full;

/// The medium, and the frames that wait for it.
#[derive(Debug)]
pub(crate) struct Wire {
    pacing: Pacing,
    nodes: BTreeMap<NodeId, VecDeque<QueuedFrame>>,
    joined: u64,
    in_progress: Option<InProgress>,
    /// The end of the last frame.
    free_since: Instant,
}

#[derive(Debug, Clone, Copy)]
struct QueuedFrame {
    since: Instant,
    frame: CanFrame,
}

#[derive(Debug, Clone, Copy)]
struct InProgress {
    from: NodeId,
    what: QueuedFrame,
    start: Instant,
    end: Instant,
}

impl Wire {
    /// An idle bus without nodes.
    pub(crate) fn new(pacing: Pacing) -> Self {
        Self {
            pacing,
            nodes: BTreeMap::new(),
            joined: 0,
            in_progress: None,
            free_since: Instant::from_micros(0),
        }
    }

    pub(crate) fn join(&mut self) -> NodeId {
        let id = NodeId(self.joined);
        self.joined += 1;
        self.nodes.insert(id, VecDeque::new());
        id
    }

    /// Removes a node and drops its waiting frames. Its frame in progress is still transmitted.
    pub(crate) fn leave(&mut self, node: NodeId) {
        self.nodes.remove(&node);
    }

    /// Number of the node's frames that have not been transmitted, including the one in progress.
    pub(crate) fn waiting(&self, node: NodeId) -> usize {
        let queued = self.nodes.get(&node).map_or(0, VecDeque::len);
        queued + usize::from(self.in_progress.is_some_and(|frame| frame.from == node))
    }

    /// Whether the node's next frame would be refused.
    pub(crate) fn is_full(&self, node: NodeId) -> bool {
        self.nodes.get(&node).is_none_or(|queue| queue.len() >= MAX_QUEUED)
    }

    /// Queues a frame. Call [`Wire::poll`] after it.
    pub(crate) fn send(&mut self, now: Instant, node: NodeId, frame: CanFrame) -> Result<(), Full> {
        let queue = self.nodes.get_mut(&node).filter(|queue| queue.len() < MAX_QUEUED).ok_or(Full)?;
        queue.push_back(QueuedFrame { since: now, frame });
        match self.in_progress {
            None => self.arbitrate(),
            // Still within the first bit of that frame: the new frame takes part in the arbitration.
            Some(first) if now <= first.start + self.bit_time() => {
                if let Some(queue) = self.nodes.get_mut(&first.from) {
                    queue.push_front(first.what);
                    self.in_progress = None;
                    self.arbitrate();
                }
            }
            Some(_) => {}
        }
        Ok(())
    }

    /// The end of the frame in progress, or [`Instant::NEVER`].
    pub(crate) fn deadline(&self) -> Instant {
        self.in_progress.map_or(Instant::NEVER, |frame| frame.end)
    }

    /// The next frame that has ended by now. A late call changes nothing: the following frame began at the end of this
    /// frame, after an arbitration among the nodes that had a frame queued by then.
    pub(crate) fn poll(&mut self, now: Instant) -> Option<Transmitted> {
        let InProgress { from, what, end, .. } = self.in_progress.take_if(|frame| frame.end <= now)?;
        self.free_since = end;
        self.arbitrate();
        Some(Transmitted { from, frame: what.frame, at: end })
    }

    /// Starts the frame with the lowest arbitration field among those queued when the bus became idle, or the first
    /// frame queued after that.
    fn arbitrate(&mut self) {
        let heads = || self.nodes.iter().filter_map(|(&node, queue)| queue.front().map(|&what| (node, what)));
        let Some(first) = heads().map(|(_, what)| what.since).min() else { return };
        let start = first.max(self.free_since);
        let sync = start + self.bit_time();
        let winner = heads()
            .filter(|(_, what)| what.since <= sync)
            .min_by_key(|(node, what)| (arbitration_field(&what.frame), what.since, *node));
        let Some((from, what)) = winner else { return };
        if let Some(queue) = self.nodes.get_mut(&from) {
            queue.pop_front();
        }
        let time = match self.pacing {
            Pacing::AtOnce => Duration::from_micros(0),
            Pacing::Bitrate(bitrate) => bits_time(frame_bits(&what.frame), bitrate),
        };
        self.in_progress = Some(InProgress { from, what, start, end: start + time });
    }

    fn bit_time(&self) -> Duration {
        match self.pacing {
            Pacing::AtOnce => Duration::from_micros(0),
            Pacing::Bitrate(bitrate) => bits_time(1, bitrate),
        }
    }
}

/// A frame's arbitration field as a number: the lowest wins. A standard frame wins over an extended frame with the same
/// leading 11 bits, and a data frame over a remote frame.
pub(crate) fn arbitration_field(frame: &CanFrame) -> u32 {
    let remote = u32::from(frame.is_remote());
    match frame.id() {
        CanId::Standard(id) => u32::from(id) << 21 | remote << 20,
        CanId::Extended(id) => (id >> 18) << 21 | 0b11 << 19 | (id & 0x3_FFFF) << 1 | remote,
    }
}

/// Length of a frame in bits, with stuff bits and the three bits of intermission.
pub(crate) fn frame_bits(frame: &CanFrame) -> u32 {
    let mut bits = BitCounter::default();
    let field = arbitration_field(frame);
    bits.push(0, 1);
    match frame.id() {
        // With IDE and r0.
        CanId::Standard(_) => bits.push(field >> 20 << 2, 14),
        // With r1 and r0.
        CanId::Extended(_) => {
            bits.push(field, 32);
            bits.push(0, 2);
        }
    }
    bits.push(frame.dlc() as u32, 4);
    for &byte in frame.data() {
        bits.push(u32::from(byte), 8);
    }
    bits.push(u32::from(bits.crc), 15);
    bits.count + BITS_AFTER_CRC
}

/// Counts bits with stuffing: after five equal bits, an opposite one is inserted.
#[derive(Debug, Default)]
struct BitCounter {
    count: u32,
    crc: u16,
    last: u32,
    run: u32,
}

impl BitCounter {
    fn push(&mut self, value: u32, width: u32) {
        for place in (0..width).rev() {
            let bit = value >> place & 1;
            let feedback = u32::from(self.crc >> 14) ^ bit;
            self.crc = (self.crc << 1 ^ if feedback == 1 { CRC_POLYNOMIAL } else { 0 }) & 0x7FFF;
            self.run = if bit == self.last { self.run + 1 } else { 1 };
            self.last = bit;
            self.count += 1;
            if self.run == 5 {
                (self.last, self.run) = (1 - bit, 1);
                self.count += 1;
            }
        }
    }
}

fn bits_time(bits: u32, bitrate: u32) -> Duration {
    Duration::from_micros((u64::from(bits) * 1_000_000).div_ceil(u64::from(bitrate.max(1))))
}

/// Maximum number of one node's frames that wait for the bus.
pub(crate) const MAX_QUEUED: usize = 64;
/// CRC delimiter, acknowledgement with its delimiter, 7 bits of end of frame, 3 bits of intermission.
const BITS_AFTER_CRC: u32 = 13;
/// CRC-15/CAN.
const CRC_POLYNOMIAL: u16 = 0x4599;

#[cfg(test)]
#[path = "wire_tests.rs"]
mod tests;
