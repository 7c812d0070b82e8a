//! How many instructions a block of the program has: time is counted in them.

use super::{Board, FLASH};
use crate::unicorn::Engine;

impl Board {
    /// How many instructions a block has.
    pub(super) fn count(&mut self, core: Engine, address: u32, len: u32) -> u64 {
        let place = address.wrapping_sub(FLASH) as usize / 2;
        if let Some(&(known, count)) = self.blocks.get(place)
            && u32::from(known) == len
        {
            return count.into();
        }
        let mut bytes = vec![0; len as usize];
        core.read(address, &mut bytes);
        let mut halves = bytes.chunks_exact(2).map(|half| u16::from_le_bytes([half[0], half[1]]));
        // `b .`, with nothing before it but what does nothing.
        let last = bytes.rchunks_exact(2).next().map_or(0, |half| u16::from_le_bytes([half[0], half[1]]));
        let back = 2 * (bytes.len() as u16 / 2 - 1) + 4;
        let is_for_ever = last == 0xE000 | (0x800 - back / 2) & 0x7FF
            && halves.clone().rev().skip(1).all(|half| half == NOP);
        let mut count = if is_for_ever { FOR_EVER } else { 0 };
        while let Some(half) = halves.next().filter(|_| !is_for_ever) {
            // Three of the 32 groups have a second half (Armv7-M ARM A5.1).
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
/// In the place of a block's number of instructions: it jumps to itself.
pub(super) const FOR_EVER: u16 = u16::MAX;
