//! Coils and registers of a PDU: borrowed, length-checked views (docs/wire/modbus.md section 3).

use super::parts::copy_cleared;

/// Maximum number of coils in an FC 1 request, and so in any answer or write.
pub const MAX_READ_COILS: u16 = 0x07D0;

/// A run of coils, packed eight per byte, the first coil in the least significant bit.
///
/// Bits beyond the last coil are ignored when read and compared, and sent as 0.
#[derive(Debug, Clone, Copy)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Coils<'a> {
    packed: &'a [u8],
    count: u16,
}

impl<'a> Coils<'a> {
    /// The first `count` coils of `packed`; `None` when `count` is 0 or over 2000, or `packed` is too short.
    pub fn new(packed: &'a [u8], count: u16) -> Option<Self> {
        if count == 0 || count > MAX_READ_COILS {
            return None;
        }
        packed.get(..packed_len(count)).map(|packed| Self { packed, count })
    }

    /// The `count` coils in `packed`, which must have exactly the bytes for them.
    pub(super) fn exact(packed: &'a [u8], count: u16) -> Option<Self> {
        let fits = count != 0 && count <= MAX_READ_COILS && packed.len() == packed_len(count);
        fits.then_some(Self { packed, count })
    }

    /// The `count` coils of an answer. The sender of the request checked the count, and the length of `packed`.
    pub(super) const fn of_request(packed: &'a [u8], count: u16) -> Self {
        Self { packed, count }
    }

    /// Packs `coils` into the front of `buffer`; `None` when there are none, or more than 2000, or
    /// `buffer` is too short.
    pub fn pack(coils: impl IntoIterator<Item = bool>, buffer: &'a mut [u8]) -> Option<Self> {
        let mut count: u16 = 0;
        for on in coils {
            if count >= MAX_READ_COILS {
                return None;
            }
            let (byte, bit) = (usize::from(count >> 3), count & 7);
            let target = buffer.get_mut(byte)?;
            // A fresh byte starts from zero, so the bits beyond the last coil are 0.
            let kept = if bit == 0 { 0 } else { *target };
            *target = kept | u8::from(on) << bit;
            count = count.saturating_add(1);
        }
        Self::new(buffer, count)
    }

    /// Number of coils, at least 1.
    pub const fn count(self) -> u16 {
        self.count
    }

    /// Coil `nth`, counted from 0.
    pub fn coil(self, nth: u16) -> Option<bool> {
        if nth >= self.count {
            return None;
        }
        self.packed.get(usize::from(nth >> 3)).map(|byte| byte >> (nth & 7) & 1 == 1)
    }

    /// The coils in order.
    pub fn iter(self) -> impl Iterator<Item = bool> + 'a {
        (0..self.count).map_while(move |nth| self.coil(nth))
    }

    /// Up to eight coils from `first` on as one byte, as byte variables of the map; the first coil is the least
    /// significant bit. `None` if `first` is beyond the last coil.
    pub fn byte(self, first: u16) -> Option<u8> {
        let left = self.count.checked_sub(first).filter(|left| *left != 0)?;
        let at = usize::from(first >> 3);
        let low = *self.packed.get(at)?;
        let high = self.packed.get(at.saturating_add(1)).copied().unwrap_or_default();
        let byte = (u16::from_le_bytes([low, high]) >> (first & 7)) as u8;
        Some(if left < 8 { byte & last_mask(left) } else { byte })
    }

    /// Writes the packed coils to the front of `bytes`, with the bits beyond the last coil as 0, and returns their
    /// number of bytes; `None`, with nothing written, if `bytes` is too short.
    pub fn copy_to(self, bytes: &mut [u8]) -> Option<usize> {
        let target = bytes.get_mut(..self.packed.len())?;
        copy_cleared(self.packed, self.unused(), target);
        Some(target.len())
    }

    /// The packed bytes; bits beyond the last coil may have any value, see [`Coils::last_mask`].
    pub const fn packed(self) -> &'a [u8] {
        self.packed
    }

    /// Number of unused bits, the highest ones, in the last packed byte.
    pub(super) const fn unused(self) -> u8 {
        self.count.wrapping_neg() as u8 & 7
    }

    /// Mask of the used bits in the last packed byte.
    pub const fn last_mask(self) -> u8 {
        last_mask(self.count)
    }
}

impl PartialEq for Coils<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.count == other.count
            && match (self.packed.split_last(), other.packed.split_last()) {
                (Some((last, head)), Some((other_last, other_head))) => {
                    head == other_head && (last ^ other_last) & self.last_mask() == 0
                }
                _ => true,
            }
    }
}

impl Eq for Coils<'_> {}

/// A run of registers as big-endian bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Registers<'a> {
    bytes: &'a [u8],
}

