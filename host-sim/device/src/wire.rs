//! A CAN bus as a wire (proto-core/docs/wire/slcan.md section 4): frames of its nodes and the time go in, frames
//! that have crossed it come out, one after the other in the order of arbitration.
//!
//! No clock and no I/O here, and no bit errors: every frame is received well by all.

use std::collections::{BTreeMap, VecDeque};

use embedded_can::Frame;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};

/// How long frames take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pacing {
    /// None at all: a frame has crossed as soon as it is given.
    AtOnce,
    /// As long as their bits take at this rate, in bit/s.
    Bitrate(u32),
}

/// One node of a wire. Of nodes that joined earlier it is the greater.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct NodeId(u64);

/// A frame that has crossed the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Crossed {
    /// Whose it was.
    pub from: NodeId,
    /// The frame.
    pub frame: CanFrame,
    /// When it ended.
    pub at: Instant,
}

/// The node has [`MAX_QUEUED`] frames waiting already; the frame was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Full;

/// The wire.
#[derive(Debug)]
pub struct Wire {
    pacing: Pacing,
    nodes: BTreeMap<NodeId, VecDeque<Waiting>>,
    joined: u64,
    on_the_wire: Option<UnderWay>,
    /// When the last frame ended.
    free_since: Instant,
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    since: Instant,
    frame: CanFrame,
}

#[derive(Debug, Clone, Copy)]
struct UnderWay {
    from: NodeId,
    what: Waiting,
    start: Instant,
    end: Instant,
}

impl Wire {
    /// An idle wire without nodes.
    pub fn new(pacing: Pacing) -> Self {
        Self {
            pacing,
            nodes: BTreeMap::new(),
            joined: 0,
            on_the_wire: None,
            free_since: Instant::from_micros(0),
        }
    }

    /// One node more.
    pub fn join(&mut self) -> NodeId {
        let id = NodeId(self.joined);
        self.joined += 1;
        self.nodes.insert(id, VecDeque::new());
        id
    }

    /// One node less. What waits there is given up; a frame on the wire still crosses it.
    pub fn leave(&mut self, node: NodeId) {
        self.nodes.remove(&node);
    }

    /// Frames of the node that have not left, the one on the wire among them.
    pub fn waiting(&self, node: NodeId) -> usize {
        let queued = self.nodes.get(&node).map_or(0, VecDeque::len);
        queued + usize::from(self.on_the_wire.is_some_and(|frame| frame.from == node))
    }

    /// Whether the node's next frame would be refused.
    pub fn is_full(&self, node: NodeId) -> bool {
        self.nodes.get(&node).is_none_or(|queue| queue.len() >= MAX_QUEUED)
    }

    /// Takes a frame to send; [`Wire::poll`] is due after it.
    ///
    /// # Errors
    /// See [`Full`].
    pub fn send(&mut self, now: Instant, node: NodeId, frame: CanFrame) -> Result<(), Full> {
        let queue = self.nodes.get_mut(&node).filter(|queue| queue.len() < MAX_QUEUED).ok_or(Full)?;
        queue.push_back(Waiting { since: now, frame });
        match self.on_the_wire {
            None => self.arbitrate(),
            // Nobody has told the first bit from another's yet, so this frame takes part.
            Some(first) if now <= first.start + self.bit_time() => {
                if let Some(queue) = self.nodes.get_mut(&first.from) {
                    queue.push_front(first.what);
                    self.on_the_wire = None;
                    self.arbitrate();
                }
            }
            Some(_) => {}
        }
        Ok(())
    }

    /// When the frame on the wire ends; [`Instant::NEVER`] when there is none.
    pub fn deadline(&self) -> Instant {
        self.on_the_wire.map_or(Instant::NEVER, |frame| frame.end)
    }

    /// The next frame that has ended by now. Late polls lose no time: the frame after it began when it
    /// ended, and only nodes that had one by then contended.
    pub fn poll(&mut self, now: Instant) -> Option<Crossed> {
        let UnderWay { from, what, end, .. } = self.on_the_wire.take_if(|frame| frame.end <= now)?;
        self.free_since = end;
        self.arbitrate();
        Some(Crossed { from, frame: what.frame, at: end })
    }

    /// Of the nodes that had a frame when the wire became free, or the first one after that, the one
    /// with the lowest arbitration field begins.
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
            Pacing::Bitrate(bitrate) => bits_time(bits_on_the_wire(&what.frame), bitrate),
        };
        self.on_the_wire = Some(UnderWay { from, what, start, end: start + time });
    }

    fn bit_time(&self) -> Duration {
        match self.pacing {
            Pacing::AtOnce => Duration::from_micros(0),
            Pacing::Bitrate(bitrate) => bits_time(1, bitrate),
        }
    }
}

/// What nodes send bit by bit while they contend, as a number: the lowest wins. A standard frame beats
/// an extended one with the same leading 11 bits, and a data frame beats a remote one.
pub fn arbitration_field(frame: &CanFrame) -> u32 {
    let remote = u32::from(frame.is_remote());
    match frame.id() {
        CanId::Standard(id) => u32::from(id) << 21 | remote << 20,
        CanId::Extended(id) => (id >> 18) << 21 | 0b11 << 19 | (id & 0x3_FFFF) << 1 | remote,
    }
}

/// The bits of a frame with its stuff bits and the three bits of pause after it.
pub fn bits_on_the_wire(frame: &CanFrame) -> u32 {
    let mut bits = Bits::default();
    let field = arbitration_field(frame);
    bits.push(0, 1);
    match frame.id() {
        // With the bits IDE and r0.
        CanId::Standard(_) => bits.push(field >> 20 << 2, 14),
        // With the bits r1 and r0.
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

/// Counts bits as they are stuffed: after five equal ones comes another.
#[derive(Debug, Default)]
struct Bits {
    count: u32,
    crc: u16,
    last: u32,
    run: u32,
}

impl Bits {
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

/// Most frames of one node that wait for the wire.
pub const MAX_QUEUED: usize = 64;
/// CRC delimiter, acknowledgement with its delimiter, 7 bits of end, 3 bits of pause.
const BITS_AFTER_CRC: u32 = 13;
/// Of CRC-15/CAN.
const CRC_POLYNOMIAL: u16 = 0x4599;

#[cfg(test)]
#[path = "wire_tests.rs"]
mod tests;
