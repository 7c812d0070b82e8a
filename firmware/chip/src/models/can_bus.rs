//! The CAN bus at FDCAN1's pins: its speed, who acknowledges, what disturbs it, and the frames of others.

use std::collections::VecDeque;

use crate::device::*;

/// A classic frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    /// 11 or 29 bits.
    pub id: u32,
    /// 29 bits.
    pub is_extended: bool,
    /// It asks for data.
    pub is_remote: bool,
    /// As the length code says.
    pub len: u8,
    /// Of these, `len` count.
    pub data: [u8; 8],
}

impl Frame {
    /// A frame with 11 bits of id.
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

    /// As an element of the message RAM (RM0433, "FDCAN Tx buffer element").
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

    /// How many bits an attempt takes, without stuff bits, with the pause behind it.
    pub(crate) fn bits(&self, attempt: Attempt) -> u64 {
        let data = if self.is_remote { 0 } else { 8 * self.bytes().len() as u64 };
        let whole = if self.is_extended { 67 } else { 47 } + data;
        match attempt {
            Attempt::Acknowledged => whole,
            // Up to the missing acknowledge, an error frame, the pause.
            Attempt::NotAcknowledged => whole - 11 + 14,
            Attempt::Disturbed => 20 + 14,
        }
    }
}

/// What becomes of a transmission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Attempt {
    /// Somebody has heard it.
    Acknowledged,
    /// Nobody has.
    NotAcknowledged,
    /// A bit was another than the one that was sent.
    Disturbed,
}

/// What is wrong with the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Trouble {
    /// Nothing.
    #[default]
    None,
    /// Nobody else is there.
    Alone,
    /// A short circuit: no bit is as it was sent.
    Short,
}

/// The bus.
#[derive(Debug, Default)]
pub struct CanBus {
    /// Bit/s of all others; 0 for as fast as the chip.
    pub bitrate: u32,
    /// What is wrong.
    pub trouble: Trouble,
    /// What the chip has sent, with the end of each.
    pub sent: Vec<(Picos, Frame)>,
    /// Attempts of the chip to send.
    pub attempts: u64,
    /// Frames of others that the chip acknowledged.
    pub heard: u64,
    /// Frames of others that it was not there for.
    pub missed: u64,
    /// Frames of others that a filter let pass.
    pub passed: u64,
    /// Frames that the chip broke off in the middle.
    pub broken_off: u64,
    /// When it went bus-off.
    pub bus_offs: Vec<Picos>,
    /// What others send: when each has ended.
    arriving: VecDeque<(Picos, Arrival)>,
}

/// What others put on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Arrival {
    Frame(Frame),
    /// Nobody can read it.
    Broken,
}

impl CanBus {
    /// Another node sends a frame, which has ended then; later than all before.
    pub fn send(&mut self, ended: Picos, frame: Frame) {
        self.arriving.push_back((ended, Arrival::Frame(frame)));
    }

    /// As [`CanBus::send`], a frame with a wrong check sum or too many equal bits.
    pub fn send_broken(&mut self, ended: Picos) {
        self.arriving.push_back((ended, Arrival::Broken));
    }

    /// Whether a receiver with such bits understands the others: within half a percent.
    pub(super) fn is_understood(&self, bit: Picos) -> bool {
        let theirs = if self.bitrate == 0 { bit } else { SECOND / Picos::from(self.bitrate) };
        theirs.abs_diff(bit) * 200 <= theirs
    }

    pub(super) fn attempt(&mut self, bit: Picos, at: &Moment<'_>) -> Result<Attempt, Refusal> {
        let (tx, rx) = (Pin('D', 1), Pin('D', 0));
        if !tx.is(at.functions, 9) || !rx.is(at.functions, 9) {
            return refuse("a frame is sent, but PD0 and PD1 are not its pins");
        }
        self.attempts += 1;
        Ok(match self.trouble {
            Trouble::None if self.is_understood(bit) => Attempt::Acknowledged,
            Trouble::Alone => Attempt::NotAcknowledged,
            Trouble::None | Trouble::Short => Attempt::Disturbed,
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
