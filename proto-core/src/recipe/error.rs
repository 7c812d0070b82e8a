//! Errors in a recipe part, a payload or a buffer; each one carries its numbers.

use core::fmt;

use super::model::{MAX_CAN_IDS, MAX_DELIMITER, MAX_FIELDS, MAX_STREAM_FRAME, Mode};
use crate::sysvar::{Direction, SysVar};
use crate::wire::can::{CanId, MAX_CAN_DATA};
use crate::wire::scalar::ScalarType;

/// The place of a field in its part, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FieldPlace {
    /// The frame of a CAN part; `None` in a stream part.
    pub frame: Option<u8>,
    /// Index of the field in the stream part or in the CAN frame.
    pub field: u8,
}

/// Why a part is not valid (docs/wire/recipes.md section 2).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum PartError {
    /// A part (or one frame of a CAN part) without fields.
    NoFields {
        /// The frame of a CAN part; `None` in a stream part.
        frame: Option<u8>,
    },
    /// More than [`MAX_FIELDS`] fields in a part.
    TooManyFields {
        /// The first field that is too many.
        at: FieldPlace,
    },
    /// A head longer than [`MAX_DELIMITER`].
    HeadTooLong {
        /// Its length in bytes.
        len: usize,
    },
    /// A tail longer than [`MAX_DELIMITER`].
    TailTooLong {
        /// Its length in bytes.
        len: usize,
    },
    /// A part for a byte stream that has neither head nor tail, so its frames could not be found.
    NoDelimiter,
    /// Head, fields and tail together are longer than [`MAX_STREAM_FRAME`].
    StreamFrameTooLong {
        /// Their length in bytes.
        len: usize,
    },
    /// A user-defined part for UDP, which carries system data only (D16).
    UserDatagram,
    /// A system variable in a user-defined part, or the other way round.
    WrongMode {
        /// The field.
        at: FieldPlace,
        /// The recipe's mode.
        mode: Mode,
    },
    /// An output variable in an input part, or the other way round.
    WrongDirection {
        /// The field.
        at: FieldPlace,
        /// The field's variable.
        var: SysVar,
        /// The part it is in.
        part: Direction,
    },
    /// An input variable that two fields of the part would write.
    DuplicateVariable {
        /// The second of the two.
        at: FieldPlace,
        /// The first of the two.
        first: FieldPlace,
        /// Their variable.
        var: SysVar,
    },
    /// A CAN part without frames.
    NoFrames,
    /// More than [`MAX_CAN_IDS`] frames in a CAN part.
    TooManyFrames,
    /// The fields of a CAN frame are longer than [`MAX_CAN_DATA`] together.
    CanFrameTooLong {
        /// The frame.
        frame: u8,
        /// The fields' length in bytes.
        len: usize,
    },
    /// A CAN id that does not fit its kind.
    InvalidId {
        /// The frame.
        frame: u8,
        /// Its id.
        id: CanId,
    },
    /// Two frames of a device with the same id, and no constant to tell them apart.
    Indistinguishable {
        /// The second of the two.
        frame: u8,
        /// The first of the two.
        first: u8,
        /// Their id.
        id: CanId,
    },
    /// Two frames of a CAN part with the same id.
    DuplicateId {
        /// The second of the two.
        frame: u8,
        /// The first of the two.
        first: u8,
        /// Their id.
        id: CanId,
    },
}

impl PartError {
    /// The field that the error concerns.
    pub const fn field(&self) -> Option<FieldPlace> {
        match *self {
            Self::TooManyFields { at }
            | Self::WrongMode { at, .. }
            | Self::WrongDirection { at, .. }
            | Self::DuplicateVariable { at, .. } => Some(at),
            _ => None,
        }
    }

    /// The frame of a CAN part that the error concerns.
    pub const fn frame(&self) -> Option<u8> {
        match *self {
            Self::NoFields { frame } => frame,
            Self::CanFrameTooLong { frame, .. }
            | Self::InvalidId { frame, .. }
            | Self::Indistinguishable { frame, .. }
            | Self::DuplicateId { frame, .. } => Some(frame),
            Self::TooManyFrames => Some(MAX_CAN_IDS as u8),
            _ => match self.field() {
                Some(at) => at.frame,
                None => None,
            },
        }
    }
}

impl fmt::Display for FieldPlace {
    /// Messages count frames and fields from 1.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let field = u16::from(self.field).saturating_add(1);
        match self.frame {
            Some(frame) => write!(f, "field {field} of frame {}", u16::from(frame).saturating_add(1)),
            None => write!(f, "field {field}"),
        }
    }
}

