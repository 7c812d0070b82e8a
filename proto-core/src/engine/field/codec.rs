//! The frames of a port's recipe, and how they are found in a stream.

use heapless::Vec;

use super::format::DeviceFormat;
use super::line::Line;
use super::texts::{MAX_TEXTS, TextBind};
use crate::device::{Cutter, Escape, Framer};
use crate::modbus::rtu::Slave;
use crate::recipe::{CanLayout, Deframer, StreamLayout};
use crate::time::Instant;

/// Maximum number of device frames of one port, input and output together.
pub(crate) const MAX_DEVICE_FRAMES: usize = 18;

/// The layouts of a port's recipe.
// With a tag of its own: a niche in a layout takes several instructions to read, each time.
#[derive(Debug, Clone)]
#[repr(u8)]
#[allow(clippy::large_enum_variant, reason = "without an allocator there is no box to put the larger one in")]
pub(crate) enum Codec {
    Stream { input: Option<StreamLayout>, output: Option<StreamLayout>, deframer: Deframer },
    Can { input: Option<CanLayout>, output: Option<CanLayout> },
    Device(DeviceCodec),
}

/// Device frames, and how they are found in a stream.
#[derive(Debug, Clone)]
pub(crate) struct DeviceCodec {
    /// The input frames, then the output frames.
    pub formats: Vec<DeviceFormat, MAX_DEVICE_FRAMES>,
    pub inputs: u8,
    /// `None` on a CAN bus.
    pub reader: Option<Reader>,
    /// The escaping of output frames.
    pub escape: Option<Escape>,
    pub texts: Vec<TextBind, MAX_TEXTS>,
    /// Bytes outside of frames that have already been counted.
    pub skipped_bytes: u32,
    /// The exchanges of the port, if its recipe has any.
    pub line: Option<Line>,
}

impl DeviceCodec {
    /// Whether there is a partial frame that silence could end.
    pub(crate) fn has_begun(&self) -> bool {
        self.reader.as_ref().is_some_and(Reader::has_begun)
    }

    /// Number of bindings of the input frames and of the output frames.
    pub(crate) fn fields(&self) -> (u16, u16) {
        let sum = |formats: &[DeviceFormat]| {
            formats.iter().map(|format| format.bindings.len).fold(0, u16::saturating_add)
        };
        (sum(self.input()), sum(self.output()))
    }

    pub(crate) fn input(&self) -> &[DeviceFormat] {
        self.formats.get(..usize::from(self.inputs)).unwrap_or(&[])
    }

    pub(crate) fn output(&self) -> &[DeviceFormat] {
        self.formats.get(usize::from(self.inputs)..).unwrap_or(&[])
    }
}

/// Finds frames in a stream.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant, reason = "without an allocator there is no box to put the larger one in")]
pub(crate) enum Reader {
    /// By their content.
    Search(Framer),
    /// By delimiters or silence. `heard` is when the newest bytes arrived.
    Whole { cutter: Cutter, heard: Instant },
    /// As requests of a Modbus master.
    Slave(Slave),
}

impl Reader {
    /// Whether there is a partial frame that silence could end.
    pub(crate) fn has_begun(&self) -> bool {
        match self {
            Self::Search(framer) => !framer.held().is_empty(),
            Self::Whole { cutter, .. } => cutter.has_begun(),
            // A slave has its own deadline.
            Self::Slave(_) => false,
        }
    }

    /// The bytes of the partial frame.
    pub(crate) fn held(&self) -> &[u8] {
        match self {
            Self::Search(framer) => framer.held(),
            Self::Whole { cutter, .. } => cutter.held(),
            Self::Slave(_) => &[],
        }
    }

    /// Discards the partial frame and returns its length.
    pub(crate) fn discard(&mut self) -> usize {
        match self {
            Self::Search(framer) => framer.discard(),
            Self::Whole { cutter, .. } => cutter.discard(),
            Self::Slave(slave) => slave.discard(),
        }
    }
}
