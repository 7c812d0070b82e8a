//! The checksum of a frame: its algorithm, encoding and range.

use crate::device::checksum::Algorithm;
use crate::device::order::ByteOrder;

/// Maximum number of bytes of a checksum in a frame: eight digits.
pub const MAX_CHECKSUM: usize = 8;

/// The checksum of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Checksum {
    /// How it is computed.
    pub algorithm: Algorithm,
    /// The order of its bytes: little or big.
    pub order: ByteOrder,
    /// Written as two hexadecimal digits in ASCII for each byte.
    pub text: bool,
    /// Offset of the first covered byte; 0 is the first byte of the head.
    pub first: u16,
    /// Where the covered bytes end: the byte after the last one; 0 stands for the checksum's own position.
    pub end: u16,
    /// Additional covered bytes that are not in the frame.
    pub data_id: DataId,
}

/// Bytes that are covered by a checksum but not in the frame, so that frames for another receiver have another
/// checksum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct DataId {
    bytes: [u8; MAX_DATA_ID],
    len: u8,
    is_behind: bool,
}

/// Maximum number of bytes of a data id.
pub const MAX_DATA_ID: usize = 4;

impl DataId {
    /// No additional bytes.
    pub const NONE: Self = Self { bytes: [0; MAX_DATA_ID], len: 0, is_behind: false };

    /// `bytes`, before those of the frame; `None` if there are more than four.
    pub fn new(bytes: &[u8]) -> Option<Self> {
        let mut id = Self { len: bytes.len() as u8, ..Self::NONE };
        id.bytes.get_mut(..bytes.len())?.iter_mut().zip(bytes).for_each(|(slot, &byte)| *slot = byte);
        Some(id)
    }

    /// Puts the bytes after those of the frame.
    pub const fn behind(self) -> Self {
        Self { is_behind: true, ..self }
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..usize::from(self.len)).unwrap_or(&[])
    }

    /// Whether the bytes come after those of the frame.
    pub const fn is_behind(&self) -> bool {
        self.is_behind
    }
}

impl Checksum {
    /// This algorithm with its standard byte order, over everything before the checksum.
    pub const fn standard(algorithm: Algorithm) -> Self {
        Self { algorithm, order: algorithm.order(), text: false, first: 0, end: 0, data_id: DataId::NONE }
    }

    /// Covers the bytes of the frame from `first` to `last`, inclusive; `None` is the byte before the checksum.
    pub const fn over(self, first: u16, last: Option<u16>) -> Self {
        let end = match last {
            Some(last) => last.saturating_add(1),
            None => 0,
        };
        Self { first, end, ..self }
    }

    /// Also covers these bytes, which are not in the frame.
    pub const fn with_data_id(self, data_id: DataId) -> Self {
        Self { data_id, ..self }
    }

    /// Offset of the last covered byte; `None` is the byte before the checksum.
    pub const fn last(&self) -> Option<u16> {
        self.end.checked_sub(1)
    }

    /// Length in the frame, 1..=8 bytes.
    pub const fn len(&self) -> usize {
        self.algorithm.len().saturating_mul(if self.text { 2 } else { 1 })
    }

    /// Whether the length is 0: never, if the algorithm is valid.
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Range of the covered bytes, for a checksum at offset `at`.
    pub(super) fn covered(&self, at: usize) -> core::ops::Range<usize> {
        let end = self.last().map_or(at, |last| usize::from(last).saturating_add(1));
        usize::from(self.first)..end
    }

    /// Writes the checksum of `covered` as it is in the frame.
    pub(super) fn write(&self, covered: &[u8], out: &mut [u8]) {
        let id = self.data_id.bytes();
        let (before, behind) = if self.data_id.is_behind { (&[][..], id) } else { (id, &[][..]) };
        let sum = self.algorithm.of([before, covered, behind]);
        let mut bytes = [0; 4];
        let Some(bytes) = bytes.get_mut(..self.algorithm.len()) else { return };
        self.order.write(u64::from(sum), bytes);
        if self.text {
            for (digits, &byte) in out.chunks_exact_mut(2).zip(&*bytes) {
                for (digit, half) in digits.iter_mut().zip([byte >> 4, byte & 0xF]) {
                    *digit = HEX_DIGITS.get(usize::from(half)).copied().unwrap_or(b'0');
                }
            }
        } else {
            for (slot, &byte) in out.iter_mut().zip(&*bytes) {
                *slot = byte;
            }
        }
    }
}

const HEX_DIGITS: [u8; 16] = *b"0123456789ABCDEF";
