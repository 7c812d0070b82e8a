//! One element of a frame, and its length.

use crate::device::encoding::{Bits, Encoding, Kind, MAX_DIGITS, Overflow};
use crate::device::text::{Length, MAX_TEXT, Text, TextWidth};

/// One element of a frame, in the order of the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Element {
    /// A value.
    Value {
        /// How it is encoded.
        encoding: Encoding,
        /// What happens if a number is out of range.
        overflow: Overflow,
    },
    /// A constant: a frame with another value is not this frame.
    Fixed {
        /// How it is encoded.
        encoding: Encoding,
        /// The value, an integer.
        value: i64,
    },
    /// Bytes without meaning; any value is accepted.
    Padding {
        /// Number of bytes, 1 or more.
        len: u8,
        /// The byte that is sent.
        fill: u8,
    },
    /// Characters.
    Text(Text),
    /// The length of the frame.
    Length(Length),
}

impl Element {
    /// A value with this encoding; a number out of range is sent as the nearest one in range.
    pub const fn value(encoding: Encoding) -> Self {
        Self::Value { encoding, overflow: Overflow::Usual }
    }

    /// How the element is encoded; `None` for padding and text.
    pub const fn encoding(&self) -> Option<Encoding> {
        match *self {
            Self::Value { encoding, .. } | Self::Fixed { encoding, .. } => Some(encoding),
            Self::Length(Length { encoding, .. }) => Some(encoding),
            Self::Padding { .. } | Self::Text(_) => None,
        }
    }

    /// The byte that terminates the element, if its length varies.
    pub(super) fn until(&self) -> Option<u8> {
        match self {
            Self::Text(Text { width: TextWidth::Until(end), .. }) => Some(*end),
            Self::Text(_) | Self::Padding { .. } => None,
            _ => self.encoding()?.until(),
        }
    }

    pub(super) fn is_rest(&self) -> bool {
        matches!(self, Self::Text(Text { width: TextWidth::Rest, .. }))
    }

    /// Maximum number of bytes, including the terminating byte; 0 if shared.
    pub(crate) fn longest(&self) -> usize {
        match self.len() {
            _ if self.is_shared() => 0,
            Some(len) => len,
            None => self.most().saturating_add(usize::from(self.until().is_some())),
        }
    }

    /// Maximum number of bytes, if the length varies.
    pub(super) const fn most(&self) -> usize {
        match self {
            Self::Text(_) => MAX_TEXT,
            _ => MAX_DIGITS,
        }
    }

    pub(crate) fn bits(&self) -> Option<Bits> {
        match self.encoding()?.kind {
            Kind::Bits(bits) => Some(bits),
            _ => None,
        }
    }

    pub(crate) fn is_shared(&self) -> bool {
        self.encoding().is_some_and(|encoding| encoding.shared)
    }

    /// Number of bytes on the wire; `None` if it varies.
    pub(crate) fn len(&self) -> Option<usize> {
        match self {
            Self::Padding { len, .. } => Some(usize::from(*len)),
            Self::Value { encoding, .. } | Self::Fixed { encoding, .. } => encoding.size(),
            Self::Text(Text { width: TextWidth::Fixed(width), .. }) => Some(usize::from(*width)),
            Self::Text(_) => None,
            Self::Length(Length { encoding, .. }) => encoding.size(),
        }
    }
}
