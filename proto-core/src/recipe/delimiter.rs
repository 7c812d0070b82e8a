//! Heads and tails, compared as one masked word.

use super::model::MAX_DELIMITER;

/// Up to 8 bytes at the front of a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Head {
    bytes: [u8; MAX_DELIMITER],
    mask: [u8; MAX_DELIMITER],
    /// A head of up to two bytes and its mask; what no two bytes are if it is longer.
    short: u32,
    short_mask: u32,
    len: u8,
}

/// Up to 8 bytes at the end of a frame, kept at the end of `bytes`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tail {
    bytes: [u8; MAX_DELIMITER],
    mask: [u8; MAX_DELIMITER],
    len: u8,
}

#[inline(always)]
fn same(a: &[u8; 8], b: &[u8; 8], mask: &[u8; 8]) -> bool {
    (u64::from_ne_bytes(*a) ^ u64::from_ne_bytes(*b)) & u64::from_ne_bytes(*mask) == 0
}

impl Head {
    /// `None` when there are more than 8 bytes.
    pub(super) fn new(head: &[u8]) -> Option<Self> {
        let (mut bytes, mut mask) = ([0; MAX_DELIMITER], [0; MAX_DELIMITER]);
        bytes.get_mut(..head.len())?.copy_from_slice(head);
        mask.get_mut(..head.len())?.fill(0xFF);
        let lowest = |bytes: [u8; MAX_DELIMITER]| u64::from_le_bytes(bytes) as u32 & 0xFFFF;
        let (short, short_mask) = match head.len() {
            0..=2 => (lowest(bytes), lowest(mask)),
            _ => (u32::MAX, u32::MAX),
        };
        Some(Self { bytes, mask, short, short_mask, len: head.len() as u8 })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.bytes.get(..self.len()).unwrap_or(&[])
    }

    pub(super) const fn len(&self) -> usize {
        self.len as usize
    }

    /// The head in eight bytes, zeros behind it.
    pub(super) const fn padded(&self) -> [u8; MAX_DELIMITER] {
        self.bytes
    }

    /// Whether eight bytes begin with the head.
    #[inline]
    pub(super) fn is(&self, front: &[u8; MAX_DELIMITER]) -> bool {
        same(front, &self.bytes, &self.mask)
    }

    /// Whether `data` begins with the head. `false` for some data that does, too: for a single byte, and for fewer than
    /// eight if the head has more than two.
    #[inline(always)]
    pub(super) fn begins(&self, data: &[u8]) -> bool {
        match (data.first_chunk(), data.first_chunk()) {
            (Some(front), _) => self.is(front),
            (None, Some(&two)) => (u32::from(u16::from_le_bytes(two)) ^ self.short) & self.short_mask == 0,
            (None, None) => false,
        }
    }

    /// Whether the lowest `seen` of eight bytes, 1 to the head's length, are the beginning of the head.
    #[inline(always)]
    pub(super) fn may_be(&self, bytes: u64, seen: usize) -> bool {
        let unseen = 64_u32.wrapping_sub(8_u32.wrapping_mul(seen as u32));
        (bytes ^ u64::from_le_bytes(self.bytes)).wrapping_shl(unseen) == 0
    }

    /// Whether `data` begins with the head, or is the beginning of it.
    #[inline]
    pub(super) fn agrees(&self, data: &[u8]) -> bool {
        match data.first_chunk() {
            Some(front) => self.is(front),
            None => self.bytes().iter().zip(data).all(|(a, b)| a == b),
        }
    }

    /// Number of bytes at the front of `data`, which does not begin with a head, before one. All but the last seven if
    /// none begins before these.
    #[inline(always)]
    pub(super) fn find_behind(&self, data: &[u8]) -> usize {
        let behind = data.get(1..).unwrap_or(&[]);
        let begins = |window: &[u8]| window.first_chunk().is_some_and(|front| self.is(front));
        match behind.windows(MAX_DELIMITER).position(begins) {
            Some(at) => at.wrapping_add(1),
            None => data.len().saturating_sub(MAX_DELIMITER.wrapping_sub(1)),
        }
    }

    /// Number of bytes at the front of fewer than eight that cannot begin a frame.
    #[inline]
    pub(super) fn find_in_few(&self, data: &[u8]) -> usize {
        let (head, mask) = (u64::from_le_bytes(self.bytes), u64::from_le_bytes(self.mask));
        let (mut rest, mut left) = (few(data), data.len());
        // Of as many bytes as are left; none at all agree with any head.
        let mut there = !u64::MAX.wrapping_shl(8_u32.wrapping_mul(left as u32));
        while left > 0 && (rest ^ head) & mask & there != 0 {
            rest = rest.wrapping_shr(8);
            there = there.wrapping_shr(8);
            left = left.wrapping_sub(1);
        }
        data.len().wrapping_sub(left)
    }
}

/// Fewer than eight bytes as one number, the first in its lowest bits.
#[inline(always)]
fn few(data: &[u8]) -> u64 {
    let place = |behind: usize| 8_u32.wrapping_mul(data.len().wrapping_sub(behind) as u32);
    // Two halves, which overlap in the middle.
    if let (Some(front), Some(back)) = (data.first_chunk(), data.last_chunk()) {
        let (front, back) = (u32::from_le_bytes(*front), u32::from_le_bytes(*back));
        return u64::from(front) | u64::from(back).wrapping_shl(place(4));
    }
    if let (Some(front), Some(back)) = (data.first_chunk(), data.last_chunk()) {
        let (front, back) = (u16::from_le_bytes(*front), u16::from_le_bytes(*back));
        return u64::from(front) | u64::from(back).wrapping_shl(place(2));
    }
    data.first().copied().unwrap_or_default().into()
}

impl Tail {
    /// `None` when there are more than 8 bytes.
    pub(super) fn new(tail: &[u8]) -> Option<Self> {
        let (mut bytes, mut mask) = ([0; MAX_DELIMITER], [0; MAX_DELIMITER]);
        let unused = MAX_DELIMITER.checked_sub(tail.len())?;
        bytes.get_mut(unused..)?.copy_from_slice(tail);
        mask.get_mut(unused..)?.fill(0xFF);
        Some(Self { bytes, mask, len: tail.len() as u8 })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.bytes.get(MAX_DELIMITER.saturating_sub(self.len())..).unwrap_or(&[])
    }

    pub(super) const fn len(&self) -> usize {
        self.len as usize
    }

    /// The tail in eight bytes, zeros before it.
    pub(super) const fn padded(&self) -> [u8; MAX_DELIMITER] {
        self.bytes
    }

    /// Whether eight bytes end with the tail.
    #[inline]
    pub(super) fn is(&self, back: &[u8; MAX_DELIMITER]) -> bool {
        same(back, &self.bytes, &self.mask)
    }

    /// Whether `frame` ends with the tail.
    #[inline]
    pub(super) fn ends(&self, frame: &[u8]) -> bool {
        match frame.last_chunk() {
            Some(back) => self.is(back),
            None => frame.ends_with(self.bytes()),
        }
    }
}
