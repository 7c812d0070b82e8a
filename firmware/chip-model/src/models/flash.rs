//! The flash interface and its memory. RM0433, "Embedded Flash memory".
//!
//! A flash word has 32 bytes and an ECC. It is programmed as a whole, and only once after its sector (128 KiB) was
//! erased. If it is programmed twice or interrupted, the ECC does not match, and reading it is a bus fault. An
//! interrupted one may also be readable and half programmed, or look blank and become torn when it is programmed
//! ([`Torn`]).
//! Refused: wrong keys, writes with LOCK set or without PG, incomplete flash words, register changes while the
//! bank is busy, and too few wait states for the clock.

mod contents;

pub use contents::{Contents, FlashOperation};

use crate::device::*;

const ACR: u32 = 0x00;
// Registers of bank 1; those of bank 2 are SECOND_BANK above.
const KEYR: u32 = 0x04;
const CR: u32 = 0x0C;
const SR: u32 = 0x10;
const CCR: u32 = 0x14;
const SECOND_BANK: u32 = 0x100;

static REGISTERS: [Register; 10] = [
    read_write(ACR, "ACR", 0x37, 0x3F),
    command(KEYR, "KEYR1", !0),
    read_write(CR, "CR1", 0x31, 0x0FEF_07FF),
    read_only(SR, "SR1", 0),
    command(CCR, "CCR1", 0x0FEF_0000),
    read_write(SECOND_BANK + ACR, "ACR", 0x37, 0x3F),
    command(SECOND_BANK + KEYR, "KEYR2", !0),
    read_write(SECOND_BANK + CR, "CR2", 0x31, 0x0FEF_07FF),
    read_only(SECOND_BANK + SR, "SR2", 0),
    command(SECOND_BANK + CCR, "CCR2", 0x0FEF_0000),
];

const LOCK: u32 = 1;
const PG: u32 = 1 << 1;
const SER: u32 = 1 << 2;
const BER: u32 = 1 << 3;
const START: u32 = 1 << 7;
const BUSY: u32 = 1 | 1 << 2;
const EOP: u32 = 1 << 16;
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

/// Bytes of a flash word.
pub const WORD: u32 = 32;
/// Bytes of a sector.
pub const SECTOR: u32 = 0x2_0000;
const BANK: u32 = 0x10_0000;
/// Datasheet DS12110, "Flash memory programming", at a parallelism of 64 bits.
const ERASE: Picos = 1_000 * MILLI;
const PROGRAM: Picos = 100 * MICRO;

/// The state in which an interrupted operation leaves a flash word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Torn {
    /// Reading it is a bus fault.
    #[default]
    Fault,
    /// It looks blank, but is torn once it is programmed.
    Blank,
    /// Some of its bits are programmed, and it can be read.
    Half,
}

/// An operation of a bank.
#[derive(Debug, Clone, PartialEq, Eq)]
struct BankOperation {
    operation: FlashOperation,
    until: Picos,
}

#[derive(Debug, Default)]
struct Half {
    /// Number of correct keys so far.
    keys: Option<usize>,
    is_locked_out: bool,
    flags: u32,
    work: Option<BankOperation>,
    /// The write buffer: address of the flash word, its bytes, and which of them were written.
    collected: Option<(u32, [u8; 32], u32)>,
}

/// The model.
#[derive(Debug)]
pub struct Flash {
    bank: Bank,
    halves: [Half; 2],
    contents: Contents,
    /// The state in which interrupted operations leave flash words.
    pub leaves: Torn,
    /// The power fails during the operation of this number ([`Flash::operations`]).
    pub fails_during: Option<u64>,
    operations: u64,
    /// If present, records each operation when it begins.
    pub journal: Option<Vec<FlashOperation>>,
    /// Ranges that have changed since [`Flash::take_changed`].
    changed: Vec<(u32, u32)>,
    /// Number of erased sectors.
    pub erases: u64,
}

impl Flash {
    /// Flash with both banks erased.
    pub fn new() -> Self {
        Self {
            bank: Bank::new(&REGISTERS),
            halves: Default::default(),
            contents: Contents::erased(),
            leaves: Torn::Fault,
            fails_during: None,
            operations: 0,
            journal: None,
            changed: Vec::new(),
            erases: 0,
        }
    }

