//! The checksum of a frame: which bytes it covers, and how it is written.

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
    /// The first byte of the frame that it covers; 0 is the first of the head.
    pub first: u16,
    /// The byte behind the last one; 0 is that of the checksum.
    pub end: u16,
    /// Bytes that it covers although they are not in the frame.
    pub data_id: DataId,
}

/// Bytes that a checksum covers beside those of the frame, so that a frame for somebody else has
/// another one.
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
    /// No bytes.
    pub const NONE: Self = Self { bytes: [0; MAX_DATA_ID], len: 0, is_behind: false };

    /// These bytes, before those of the frame; `None` if there are more than four.
    pub fn new(bytes: &[u8]) -> Option<Self> {
        let mut id = Self { len: bytes.len() as u8, ..Self::NONE };
        id.bytes.get_mut(..bytes.len())?.iter_mut().zip(bytes).for_each(|(slot, &byte)| *slot = byte);
        Some(id)
    }

    /// The same, behind those of the frame.
    pub const fn behind(self) -> Self {
        Self { is_behind: true, ..self }
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..usize::from(self.len)).unwrap_or(&[])
    }

    /// Whether they are behind those of the frame.
    pub const fn is_behind(&self) -> bool {
        self.is_behind
    }
}

impl Checksum {
    /// This algorithm as its standard has it: over everything before it, in the standard's byte
    /// order.
    pub const fn standard(algorithm: Algorithm) -> Self {
        Self { algorithm, order: algorithm.order(), text: false, first: 0, end: 0, data_id: DataId::NONE }
    }

    /// Over these bytes of the frame, the last one included; `None` is the one before the checksum.
    pub const fn over(self, first: u16, last: Option<u16>) -> Self {
        let end = match last {
            Some(last) => last.saturating_add(1),
            None => 0,
        };
        Self { first, end, ..self }
    }

    /// Over these bytes too, which are not in the frame.
    pub const fn with_data_id(self, data_id: DataId) -> Self {
        Self { data_id, ..self }
    }

    /// The last byte that it covers; `None` is the one before the checksum.
    pub const fn last(&self) -> Option<u16> {
        self.end.checked_sub(1)
    }

    /// Number of bytes in the frame, 1..=8.
    pub const fn len(&self) -> usize {
        self.algorithm.len().saturating_mul(if self.text { 2 } else { 1 })
    }

    /// Whether it has no bytes: never, for a valid algorithm.
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The bytes it covers, if it stands at `at` itself.
    pub(super) fn covered(&self, at: usize) -> core::ops::Range<usize> {
        let end = self.last().map_or(at, |last| usize::from(last).saturating_add(1));
        usize::from(self.first)..end
    }

    /// The bytes that stand for the checksum of `covered`.
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
