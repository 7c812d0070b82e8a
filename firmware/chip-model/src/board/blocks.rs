//! Counts the instructions of a basic block: virtual time is derived from them.

use super::{Board, FLASH};
use crate::unicorn::Emulator;

impl Board {
    /// The number of instructions of a block; [`ENDLESS`] if it only jumps to itself.
    pub(super) fn count(&mut self, core: Emulator, address: u32, len: u32) -> u64 {
        let place = address.wrapping_sub(FLASH) as usize / 2;
        if let Some(&(known, count)) = self.blocks.get(place)
            && u32::from(known) == len
        {
            return count.into();
        }
        let mut bytes = vec![0; len as usize];
        core.read(address, &mut bytes);
        let mut halves = bytes.chunks_exact(2).map(|half| u16::from_le_bytes([half[0], half[1]]));
        // `b .`, with only NOPs before it.
        let last = bytes.rchunks_exact(2).next().map_or(0, |half| u16::from_le_bytes([half[0], half[1]]));
        let back = 2 * (bytes.len() as u16 / 2 - 1) + 4;
        let is_endless = last == 0xE000 | (0x800 - back / 2) & 0x7FF
            && halves.clone().rev().skip(1).all(|half| half == NOP);
        let mut count = if is_endless { ENDLESS } else { 0 };
        while let Some(half) = halves.next().filter(|_| !is_endless) {
            // These encodings have a second halfword (Armv7-M ARM A5.1).
            if half >> 11 >= 0b11101 {
                halves.next();
            }
            count += 1;
        }
        if let Some(entry) = self.blocks.get_mut(place) {
            *entry = (len as u16, count);
        }
        count.into()
    }
}

const NOP: u16 = 0xBF00;
/// Count of a block that jumps to itself.
pub(super) const ENDLESS: u16 = u16::MAX;