    /// Programs bytes without checks, like a debugger, which erases first. Torn words there become valid.
    pub fn load(&mut self, offset: u32, bytes: &[u8]) {
        self.contents.blank(offset, bytes.len() as u32);
        self.contents.put(offset, bytes);
    }

    /// The bytes of both banks.
    pub fn cells(&self) -> &[u8] {
        self.contents.cells()
    }

    /// The bytes of both banks, with the torn words.
    pub fn contents(&self) -> &Contents {
        &self.contents
    }

    /// Replaces the contents.
    #[cfg(any(test, feature = "emulator"))]
    pub(crate) fn hold(&mut self, contents: &Contents) {
        self.contents.clone_from(contents);
    }

    /// Makes the ECC of a flash word invalid.
    pub fn tear(&mut self, offset: u32) {
        self.contents.tear(offset);
    }

    /// Offsets of the flash words whose ECC does not match.
    pub fn torn(&self) -> impl Iterator<Item = u32> {
        self.contents.torn()
    }

    /// The ranges that have changed since the last call: offset and length.
    pub fn take_changed(&mut self) -> Vec<(u32, u32)> {
        std::mem::take(&mut self.changed)
    }

    /// Whether any range has changed since [`Flash::take_changed`].
    #[cfg(any(test, feature = "emulator"))]
    pub(crate) fn has_changed(&self) -> bool {
        !self.changed.is_empty()
    }

    /// Number of operations that were begun.
    pub fn operations(&self) -> u64 {
        self.operations
    }

    /// Whether the power fails now; true only once for each value of `fails_during`.
    #[cfg(any(test, feature = "emulator"))]
    pub(crate) fn has_failed(&mut self) -> bool {
        self.fails_during.take_if(|number| *number == self.operations).is_some()
    }

    /// A power failure: tears the flash word being programmed. Of the sector being erased, some words are as
    /// before, some erased, and the others torn.
    pub fn lose_power(&mut self) {
        for half in &mut self.halves {
            if let Some(BankOperation { operation, .. }) = half.work.take() {
                self.contents.interrupt(&operation, self.leaves, self.operations as u32);
            }
        }
    }

    /// Checks the wait states for this bus clock, at VOS1.
    ///
    /// # Errors
    /// There are too few.
    pub fn check_speed(&self, hclk: u32) -> Result<(), Refusal> {
        let (latency, delay) = (self.bank.get(ACR) & 0xF, self.bank.get(ACR) >> 4 & 3);
        let needed = match hclk {
            ..=70_000_000 => (0, 0),
            70_000_001..=140_000_000 => (1, 1),
            140_000_001..=185_000_000 => (2, 1),
            185_000_001..=210_000_000 => (2, 2),
            _ => (3, 2),
        };
        if latency < needed.0 || delay < needed.1 {
            return refuse(format!("{latency} wait states for {hclk} Hz; the manual asks for {}", needed.0));
        }
        Ok(())
    }

    /// A write by the program to flash memory.
    ///
    /// # Errors
    /// PG is 0, the bank is busy, or the flash word is not erased or not written as a whole.
    pub fn program(&mut self, offset: u32, bytes: &[u8], now: Picos) -> Result<(), Refusal> {
        let index = (offset / BANK) as usize;
        let control = self.bank.get(CR + SECOND_BANK * index as u32);
        let half = &mut self.halves[index];
        if control & PG == 0 {
            return refuse("flash is written while PG is 0");
        }
        if half.work.is_some() {
            return refuse("flash is written while its bank is busy");
        }
        let (word, place) = (offset & !(WORD - 1), (offset % WORD) as usize);
        let (address, mut content, mut there) = half.collected.take().unwrap_or((word, [0xFF; 32], 0));
        if address != word {
            return refuse("another flash word is written before this one is whole");
        }
        content[place..place + bytes.len()].copy_from_slice(bytes);
        for index in place..place + bytes.len() {
            there |= 1 << index;
        }
        if there != u32::MAX {
            half.collected = Some((address, content, there));
            return Ok(());
        }
        if !self.contents.takes_a_write(word) {
            return refuse("the flash word was written before; it is to be erased first");
        }
        self.begin(index, FlashOperation::Program { address: word, bytes: content }, now + PROGRAM);
        Ok(())
    }

