//! The trait of an RS-485 line for the tasks.

use embedded_io_async::{Read, Write};

/// A half-duplex line (D20).
pub trait Line: Read + Write {
    /// Switches driver-enable. Does nothing if the hardware controls driver-enable, or if there is none.
    fn drive(&mut self, direction: LineDirection) {
        let _ = direction;
    }

    /// Counters of characters that were discarded or lost.
    fn errors(&self) -> LineErrors {
        LineErrors::NONE
    }
}

/// Characters discarded or lost since the start. Counters wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineErrors {
    /// Characters discarded because of their parity.
    pub parity: u32,
    /// Characters discarded because of a missing stop bit.
    pub framing: u32,
    /// Overruns of the receive FIFO, each of which loses one character or more.
    pub overruns: u32,
    /// Characters lost because the task did not read them in time.
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
