//! The variables in the state packet of port 2001 (docs/wire/state.md section 5): read one by one, or all outputs at
//! once into the process image.
//!
//! The variable table has the places on both sides. Words and floats that are adjacent on both sides are copied at
//! once.

mod places;

use places::{COPIES, PACKS};

use super::{IMAGE_BYTES, SysVar};
use crate::wire::scalar::Scalar;
use crate::wire::state::StateView;

impl StateView<'_> {
    /// Writes every output variable in the packet to the image (docs/wire/state.md section 5); the others keep their
    /// values.
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

    /// The value of a variable in the packet; for an input, its present value. `None` if the packet does not have the
    /// variable.
    ///
    /// Bits of a byte variable are packed lowest first (D13) and masked (D22); a bool byte other than 0 counts as 1.
    pub fn read_var(&self, var: SysVar) -> Option<Scalar> {
        let place = var.stream()?;
        let bytes = self.as_bytes().get(usize::from(place.offset)..)?;
        if var.is_bits() {
            Some(Scalar::Byte(pack(bytes.first_chunk()?) & var.valid_bits()))
        } else {
            Scalar::decode(var.ty(), bytes)
        }
    }
}

/// Packs eight bool bytes into one byte, the first in the least significant bit (D13). Values other than 0 count as 1.
fn pack(bools: &[u8; 8]) -> u8 {
    const LOW_SEVEN: u64 = 0x7F7F_7F7F_7F7F_7F7F;
    // Moves bit 0 of byte n to bit 56 + n; the products do not overlap, so there are no carries.
    const GATHER: u64 = 0x0102_0408_1020_4080;
    let bytes = u64::from_le_bytes(*bools);
    let high = (bytes & LOW_SEVEN).wrapping_add(LOW_SEVEN) | bytes;
    let ones = (high & !LOW_SEVEN) >> 7;
    (ones.wrapping_mul(GATHER) >> 56) as u8
}

#[cfg(test)]
mod tests;