    fn write_control(&mut self, index: usize, value: u32, now: Picos) -> Result<(), Refusal> {
        let register = CR + SECOND_BANK * index as u32;
        let before = self.bank.get(register);
        if before & LOCK != 0 {
            return refuse("the bank is locked (LOCK)");
        }
        if self.halves[index].work.is_some() {
            return refuse("the bank is busy (QW)");
        }
        self.bank.check(register, value)?;
        self.bank.set(register, value & !START);
        if value & LOCK != 0 {
            self.halves[index].keys = Some(0);
        }
        match (value & START != 0, value & (PG | SER | BER)) {
            (false, _) => Ok(()),
            (true, SER) => {
                let first = BANK * index as u32 + SECTOR * (value >> 8 & 7);
                self.begin(index, FlashOperation::Erase { first }, now + ERASE);
                Ok(())
            }
            _ => refuse("START without SER alone is not modelled"),
        }
    }

    fn unlock(&mut self, index: usize, key: u32) -> Result<(), Refusal> {
        let half = &mut self.halves[index];
        let right = half.keys.unwrap_or(0);
        if half.is_locked_out || KEYS.get(right) != Some(&key) {
            half.is_locked_out = true;
            return refuse("a wrong key: the bank stays locked until a reset");
        }
        half.keys = Some(right + 1);
        if right + 1 == KEYS.len() {
            let register = CR + SECOND_BANK * index as u32;
            self.bank.set(register, self.bank.get(register) & !LOCK);
        }
        Ok(())
    }

    fn begin(&mut self, index: usize, operation: FlashOperation, until: Picos) {
        self.halves[index].work = Some(BankOperation { operation, until });
        self.operations += 1;
        if let Some(journal) = &mut self.journal {
            journal.push(operation);
        }
    }

    fn finish(&mut self, operation: &FlashOperation) {
        self.contents.execute(operation);
        match *operation {
            FlashOperation::Erase { first } => {
                self.changed.push((first, SECTOR));
                self.erases += 1;
            }
            FlashOperation::Program { address, .. } => self.changed.push((address, WORD)),
        }
    }
}

impl Default for Flash {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Flash {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        self.advance(at)?;
        let half = &self.halves[usize::from(offset >= SECOND_BANK)];
        match offset % SECOND_BANK {
            SR => {
                let waits = u32::from(half.collected.is_some()) << 1;
                Ok(half.flags | if half.work.is_some() { BUSY } else { 0 } | waits)
            }
            KEYR | CCR => refuse("can only be written"),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        self.advance(at)?;
        let index = usize::from(offset >= SECOND_BANK);
        match offset % SECOND_BANK {
            KEYR => self.unlock(index, value),
            CR => self.write_control(index, value, at.now),
            CCR => {
                self.bank.check(offset, value)?;
                self.halves[index].flags &= !value;
                Ok(())
            }
            _ => self.bank.write(offset, value),
        }
    }

    fn advance(&mut self, at: &Context<'_>) -> Result<(), Refusal> {
        for index in 0..2 {
            if let Some(work) = self.halves[index].work.take_if(|work| at.now >= work.until) {
                self.halves[index].flags |= EOP;
                self.finish(&work.operation);
            }
        }
        Ok(())
    }

    fn deadline(&self, _: &Context<'_>) -> Option<Picos> {
        self.halves.iter().filter_map(|half| half.work.as_ref().map(|work| work.until)).min()
    }

    /// Interrupts an operation in progress.
    fn reset(&mut self) {
        self.lose_power();
        self.bank = Bank::new(&REGISTERS);
        self.halves = Default::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    static NONE: Functions = [[None; 16]; 11];

    fn at(now: Picos) -> Context<'static> {
        Context { now, clocks: Clocks::default(), functions: &NONE, is_rmii: false }
    }

    fn unlocked() -> Flash {
        let mut flash = Flash::new();
        for key in KEYS {
            flash.write(SECOND_BANK + KEYR, key, &at(0)).expect("the right keys");
        }
        flash
    }

    const CONFIG: u32 = 0x1C_0000;

