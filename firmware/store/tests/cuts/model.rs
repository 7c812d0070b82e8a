//! Flash as that of the STM32H743: words of 32 bytes with an error correction code, written once, and the power
//! cut during any operation.

use recipe_store::{BLANK, Flash, FlashWord, Geometry, WORD, Word};

/// What a word is like whose writing or erasing was interrupted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Torn {
    /// It cannot be read.
    Fault,
    /// It looks blank, and takes no write.
    Blank,
    /// Some of its bits are written.
    Half,
    /// Any of these, by chance.
    Mixed,
}

pub(crate) const TORN: [Torn; 4] = [Torn::Fault, Torn::Blank, Torn::Half, Torn::Mixed];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum WordState {
    Erased,
    Written,
    Fault,
    LooksBlank,
    /// Its bytes are those of `words`, and it is not to be relied on.
    Half,
}

#[derive(Debug, Clone)]
pub(crate) struct Nor {
    geometry: Geometry,
    words: Vec<Word>,
    states: Vec<WordState>,
    torn: Torn,
    /// Number of operations until the power is cut, in the one after them.
    left: Option<u32>,
    is_off: bool,
    pub(crate) erases: u32,
    pub(crate) writes: u32,
    /// Writes to words that only looked blank.
    pub(crate) refused: u32,
    may_rewrite: bool,
    /// One write of so many goes wrong, and nothing says so.
    fails_of: Option<u64>,
    seed: u64,
}

impl Nor {
    pub(crate) fn new(geometry: Geometry, torn: Torn) -> Self {
        let words = usize::from(geometry.sectors) * usize::from(geometry.words);
        Self {
            geometry,
            words: vec![BLANK; words],
            states: vec![WordState::Erased; words],
            torn,
            left: None,
            is_off: false,
            erases: 0,
            writes: 0,
            refused: 0,
            may_rewrite: false,
            fails_of: None,
            seed: 1,
        }
    }

    /// The power is cut during the operation after `left` more.
    pub(crate) fn cut_after(&mut self, left: u32, seed: u64) {
        // Neighbouring seeds begin alike otherwise.
        let mixed = (seed ^ seed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        (self.left, self.seed) = (Some(left), (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB) | 1);
    }

    /// The power is back.
    pub(crate) fn power(&mut self) {
        (self.left, self.is_off) = (None, false);
    }

    /// A word that is written twice cannot be read afterwards, and is no mistake of the test.
    pub(crate) fn allow_rewrites(&mut self) {
        self.may_rewrite = true;
    }

    /// One write of `of` goes wrong from now on.
    pub(crate) fn wear_out(&mut self, of: u64) {
        self.fails_of = Some(of);
    }

    pub(crate) fn is_off(&self) -> bool {
        self.is_off
    }

    /// Number of operations so far.
    pub(crate) fn operations(&self) -> u32 {
        self.erases + self.writes
    }

    fn chance(&mut self, of: u64) -> u64 {
        self.seed ^= self.seed << 13;
        self.seed ^= self.seed >> 7;
        self.seed ^= self.seed << 17;
        self.seed % of
    }

    /// Counts an operation; whether it is the one that the power ends in.
    fn is_cut(&mut self) -> bool {
        match &mut self.left {
            Some(0) => {
                self.is_off = true;
                true
            }
            Some(left) => {
                *left -= 1;
                false
            }
            None => false,
        }
    }

    fn tear(&mut self, at: usize, new: Word) {
        let kind = match self.torn {
            Torn::Mixed => [Torn::Fault, Torn::Blank, Torn::Half][self.chance(3) as usize],
            kind => kind,
        };
        self.states[at] = match kind {
            Torn::Fault => WordState::Fault,
            Torn::Blank => WordState::LooksBlank,
            _ => {
                for (byte, new) in (0..WORD).zip(new) {
                    let missing = self.chance(256) as u8;
                    self.words[at][byte] = new | missing;
                }
                WordState::Half
            }
        };
    }

    fn at(&self, FlashWord { sector, word }: FlashWord) -> usize {
        assert!(sector < self.geometry.sectors && word < self.geometry.words, "no such word");
        usize::from(sector) * usize::from(self.geometry.words) + usize::from(word)
    }

    /// A bit of a written word changes.
    pub(crate) fn damage(&mut self, place: FlashWord) {
        let at = self.at(place);
        self.words[at][7] ^= 0x10;
    }

    /// Reads as the chip does: `None` is a fault.
    pub(crate) fn read_or_fault(&self, place: FlashWord) -> Option<Word> {
        let at = self.at(place);
        match self.states[at] {
            WordState::Erased | WordState::LooksBlank => Some(BLANK),
            WordState::Written | WordState::Half => Some(self.words[at]),
            WordState::Fault => None,
        }
    }

    pub(crate) fn write_now(&mut self, place: FlashWord, word: &Word) {
        if self.is_off {
            return;
        }
        self.writes += 1;
        let (at, is_cut) = (self.at(place), self.is_cut());
        // A word may be whole all the same.
        let is_torn = is_cut && self.chance(8) > 0;
        let chance = self.chance(u64::MAX);
        match self.states[at] {
            WordState::Erased if is_torn => self.tear(at, *word),
            WordState::Erased if self.fails_of.is_some_and(|of| chance.is_multiple_of(of)) => {
                self.tear(at, *word)
            }
            WordState::Erased => (self.words[at], self.states[at]) = (*word, WordState::Written),
            WordState::LooksBlank => {
                self.refused += 1;
                self.states[at] = WordState::Fault;
            }
            _ if self.may_rewrite => self.states[at] = WordState::Fault,
            WordState::Written | WordState::Fault | WordState::Half => panic!("{place:?} is written twice"),
        }
    }

    pub(crate) fn erase_now(&mut self, sector: u8) {
        if self.is_off {
            return;
        }
        self.erases += 1;
        let is_cut = self.is_cut();
        for word in 0..self.geometry.words {
            let at = self.at(FlashWord { sector, word });
            match if is_cut { self.chance(4) } else { 0 } {
                0 => self.states[at] = WordState::Erased,
                1 => {}
                _ => self.tear(at, BLANK),
            }
        }
    }
}

impl Flash for Nor {
    fn geometry(&self) -> Geometry {
        self.geometry
    }

    fn read(&self, place: FlashWord) -> Word {
        self.read_or_fault(place).unwrap_or([0; WORD])
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        self.write_now(place, word);
    }

    async fn erase(&mut self, sector: u8) {
        self.erase_now(sector);
    }
}
