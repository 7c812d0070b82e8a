//! The table of system variables, from which everything about them is derived (docs/wire/sysvars.md).
//!
//! A [`SysVar`] is one variable, such as `RobotState[8]`. Its type, direction, unit, and its places in the 2001 stream,
//! the Modbus map and the process image all come from [`SPANS`].

mod name;
mod state;
mod table;

pub use name::{ParseError, VarBit, VarRange};
pub use table::{SPANS, Span};

use crate::wire::scalar::ScalarType;

/// The direction of a variable (docs/wire/sysvars.md sections 1 and 2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Direction {
    /// User to robot.
    Input,
    /// Robot to user.
    Output,
}

/// The place of a variable in the 1468-byte state packet of port 2001.
///
/// A byte variable occupies eight bools, one byte each, lowest number first. Words and floats are stored unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StreamPlace {
    /// Offset of the first byte in the packet.
    pub offset: u16,
    /// Length in bytes: 8 for a byte variable, 2 for a word, 4 for a float.
    pub len: u16,
}

/// The place of a variable in the controller's Modbus map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModbusPlace {
    /// `count` coils from `first`, the lowest-numbered item first.
    Coils {
        /// Address of bit 0.
        first: u16,
        /// 8, or 2 for the tool's inputs and outputs.
        count: u16,
    },
    /// One holding register with the value.
    Register {
        /// The register's address.
        address: u16,
    },
    /// One holding register with a float as `value * per_unit`, two's complement, saturated at ±32767. This is coarser
    /// than every other source of the value.
    Scaled {
        /// The register's address.
        address: u16,
        /// Counts per unit: 1000 or 10000.
        per_unit: u16,
    },
}

/// One system variable.
///
/// Inputs come first, in the specification's order, then outputs. The process image has the same order, so consecutive
/// variables of one kind are consecutive bytes there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct SysVar(u8);

#[derive(Debug, Clone, Copy)]
pub(crate) struct VarPlace {
    /// In the Modbus map.
    pub modbus: Option<ModbusPlace>,
    /// Number of variables from this one to the last of its table row.
    pub left_in_row: usize,
    /// Offset in the process image.
    pub image_offset: usize,
}

/// Number of system variables.
pub const COUNT: usize = table::COUNT;
/// Number of inputs; they have the lowest ordinals.
pub(crate) const INPUT_COUNT: usize = table::INPUT_COUNT;
/// Number of byte variables among the inputs; they have the lowest ordinals.
pub(crate) const BIT_INPUT_COUNT: usize = table::BIT_INPUT_COUNT;
/// Size of the process image: every variable packed in order.
pub const IMAGE_BYTES: usize = table::IMAGE_BYTES;
/// Size of the image's first part, the inputs.
pub const INPUT_BYTES: usize = table::INPUT_BYTES;

impl SysVar {
    /// The variable with this ordinal, `0..COUNT`.
    pub const fn from_ordinal(ordinal: usize) -> Option<Self> {
        if ordinal < COUNT { Some(Self(ordinal as u8)) } else { None }
    }

    /// Every variable, in table order.
    pub fn all() -> impl DoubleEndedIterator<Item = Self> + ExactSizeIterator + Clone {
        (0..COUNT as u8).map(Self)
    }

    /// The variable's ordinal: its place in the table, `0..COUNT`.
    pub const fn ordinal(self) -> usize {
        self.0 as usize
    }

    /// The table row the variable belongs to.
    pub fn span(self) -> &'static Span {
        table::span_of(self.ordinal())
    }

    /// The group's name: `RobotState` of `RobotState[8]`.
    pub fn group(self) -> &'static str {
        self.span().group
    }

    /// The 1-based index: 8 of `RobotState[8]`.
    pub fn index(self) -> u8 {
        let span = self.span();
        span.first.saturating_add(self.place_in_span() as u8)
    }

    /// User to robot, or robot to user.
    pub fn direction(self) -> Direction {
        if self.ordinal() < INPUT_COUNT { Direction::Input } else { Direction::Output }
    }

    /// The variable's type: byte, word or float.
    pub fn ty(self) -> ScalarType {
        self.span().ty
    }

    /// Size in a recipe frame and in the image: 1, 2 or 4 bytes.
    pub fn size(self) -> usize {
        self.ty().size()
    }

    /// Offset of the variable in the process image.
    pub fn image_offset(self) -> usize {
        table::image_offset(self.ordinal())
    }

    /// The bits of a byte variable that are not reserved; 0xFF for every other type (D22).
    pub fn valid_bits(self) -> u8 {
        self.span().valid_bits
    }

    /// Whether the variable consists of eight (or two) separate bits, whose edges matter.
    pub fn is_bits(self) -> bool {
        self.ty() == ScalarType::Byte
    }

    /// The unit, such as `m` or `rad`; empty for bits, counts and registers.
    pub fn unit(self) -> &'static str {
        self.span().unit
    }

    /// The variable's place in the state packet. For an input, the output there shows its present value.
    pub fn stream(self) -> Option<StreamPlace> {
        let len = if self.is_bits() { 8 } else { self.size() } as u16;
        let first = self.span().stream?;
        Some(StreamPlace { offset: first.saturating_add(self.place_in_span().saturating_mul(len)), len })
    }

    /// The output that shows the value of this input: the one at the same place in the state packet.
    pub fn shown_by(self) -> Option<Self> {
        let place = self.stream().filter(|_| self.direction() == Direction::Input)?;
        Self::all().find(|var| var.direction() == Direction::Output && var.stream() == Some(place))
    }

    /// Number of variables from this one to the last of its table row.
    pub(crate) fn left_in_row(self) -> usize {
        self.place().left_in_row
    }

    /// The variable's place in the Modbus map; inputs can be written and read back there.
    pub fn modbus(self) -> Option<ModbusPlace> {
        self.place().modbus
    }

    /// All places, with one look-up.
    pub(crate) fn place(self) -> VarPlace {
        let (span, nth, image_offset) = table::place_of(self.ordinal());
        // No address is near the end of 16 bits, which a test checks.
        let modbus = span.modbus.map(|place| match place {
            ModbusPlace::Coils { first, count } => {
                ModbusPlace::Coils { first: first.wrapping_add(nth.wrapping_mul(count)), count }
            }
            ModbusPlace::Register { address } => ModbusPlace::Register { address: address.wrapping_add(nth) },
            ModbusPlace::Scaled { address, per_unit } => {
                ModbusPlace::Scaled { address: address.wrapping_add(nth), per_unit }
            }
        });
        let left_in_row = span.len().wrapping_sub(nth.into());
        VarPlace { modbus, left_in_row, image_offset }
    }

    fn place_in_span(self) -> u16 {
        table::place_in_span(self.ordinal())
    }
}

#[cfg(feature = "serde")]
impl<'de> serde::Deserialize<'de> for SysVar {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let ordinal = u8::deserialize(deserializer)?;
        Self::from_ordinal(usize::from(ordinal))
            .ok_or_else(|| serde::de::Error::custom("no system variable has this ordinal"))
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for SysVar {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::write!(f, "{=str}[{=u8}]", self.group(), self.index());
    }
}

#[cfg(test)]
mod tests;