impl fmt::Display for PartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NoFields { frame: None } => {
                write!(f, "a part needs 1..={MAX_FIELDS} fields; this one has none")
            }
            Self::NoFields { frame: Some(frame) } => {
                write!(f, "frame {} has no fields", u16::from(frame).saturating_add(1))
            }
            Self::TooManyFields { at } => write!(f, "{at} is one too many; a part has at most {MAX_FIELDS}"),
            Self::HeadTooLong { len } => {
                write!(f, "the head has {len} bytes; at most {MAX_DELIMITER} are allowed")
            }
            Self::TailTooLong { len } => {
                write!(f, "the tail has {len} bytes; at most {MAX_DELIMITER} are allowed")
            }
            Self::NoDelimiter => {
                f.write_str("a part on a byte stream needs a head or a tail of at least one byte")
            }
            Self::StreamFrameTooLong { len } => {
                write!(f, "head, fields and tail take {len} bytes; at most {MAX_STREAM_FRAME} are allowed")
            }
            Self::UserDatagram => f.write_str("UDP carries only system data, not user-defined fields"),
            Self::WrongMode { at, mode: Mode::Realtime } => {
                write!(f, "{at} is user-defined; a realtime recipe has only system variables")
            }
            Self::WrongMode { at, mode: Mode::User } => {
                write!(f, "{at} is a system variable; a user-defined recipe has only typed fields")
            }
            Self::WrongDirection { at, var, part: Direction::Input } => {
                write!(f, "{at}: {var} is an output of the robot and cannot be in an input part")
            }
            Self::WrongDirection { at, var, part: Direction::Output } => {
                write!(f, "{at}: {var} is an input of the robot and cannot be in an output part")
            }
            Self::DuplicateVariable { at, first, var } => write!(f, "{at}: {var} is already {first}"),
            Self::NoFrames => write!(f, "a CAN part needs 1..={MAX_CAN_IDS} frames; this one has none"),
            Self::TooManyFrames => write!(f, "a CAN part has at most {MAX_CAN_IDS} frames"),
            Self::CanFrameTooLong { frame, len } => write!(
                f,
                "the fields of frame {} take {len} bytes; a CAN frame carries at most {MAX_CAN_DATA}",
                u16::from(frame).saturating_add(1)
            ),
            Self::InvalidId { id: id @ CanId::Standard(_), .. } => {
                write!(f, "id {id} does not fit in 11 bits (0x000..=0x7ff)")
            }
            Self::InvalidId { id: CanId::Extended(id), .. } => {
                write!(f, "id {id:#010x} does not fit in 29 bits (0x00000000..=0x1fffffff)")
            }
            Self::Indistinguishable { first, id, .. } => {
                let first = u16::from(first).saturating_add(1);
                write!(
                    f,
                    "frame {first} has id {id}, too, and nothing tells the two apart; give both a constant at the \
                     same place, with another value"
                )
            }
            Self::DuplicateId { first, id, .. } => {
                write!(f, "frame {} already has id {id}", u16::from(first).saturating_add(1))
            }
        }
    }
}

impl core::error::Error for PartError {}

/// Why a received payload was rejected as a whole (docs/wire/recipes.md section 7, D22).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ValueError {
    /// A float or double field is infinite or not a number.
    NotFinite {
        /// The first such field, counted from 0.
        field: u8,
    },
    /// The length of the payload is not that of the fields.
    Length {
        /// The fields' length in bytes.
        expected: usize,
        /// The length of the payload.
        got: usize,
    },
}

impl fmt::Display for ValueError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NotFinite { field } => {
                write!(f, "field {} is not a finite number", u16::from(field).saturating_add(1))
            }
            Self::Length { expected, got } => write!(f, "the fields are {expected} bytes, not {got}"),
        }
    }
}

impl core::error::Error for ValueError {}

/// A buffer is too short for the frame; nothing was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NoSpace {
    /// The frame's length in bytes.
    pub needed: usize,
    /// The length of the buffer.
    pub available: usize,
}

impl fmt::Display for NoSpace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the frame has {} bytes; the buffer has {}", self.needed, self.available)
    }
}

impl core::error::Error for NoSpace {}

/// Why a frame cannot be encoded from values; nothing was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum EncodeError {
    /// The buffer is too short.
    NoSpace(NoSpace),
    /// The number of values differs from the number of fields.
    Count {
        /// Number of fields.
        expected: usize,
        /// Number of values.
        got: usize,
    },
    /// The type of a value differs from its field's.
    Type {
        /// The field, counted from 0.
        field: u8,
        /// The field's type.
        expected: ScalarType,
        /// The value's type.
        got: ScalarType,
    },
}

impl From<NoSpace> for EncodeError {
    fn from(error: NoSpace) -> Self {
        Self::NoSpace(error)
    }
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NoSpace(error) => error.fmt(f),
            Self::Count { expected, got } => write!(f, "{expected} fields, but {got} values"),
            Self::Type { field, expected, got } => {
                write!(
                    f,
                    "field {} is a {expected}, but the value is a {got}",
                    u16::from(field).saturating_add(1)
                )
            }
        }
    }
}

impl core::error::Error for EncodeError {}

/// Why a datagram is not a frame of the part (docs/wire/recipes.md section 5).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum DatagramError {
    /// The length is wrong.
    Length {
        /// The frame's length in bytes.
        expected: usize,
        /// The datagram's length.
        got: usize,
    },
    /// The head is wrong.
    Head,
    /// The tail is wrong.
    Tail,
}

impl fmt::Display for DatagramError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Length { expected, got } => write!(f, "a frame is {expected} bytes, the datagram {got}"),
            Self::Head => f.write_str("the datagram does not begin with the head"),
            Self::Tail => f.write_str("the datagram does not end with the tail"),
        }
    }
}

impl core::error::Error for DatagramError {}
