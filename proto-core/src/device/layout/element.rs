//! One element of a frame, and how many bytes it takes.

use crate::device::encoding::{Bits, Encoding, Kind, MAX_DIGITS, Overflow};
use crate::device::text::{Length, MAX_TEXT, Text, TextWidth};

/// One element of a frame, in the order of the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Element {
    /// A value.
    Value {
        /// How it is written.
        encoding: Encoding,
        /// What is sent for a number that it cannot hold.
        overflow: Overflow,
    },
    /// A value that is always the same: a frame with another one is not this frame.
    Fixed {
        /// How it is written.
        encoding: Encoding,
        /// The value, an integer.
        value: i64,
    },
    /// Bytes without a meaning: any are accepted.
    Padding {
        /// Number of bytes, 1 or more.
        len: u8,
        /// What is sent.
        fill: u8,
    },
    /// Characters.
    Text(Text),
    /// The frame's length.
    Length(Length),
}

impl Element {
    /// A value that is written like this, or the nearest that fits.
    pub const fn value(encoding: Encoding) -> Self {
        Self::Value { encoding, overflow: Overflow::Usual }
    }

    /// How it is written; `None` for padding and text.
    pub const fn encoding(&self) -> Option<Encoding> {
        match *self {
            Self::Value { encoding, .. } | Self::Fixed { encoding, .. } => Some(encoding),
            Self::Length(Length { encoding, .. }) => Some(encoding),
            Self::Padding { .. } | Self::Text(_) => None,
        }
    }

    /// The byte that ends it, if its length varies.
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

    /// Maximum number of bytes, with the one that ends it; 0 if it is shared.
    pub(crate) fn longest(&self) -> usize {
        match self.len() {
            _ if self.is_shared() => 0,
            Some(len) => len,
            None => self.most().saturating_add(usize::from(self.until().is_some())),
        }
    }

    /// Maximum number of bytes if its length varies.
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
