//! The contents of flash: its bytes, and the words whose true state after a power cut is not visible in their bytes.
//!
//! In: operations, complete or interrupted. Out: the contents after them. The contents at any time can thus be restored
//! from a record of the operations before it.

use std::collections::BTreeSet;

use super::{BANK, SECTOR, Torn, WORD};

/// The contents of both banks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Contents {
    cells: Vec<u8>,
    /// Offsets of the flash words whose ECC does not match.
    torn: BTreeSet<u32>,
    /// Offsets of the flash words that only look blank ([`Torn::Blank`]).
    only_looks_blank: BTreeSet<u32>,
}

/// An operation that changes flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FlashOperation {
    /// A sector is erased.
    Erase {
        /// Offset of its first word.
        first: u32,
    },
    /// A word is programmed.
    Program {
        /// Its offset.
        address: u32,
        /// The new bytes.
        bytes: [u8; WORD as usize],
    },
}

impl Contents {
    /// Contents with everything erased.
    pub fn erased() -> Self {
        let cells = vec![0xFF; 2 * BANK as usize];
        Self { cells, torn: BTreeSet::new(), only_looks_blank: BTreeSet::new() }
    }

    /// The bytes.
    pub fn cells(&self) -> &[u8] {
        &self.cells
    }

    /// Offsets of the flash words whose ECC does not match.
    pub fn torn(&self) -> impl Iterator<Item = u32> {
        self.torn.iter().copied()
    }

    /// Executes an operation completely.
    pub fn execute(&mut self, operation: &FlashOperation) {
        match *operation {
            FlashOperation::Erase { first } => self.blank(first, SECTOR),
            FlashOperation::Program { address, bytes } => {
                if self.only_looks_blank.remove(&address) {
                    self.torn.insert(address);
                }
                self.put(address, &bytes);
            }
        }
    }

    /// The power fails during an operation. Of a sector that was being erased, some words are as before, some erased,
    /// and the others as `leaves` says; which ones depends on `salt`.
    pub fn interrupt(&mut self, operation: &FlashOperation, leaves: Torn, salt: u32) {
        match operation {
            FlashOperation::Program { address, bytes } => self.interrupt_word(*address, bytes, leaves),
            FlashOperation::Erase { first } => {
                for address in (*first..first + SECTOR).step_by(WORD as usize) {
                    // Neighbouring words differ, and each power cut differs from the previous one.
                    match (address / WORD).wrapping_add(salt).wrapping_mul(0x9E37_79B9) >> 30 {
                        0 => {}
                        1 => self.blank(address, WORD),
                        _ => self.interrupt_word(address, &[0xFF; WORD as usize], leaves),
                    }
                }
            }
        }
    }

    /// Interrupts the programming of a word that would have become `bytes`.
    fn interrupt_word(&mut self, address: u32, bytes: &[u8; WORD as usize], leaves: Torn) {
        match leaves {
            Torn::Fault => _ = self.torn.insert(address),
            Torn::Blank => {
                self.blank(address, WORD);
                self.only_looks_blank.insert(address);
            }
            Torn::Half => {
                let cells = &mut self.cells[address as usize..][..WORD as usize];
                for (index, (cell, byte)) in cells.iter_mut().zip(bytes).enumerate() {
                    *cell = byte | if index % 3 == 0 { 0xA5 } else { 0 };
                }
            }
        }
    }

    /// Makes the ECC of a flash word invalid.
    pub(super) fn tear(&mut self, offset: u32) {
        self.torn.insert(offset & !(WORD - 1));
    }

    /// Whether a word can be read, and all its bits are 1.
    pub(super) fn takes_a_write(&self, word: u32) -> bool {
        let is_blank = self.cells[word as usize..][..WORD as usize].iter().all(|byte| *byte == 0xFF);
        is_blank && !self.torn.contains(&word)
    }

    pub(super) fn put(&mut self, offset: u32, bytes: &[u8]) {
        self.cells[offset as usize..][..bytes.len()].copy_from_slice(bytes);
    }

    pub(super) fn blank(&mut self, first: u32, len: u32) {
        self.cells[first as usize..][..len as usize].fill(0xFF);
        self.torn.retain(|word| !(first..first + len).contains(word));
        self.only_looks_blank.retain(|word| !(first..first + len).contains(word));
    }
}
