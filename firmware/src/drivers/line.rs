//! What the tasks ask of an RS-485 line.

use embedded_io_async::{Read, Write};

/// A half-duplex line (D20).
pub trait Line: Read + Write {
    /// Raises or releases driver-enable; nothing where the hardware does it, or where there is none.
    fn drive(&mut self, direction: LineDirection) {
        let _ = direction;
    }

    /// What the device could not take.
    fn errors(&self) -> LineErrors {
        LineErrors::NONE
    }
}

/// What a line's device could not take since it was started. Counters wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineErrors {
    /// Characters left out for their parity.
    pub parity: u32,
    /// Characters left out for a stop bit that was none.
    pub framing: u32,
    /// Times that the receive FIFO was full, with one character or more lost.
    pub overruns: u32,
    /// Characters lost because nobody read.
    pub unread: u32,
}

impl LineErrors {
    pub(crate) const NONE: Self = Self { parity: 0, framing: 0, overruns: 0, unread: 0 };
}

/// Who drives the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineDirection {
    /// The devices.
    Receive,
    /// We.
    Send,
}
