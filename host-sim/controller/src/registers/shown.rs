//! The holding registers as the wire has them, kept while none of them changes.

use super::bank::WORDS;

/// The holding registers as they were read.
#[derive(Debug, Clone)]
pub(super) struct ShownWords {
    words: [[u8; 2]; WORDS],
    /// They are as the registers are now.
    are_current: bool,
    /// Reads since a register changed, as far as they are counted.
    reads: u8,
}

impl Default for ShownWords {
    fn default() -> Self {
        Self { words: [[0; 2]; WORDS], are_current: false, reads: 0 }
    }
}

impl ShownWords {
    /// All of them; `None` if they have to be asked for one by one.
    pub(super) fn get(&self) -> Option<&[[u8; 2]; WORDS]> {
        self.are_current.then_some(&self.words)
    }

    /// A register may have changed.
    pub(super) fn forget(&mut self) {
        (self.are_current, self.reads) = (false, 0);
    }

    /// Counts a read. True if it is time to [`Self::keep`] the registers: not yet at the first ones, because of clients
    /// that read a few registers each time that they change.
    pub(super) fn is_worth_keeping(&mut self) -> bool {
        if self.are_current {
            return false;
        }
        self.reads += 1;
        self.reads >= READS
    }

    pub(super) fn keep(&mut self, words: [[u8; 2]; WORDS]) {
        (self.words, self.are_current) = (words, true);
    }
}

/// Number of reads without a change after which the encoded registers are cached.
const READS: u8 = 4;