    fn program(flash: &mut Flash, offset: u32, now: Picos) -> Result<(), Refusal> {
        (0..8).try_for_each(|word| flash.program(offset + 4 * word, &[word as u8; 4], now))
    }

    #[test]
    fn a_word_is_written_once() {
        let mut flash = unlocked();
        assert!(program(&mut flash, CONFIG, 0).is_err(), "PG is 0");
        flash.write(SECOND_BANK + CR, 0x32, &at(0)).expect("it is unlocked");
        program(&mut flash, CONFIG, 0).expect("it is erased");
        assert!(flash.write(SECOND_BANK + CR, 0x30, &at(MICRO)).is_err(), "it is busy");
        flash.advance(&at(PROGRAM)).expect("it is done");
        assert_eq!((flash.cells()[CONFIG as usize + 4], flash.take_changed()), (1, vec![(CONFIG, WORD)]));
        assert!(program(&mut flash, CONFIG, PROGRAM).is_err(), "a second time");
    }

    #[test]
    fn erasing_makes_a_torn_word_blank_again() {
        let mut flash = unlocked();
        flash.write(SECOND_BANK + CR, 0x32, &at(0)).expect("it is unlocked");
        program(&mut flash, CONFIG + 64, 0).expect("it is erased");
        flash.reset();
        assert_eq!(flash.torn().collect::<Vec<_>>(), [CONFIG + 64]);
        for key in KEYS {
            flash.write(SECOND_BANK + KEYR, key, &at(0)).expect("the right keys");
        }
        flash.write(SECOND_BANK + CR, 0x31 & !LOCK | SER | START | 6 << 8, &at(0)).expect("it is unlocked");
        assert_eq!(flash.deadline(&at(0)), Some(ERASE));
        flash.advance(&at(ERASE)).expect("it is done");
        assert_eq!((flash.torn().count(), flash.erases), (0, 1));
    }

    #[test]
    fn a_word_that_only_looks_blank_takes_no_write() {
        let mut flash = unlocked();
        flash.leaves = Torn::Blank;
        flash.fails_during = Some(1);
        flash.write(SECOND_BANK + CR, 0x32, &at(0)).expect("it is unlocked");
        program(&mut flash, CONFIG, 0).expect("it is erased");
        assert!(flash.has_failed() && !flash.has_failed());
        flash.reset();
        assert_eq!((flash.torn().count(), flash.cells()[CONFIG as usize]), (0, 0xFF));
        for key in KEYS {
            flash.write(SECOND_BANK + KEYR, key, &at(0)).expect("the right keys");
        }
        flash.write(SECOND_BANK + CR, 0x32, &at(0)).expect("it is unlocked");
        program(&mut flash, CONFIG, 0).expect("it looks blank");
        flash.advance(&at(PROGRAM)).expect("it is done");
        assert_eq!(flash.torn().collect::<Vec<_>>(), [CONFIG]);
    }

    #[test]
    fn an_interrupted_erase_leaves_words_of_every_kind() {
        let mut flash = unlocked();
        flash.load(CONFIG, &[0x11; SECTOR as usize]);
        flash.write(SECOND_BANK + CR, 0x31 & !LOCK | SER | START | 6 << 8, &at(0)).expect("it is unlocked");
        flash.reset();
        let words = flash.cells()[CONFIG as usize..].chunks(WORD as usize).take(4_096);
        let blank = words.filter(|word| word.iter().all(|byte| *byte == 0xFF)).count();
        assert!((500..2_000).contains(&blank) && (1_500..2_500).contains(&flash.torn().count()), "{blank}");
    }

    #[test]
    fn a_wrong_key_locks_until_a_reset() {
        let mut flash = Flash::new();
        assert!(flash.write(KEYR, KEYS[1], &at(0)).is_err());
        assert!(flash.write(KEYR, KEYS[0], &at(0)).is_err());
        assert!(flash.write(CR, 0x32, &at(0)).is_err());
    }

    #[test]
    fn a_word_in_pieces_is_refused() {
        let mut flash = unlocked();
        flash.write(SECOND_BANK + CR, 0x32, &at(0)).expect("it is unlocked");
        flash.program(CONFIG, &[0; 4], 0).expect("the first of eight");
        assert!(flash.program(CONFIG + 32, &[0; 4], 0).is_err(), "the next before it is whole");
    }
}
