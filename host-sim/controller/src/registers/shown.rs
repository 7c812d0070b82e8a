//! A cache of the encoded holding registers, valid while no register changes.

use super::bank::WORDS;

#[derive(Debug, Clone)]
pub(super) struct ShownWords {
    words: [[u8; 2]; WORDS],
    /// Whether the words equal the registers.
    are_current: bool,
    /// Reads since a register changed, counted up to a limit.
    reads: u8,
}

impl Default for ShownWords {
    fn default() -> Self {
        Self { words: [[0; 2]; WORDS], are_current: false, reads: 0 }
    }
}

impl ShownWords {
    /// All registers; `None` if they must be read one by one.
    pub(super) fn get(&self) -> Option<&[[u8; 2]; WORDS]> {
        self.are_current.then_some(&self.words)
    }

    /// A register may have changed.
    pub(super) fn forget(&mut self) {
        (self.are_current, self.reads) = (false, 0);
    }

    /// Counts a read. True once the registers are to be cached: not at the first reads, because of clients that read a
    /// few registers after each change.
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
