//! From the packet into the process image: every output variable that stands in the packet.
//!
//! Where a variable stands on both sides comes from the variable table; consecutive words and
//! floats that are consecutive on both sides are one copy.

use super::StateView;
use super::places::{COPIES, PACKS};
use crate::sysvar::IMAGE_BYTES;

impl StateView<'_> {
    /// Writes every output variable that stands in the packet (docs/wire/state.md section 5);
    /// all others keep what they have.
    pub fn copy_to_image(&self, image: &mut [u8; IMAGE_BYTES]) {
        let bytes = self.as_bytes();
        for copy in COPIES {
            let from = bytes.get(copy.from..).and_then(|bytes| bytes.get(..copy.len));
            let to = image.get_mut(copy.to..).and_then(|image| image.get_mut(..copy.len));
            if let (Some(from), Some(to)) = (from, to) {
                to.copy_from_slice(from);
            }
        }
        for bits in PACKS {
            let from = bytes.get(bits.from..).and_then(|bytes| bytes.first_chunk());
            if let (Some(from), Some(to)) = (from, image.get_mut(bits.to)) {
                *to = pack(from) & bits.mask;
            }
        }
    }
}

/// Eight bool bytes as one byte, the first in the least significant bit (D13); what is not 0
/// counts as 1.
#[inline]
pub(super) fn pack(bools: &[u8; 8]) -> u8 {
    const LOW_SEVEN: u64 = 0x7F7F_7F7F_7F7F_7F7F;
    // Places bit 0 of byte n at bit 56 + n; no two bits meet, so nothing carries.
    const GATHER: u64 = 0x0102_0408_1020_4080;
    let bytes = u64::from_le_bytes(*bools);
    let high = (bytes & LOW_SEVEN).wrapping_add(LOW_SEVEN) | bytes;
    let ones = (high & !LOW_SEVEN) >> 7;
    (ones.wrapping_mul(GATHER) >> 56) as u8
}
