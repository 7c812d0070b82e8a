//! The trait of an RS-485 line for the tasks.

use embedded_io_async::{Read, Write};

/// A half-duplex line (D20).
pub trait Line: Read + Write {
    /// Raises or releases driver-enable; nothing where the hardware does it, or where there is none.
    fn drive(&mut self, direction: LineDirection) {
        let _ = direction;
    }

    /// Counters of characters that the device could not take.
    fn errors(&self) -> LineErrors {
        LineErrors::NONE
    }
}

/// Characters that a line's device could not take since it was started. Counters wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineErrors {
    /// Characters discarded because of their parity.
    pub parity: u32,
    /// Characters discarded because of a missing stop bit.
    pub framing: u32,
    /// Times that the receive FIFO was full, with one character or more lost.
    pub overruns: u32,
    /// Characters lost because they were not read in time.
    pub unread: u32,
}

impl LineErrors {
    pub(crate) const NONE: Self = Self { parity: 0, framing: 0, overruns: 0, unread: 0 };
}

/// Which side drives the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineDirection {
    /// The devices.
    Receive,
    /// The gateway.
    Send,
}
