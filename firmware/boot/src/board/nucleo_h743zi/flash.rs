//! The flash of slots and stores. RM0433, "Embedded Flash memory".
//!
//! If power is cut during a write, the word may be left without a valid error correction code. Reading such a torn word
//! causes a bus fault, so each word is first read once with bus faults ignored. Writing to the bank that the loader
//! runs from stalls the core, which does not matter here.

use core::sync::atomic::{Ordering, fence};

use recipe_store::{Flash, FlashWord, Geometry, Side, WORD, Word};
use recipe_update::{NUCLEO_H743ZI as BOARD, NUCLEO_H743ZI_STORES as STORES, Slot, SlotFlash};

use super::readable::can_read;
use super::register::Register;
use super::watchdog;

/// A slot or a place for the store.
pub(crate) struct Area {
    /// Address of each sector.
    sectors: [u32; 5],
    count: u8,
}

impl Area {
    /// # Safety
    /// No other `Area` of this slot may exist.
    pub(crate) unsafe fn slot(slot: Slot) -> Self {
        let start = BOARD.slot(slot);
        let sectors = [0, 1, 2, 3, 4].map(|nth: u32| start.saturating_add(nth.saturating_mul(BOARD.sector)));
        Self { sectors, count: BOARD.slot_sectors }
    }

    /// # Safety
    /// No other `Area` of this place may exist.
    pub(crate) unsafe fn store(side: Side) -> Self {
        let [first, second] = STORES.sectors(side);
        Self { sectors: [first, second, second, second, second], count: 2 }
    }

    /// Address of a word. A sector that does not exist is replaced by the first one.
    fn address(&self, FlashWord { sector, word }: FlashWord) -> usize {
        let [first, ..] = self.sectors;
        let start = self.sectors.get(usize::from(sector)).copied().unwrap_or(first);
        start as usize + WORD * usize::from(word)
    }
}

const _: () = assert!(BOARD.slot_sectors == 5);

impl SlotFlash for Area {
    fn whole(&self, place: FlashWord) -> Option<Word> {
        let address = self.address(place);
        // SAFETY: the address is that of an aligned word of flash. `can_read` has just found it readable, and nothing
        // writes to it in between, because the loader has only one thread of execution.
        can_read(address)
            .then(|| unsafe { core::ptr::with_exposed_provenance::<Word>(address).read_volatile() })
    }
}

impl Flash for Area {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: self.count, words: (BOARD.sector / WORD as u32) as u16 }
    }

    fn read(&self, place: FlashWord) -> Word {
        self.whole(place).unwrap_or([0; WORD])
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        let address = self.address(place);
        let bank = FlashBank::of(address);
        bank.unlock();
        bank.control(FASTEST | PROGRAM);
        barrier();
        let start = core::ptr::with_exposed_provenance_mut::<u32>(address);
        for (nth, part) in word.as_chunks().0.iter().enumerate() {
            // SAFETY: `nth` is below 8, so the address is within one flash word of this area. No other `Area` of
            // this flash exists (see `slot` and `store`), and its bank was unlocked for programming above.
            unsafe { start.add(nth).write_volatile(u32::from_le_bytes(*part)) }
        }
        barrier();
        bank.finish();
    }

    async fn erase(&mut self, sector: u8) {
        let address = self.address(FlashWord { sector, word: 0 });
        let bank = FlashBank::of(address);
        let number = (address as u32 % BANK) / BOARD.sector;
        bank.unlock();
        let control = FASTEST | ERASE_SECTOR | number << 8;
        bank.control(control);
        bank.control(control | BEGIN);
        barrier();
        bank.finish();
    }
}

/// The registers of one of the two banks.
struct FlashBank {
    keys: Register,
    control: Register,
    status: Register,
    clear: Register,
}

impl FlashBank {
    fn of(address: usize) -> Self {
        let base = FLASH_REGISTERS + if address as u32 & BANK == 0 { 0 } else { 0x100 };
        // SAFETY: the offsets below are 32-bit registers of the flash interface. Reading them has no effect, and only
        // this module writes to them.
        let at = |offset: usize| unsafe { Register::at(base + offset) };
        Self { keys: at(0x04), control: at(0x0C), status: at(0x10), clear: at(0x14) }
    }

    fn unlock(&self) {
        watchdog::feed();
        if self.control.read() & LOCK != 0 {
            KEYS.into_iter().for_each(|key| self.keys.write(key));
        }
        // Error flags left by reading a torn word would block the operation.
        self.clear.write(ALL_FLAGS);
    }

    fn control(&self, value: u32) {
        self.control.write(value);
    }

    /// Waits until the bank is ready, then locks it. If it never is, the watchdog resets the board. A failed operation
    /// is found when the word is read back.
    fn finish(&self) {
        while self.status.read() & BUSY != 0 {}
        self.clear.write(ALL_FLAGS);
        self.control.write(FASTEST | LOCK);
    }
}

fn barrier() {
    fence(Ordering::SeqCst);
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}

const FLASH_REGISTERS: usize = 0x5200_2000;
/// Size of a bank, and the address bit that selects the second bank.
const BANK: u32 = 0x10_0000;
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// Clears all flags of a bank.
const ALL_FLAGS: u32 = 0x0FEF_0000;
const LOCK: u32 = 1;
const PROGRAM: u32 = 1 << 1;
const ERASE_SECTOR: u32 = 1 << 2;
/// Parallelism of programming: 64 bits, which the supply of 3.3 V allows.
const FASTEST: u32 = 3 << 4;
const BEGIN: u32 = 1 << 7;
const BUSY: u32 = 1 | 1 << 2;
