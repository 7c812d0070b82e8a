//! The CAN bus at FDCAN1's pins: its bit rate, its faults, and the frames of other nodes.

use std::collections::VecDeque;

use crate::device::*;

/// A classic frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    /// Identifier of 11 or 29 bits.
    pub id: u32,
    /// Whether the identifier has 29 bits.
    pub is_extended: bool,
    /// Whether it is a remote frame.
    pub is_remote: bool,
    /// Data length code.
    pub len: u8,
    /// Data, of which `len` bytes are valid.
    pub data: [u8; 8],
}

impl Frame {
    /// A data frame with an identifier of 11 bits.
    ///
    /// # Panics
    /// More than 8 bytes.
    pub fn standard(id: u32, data: &[u8]) -> Self {
        let mut bytes = [0; 8];
        bytes[..data.len()].copy_from_slice(data);
        Self { id, is_extended: false, is_remote: false, len: data.len() as u8, data: bytes }
    }

    /// Its data.
    pub fn bytes(&self) -> &[u8] {
        &self.data[..usize::from(self.len.min(8))]
    }

    /// The element of the message RAM (RM0433, "FDCAN Tx buffer element").
    pub(super) fn words(&self) -> [u32; 4] {
        let id = if self.is_extended { self.id | 1 << 30 } else { self.id << 18 };
        let [a, b, c, d, e, f, g, h] = self.data;
        [
            id | u32::from(self.is_remote) << 29,
            u32::from(self.len) << 16,
            u32::from_le_bytes([a, b, c, d]),
            u32::from_le_bytes([e, f, g, h]),
        ]
    }

    pub(super) fn from_words([head, control, low, high]: [u32; 4]) -> Self {
        let is_extended = head >> 30 & 1 != 0;
        let id = if is_extended { head & 0x1FFF_FFFF } else { head >> 18 & 0x7FF };
        let mut data = [0; 8];
        data[..4].copy_from_slice(&low.to_le_bytes());
        data[4..].copy_from_slice(&high.to_le_bytes());
        Self { id, is_extended, is_remote: head >> 29 & 1 != 0, len: (control >> 16 & 0xF) as u8, data }
    }

    /// Bits that an attempt takes, with the intermission but without stuff bits.
    pub(crate) fn bits(&self, attempt: Attempt) -> u64 {
        let data = if self.is_remote { 0 } else { 8 * self.bytes().len() as u64 };
        let whole = if self.is_extended { 67 } else { 47 } + data;
        match attempt {
            Attempt::Acknowledged => whole,
            // Up to the missing acknowledge, then an error frame and the intermission.
            Attempt::NotAcknowledged => whole - 11 + 14,
            Attempt::BitError => 20 + 14,
        }
    }
}

/// Result of an attempt to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Attempt {
    /// Acknowledged by another node.
    Acknowledged,
    /// Not acknowledged.
    NotAcknowledged,
    /// Bit error.
    BitError,
}

/// A fault of the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BusFault {
    /// No fault.
    #[default]
    None,
    /// No other node is on the bus.
    NoAcknowledge,
    /// A short circuit: every frame has a bit error.
    ShortCircuit,
}

/// The bus.
#[derive(Debug, Default)]
pub struct CanBus {
    /// Bit rate of the other nodes in bit/s; 0 for that of the chip.
    pub bitrate: u32,
    /// Its fault.
    pub fault: BusFault,
    /// Frames sent by the chip, with the end of each.
    pub sent: Vec<(Picos, Frame)>,
    /// Number of attempts of the chip to send.
    pub attempts: u64,
    /// Number of frames that the chip acknowledged.
    pub received: u64,
    /// Number of frames that the chip could not receive.
    pub missed: u64,
    /// Number of frames that passed the acceptance filters.
    pub accepted: u64,
    /// Number of frames that the chip aborted.
    pub aborted: u64,
    /// Times at which the chip went bus-off.
    pub bus_offs: Vec<Picos>,
    /// Frames of other nodes, each with its end.
    arriving: VecDeque<(Picos, Arrival)>,
}

/// A frame of another node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Arrival {
    Frame(Frame),
    /// With an error that all receivers detect.
    ErrorFrame,
}

impl CanBus {
    /// Another node sends a frame that ends at `ended`, after all earlier ones.
    pub fn send(&mut self, ended: Picos, frame: Frame) {
        self.arriving.push_back((ended, Arrival::Frame(frame)));
    }

    /// Like [`CanBus::send`], for a frame with a wrong CRC or a stuff error.
    pub fn send_error_frame(&mut self, ended: Picos) {
        self.arriving.push_back((ended, Arrival::ErrorFrame));
    }

    /// Whether a node with this bit time can receive the others: within 0.5 %.
    pub(super) fn is_understood(&self, bit: Picos) -> bool {
        let theirs = if self.bitrate == 0 { bit } else { SECOND / Picos::from(self.bitrate) };
        theirs.abs_diff(bit) * 200 <= theirs
    }

    pub(super) fn attempt(&mut self, bit: Picos, at: &Context<'_>) -> Result<Attempt, Refusal> {
        let (tx, rx) = (Pin('D', 1), Pin('D', 0));
        if !tx.is(at.functions, 9) || !rx.is(at.functions, 9) {
            return refuse("a frame is sent, but PD0 and PD1 are not its pins");
        }
        self.attempts += 1;
        Ok(match self.fault {
            BusFault::None if self.is_understood(bit) => Attempt::Acknowledged,
            BusFault::NoAcknowledge => Attempt::NotAcknowledged,
            BusFault::None | BusFault::ShortCircuit => Attempt::BitError,
        })
    }

    pub(super) fn next_arrival(&self) -> Option<Picos> {
        self.arriving.front().map(|(ended, _)| *ended)
    }

    pub(super) fn arrival(&mut self, now: Picos) -> Option<Arrival> {
        self.next_arrival().filter(|ended| *ended <= now)?;
        self.arriving.pop_front().map(|(_, arrival)| arrival)
    }
}