impl<'a> Registers<'a> {
    /// The registers in `bytes`, two big-endian bytes each; `None` when there are none, an odd
    /// number of bytes, or more than 125 registers.
    pub const fn new(bytes: &'a [u8]) -> Option<Self> {
        let len = bytes.len();
        if len == 0 || len > MAX_REGISTER_BYTES || !len.is_multiple_of(2) {
            return None;
        }
        Some(Self { bytes })
    }

    /// The `count` registers in `bytes`, which must have exactly the bytes for them.
    pub(super) fn exact(bytes: &'a [u8], count: u16) -> Option<Self> {
        let len = usize::from(count).saturating_mul(2);
        (len != 0 && len <= MAX_REGISTER_BYTES && bytes.len() == len).then_some(Self { bytes })
    }

    /// The registers of an answer, whose length the sender of the request has checked.
    pub(super) const fn of_request(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    /// Writes `values` big-endian into the front of `buffer`; `None` when there are none, or more
    /// than 125, or `buffer` is too short.
    pub fn pack(values: impl IntoIterator<Item = u16>, buffer: &'a mut [u8]) -> Option<Self> {
        let mut count: usize = 0;
        let (words, _) = buffer.as_chunks_mut::<2>();
        for value in values {
            *words.get_mut(count)? = value.to_be_bytes();
            count = count.saturating_add(1);
        }
        Self::new(words.as_flattened().get(..count.saturating_mul(2))?)
    }

    /// Converts little-endian words, as in the process image, into registers at the front of `buffer`; `None` in the
    /// same cases as [`Registers::pack`].
    pub fn from_little_endian(words: &[u8], buffer: &'a mut [u8]) -> Option<Self> {
        let (words, odd) = words.as_chunks::<2>();
        if !odd.is_empty() {
            return None;
        }
        Self::pack(words.iter().map(|word| u16::from_le_bytes(*word)), buffer)
    }

    /// Number of registers, at least 1.
    pub const fn count(self) -> u16 {
        // At most 125 by construction.
        (self.bytes.len() >> 1) as u16
    }

    /// Register `nth`, counted from 0.
    pub fn register(self, nth: u16) -> Option<u16> {
        self.bytes.as_chunks::<2>().0.get(usize::from(nth)).map(|word| u16::from_be_bytes(*word))
    }

    /// The registers in order.
    pub fn iter(self) -> impl ExactSizeIterator<Item = u16> + DoubleEndedIterator + Clone + 'a {
        self.bytes.as_chunks::<2>().0.iter().map(|word| u16::from_be_bytes(*word))
    }

    /// Writes the registers to the front of `words`, as many as fit, and returns how many.
    pub fn copy_to(self, words: &mut [u16]) -> usize {
        let registers = self.bytes.as_chunks::<2>().0;
        let count = registers.len().min(words.len());
        let (Some(registers), Some(words)) = (registers.get(..count), words.get_mut(..count)) else {
            return 0;
        };
        turn(registers, words);
        count
    }

    /// The registers as on the wire.
    pub const fn as_be_bytes(self) -> &'a [u8] {
        self.bytes
    }
}

/// Converts as many registers as there are words.
// Pieces of a fixed size become vector operations. Instead of a loop for the remainder, the last registers are
// converted as a piece that overlaps others.
fn turn(registers: &[[u8; 2]], words: &mut [u16]) {
    let (Some(last), true) = (registers.last_chunk(), registers.len() == words.len()) else {
        return registers.iter().zip(words).for_each(|(from, to)| *to = u16::from_be_bytes(*from));
    };
    if let Some(last_words) = words.last_chunk_mut() {
        turn_piece::<HALF>(last, last_words);
    }
    let (pieces, rest) = registers.as_chunks::<PIECE>();
    let (word_pieces, rest_words) = words.as_chunks_mut::<PIECE>();
    for (piece, words) in pieces.iter().zip(word_pieces) {
        turn_piece(piece, words);
    }
    if let (Some(half), Some(words)) = (rest.first_chunk(), rest_words.first_chunk_mut()) {
        turn_piece::<HALF>(half, words);
    }
}

// Reads all before it writes any, so the compiler need not prove that the slices do not overlap.
fn turn_piece<const N: usize>(registers: &[[u8; 2]; N], words: &mut [u16; N]) {
    *words = registers.map(u16::from_be_bytes);
}

/// Registers of one vector; the full piece has two.
const HALF: usize = 8;
const PIECE: usize = 16;

pub(super) const fn packed_len(count: u16) -> usize {
    count.div_ceil(8) as usize
}

/// Mask of the used bits in the last byte of `count` packed coils.
pub(super) const fn last_mask(count: u16) -> u8 {
    // The number of unused bits is the distance to the next multiple of 8.
    0xFF_u8 >> (count.wrapping_neg() & 7)
}

const MAX_REGISTER_BYTES: usize = 250;
