//! The flash of the stores and of the slots. RM0433, "Embedded Flash memory".
//!
//! Only the bank that the program does not run from is written, so the program continues while a sector is erased. A
//! store that another firmware has left in the program's bank is only read.
//!
//! The driver of `embassy-stm32` is not used, because it would copy torn flash words, which causes a bus fault.

use core::future::Future;
use core::pin::pin;
use core::sync::atomic::{Ordering, fence};
use core::task::{Context, Poll, Waker};

use embassy_stm32::pac::FLASH;
use embassy_stm32::pac::flash::regs::{Ccr, Cr};
use embassy_time::{Duration, Instant, Timer};
use firmware::stored::{StoreFlash, StorePlaces};
use firmware::update::{Site, Slots};
use recipe_store::{FlashWord, FoundRecord, Geometry, Side, WORD, Word};
use recipe_update::{NUCLEO_H743ZI as BOARD, NUCLEO_H743ZI_STORES as STORES, Slot, SlotFlash, Stores};

use super::super::slot::running;
use super::readable::can_read;
use super::storage::FLASH_WORD;

const _: () = assert!(FLASH_WORD == WORD);

const FLASH_START: usize = 0x0800_0000;
const BANK_SIZE: usize = 0x10_0000;
/// Address of the public key in the loader, which is preceded by this mark (firmware/boot/loader.x).
const KEY: usize = FLASH_START + 0x400;
const KEY_MARK: [u8; 4] = *b"RGUK";
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// Clears all flags of a bank.
const ALL_FLAGS: Ccr = Ccr(0x0FEF_0000);
/// Parallelism of programming: 64 bits, which the supply of 3.3 V allows.
const FASTEST: u8 = 3;
// Datasheet DS12110, "Flash memory programming": an erase takes at most 2 s, a write 0.4 ms.
const ERASE: Wait = Wait { look: Duration::from_millis(2), limit: Duration::from_secs(4) };
const WRITE: Wait = Wait { look: Duration::from_micros(100), limit: Duration::from_millis(10) };

/// Polling interval and limit of an operation.
struct Wait {
    look: Duration,
    limit: Duration,
}

/// A place for the store, or a slot.
#[derive(Debug)]
pub(crate) struct Area {
    /// Address of each sector.
    sectors: [u32; 5],
    count: u8,
}

const _: () = assert!(BOARD.slot_sectors == 5);

/// The places for the store.
///
/// # Safety
/// Must be called at most once: nothing else may write to the flash of an [`Area`].
pub(super) unsafe fn stores() -> StorePlaces<Area> {
    let place = |side: Side| {
        let [first, second] = STORES.sectors(side);
        Area { sectors: [first, second, second, second, second], count: 2 }
    };
    let first = place(Side::First);
    match running() {
        Some(slot) => StorePlaces { first, second: Some(place(Side::Second)), own: Stores::of(slot) },
        // Without a loader the program runs from the beginning of the first bank, and slot A may still contain a
        // firmware that does not run.
        None => StorePlaces { first, second: None, own: Side::First },
    }
}

/// The slots.
///
/// # Safety
/// Must be called at most once: nothing else may write to the flash of an [`Area`].
pub(super) unsafe fn slots() -> Site<Area> {
    let slots = match (running(), key()) {
        (Some(running), Some(key)) => {
            let area = |slot: Slot| {
                let start = BOARD.slot(slot);
                let sectors = [0, 1, 2, 3, 4].map(|nth: u32| start + nth * BOARD.sector);
                Area { sectors, count: BOARD.slot_sectors }
            };
            Ok(Slots { running, key, own: area(running), free: area(running.other()) })
        }
        (Some(_), None) => Err("there is no loader with a key at the beginning of the flash"),
        (None, _) => {
            Err("this firmware was linked for the beginning of the flash, where the loader would be")
        }
    };
    Site { board: BOARD.board, slots }
}

/// The public key in the loader; `None` if there is no mark or the flash cannot be read.
fn key() -> Option<[u8; 32]> {
    let mut bytes = [0; 2 * WORD];
    for (part, address) in bytes.as_chunks_mut::<WORD>().0.iter_mut().zip((KEY..).step_by(WORD)) {
        if !can_read(address) {
            return None;
        }
        // SAFETY: an aligned flash word in the sector of the loader. It was just found readable, and this program never
        // writes to that sector.
        *part = unsafe { core::ptr::with_exposed_provenance::<Word>(address).read_volatile() };
    }
    bytes.strip_prefix(&KEY_MARK)?.first_chunk().copied()
}

impl Area {
    /// Address of a word. A sector that does not exist is replaced by the first one.
    fn address(&self, FlashWord { sector, word }: FlashWord) -> usize {
        let [first, ..] = self.sectors;
        let start = self.sectors.get(usize::from(sector)).copied().unwrap_or(first);
        start as usize + WORD * usize::from(word)
    }
}

/// Index of the bank that contains this address, and index of the sector in that bank, as the registers count them.
fn bank_and_sector(address: usize) -> (usize, u8) {
    let offset = address - FLASH_START;
    (offset / BANK_SIZE, (offset % BANK_SIZE / BOARD.sector as usize) as u8)
}

fn unlock(bank: usize) {
    let bank = FLASH.bank(bank);
    if bank.cr().read().lock() {
        KEYS.into_iter().for_each(|key| bank.keyr().write_value(key));
    }
    // Error flags of an earlier operation or of reading a torn word would block this one.
    bank.ccr().write_value(ALL_FLAGS);
}

/// Waits until the bank is ready, then locks it. An operation that does not end in time is found when the word is read
/// back.
async fn finish(bank: usize, wait: Wait) {
    let begun = Instant::now();
    loop {
        let state = FLASH.bank(bank).sr().read();
        if !state.bsy() && !state.qw() || begun.elapsed() > wait.limit {
            break;
        }
        Timer::after(wait.look).await;
    }
    FLASH.bank(bank).ccr().write_value(ALL_FLAGS);
    FLASH.bank(bank).cr().write(|w| {
        w.set_psize(FASTEST);
        w.set_lock(true);
    });
}

impl SlotFlash for Area {
    fn whole(&self, place: FlashWord) -> Option<Word> {
        let address = self.address(place);
        // SAFETY: the address is that of an aligned flash word of this area, just found readable. Only this area writes
        // to it, for which it is borrowed mutably.
        can_read(address)
            .then(|| unsafe { core::ptr::with_exposed_provenance::<Word>(address).read_volatile() })
    }
}

impl recipe_store::Flash for Area {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: self.count, words: (BOARD.sector / WORD as u32) as u16 }
    }

    fn read(&self, place: FlashWord) -> Word {
        self.whole(place).unwrap_or([0; WORD])
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        let address = self.address(place);
        let (bank, _) = bank_and_sector(address);
        unlock(bank);
        let mut control = Cr(0);
        control.set_psize(FASTEST);
        control.set_pg(true);
        FLASH.bank(bank).cr().write_value(control);
        barrier();
        let start = core::ptr::with_exposed_provenance_mut::<u32>(address);
        for (index, part) in word.as_chunks().0.iter().enumerate() {
            // SAFETY: `index` is below 8, so the address is within one flash word of this area. No other `Area` of this
            // flash exists (see `stores` and `slots`), and its bank was unlocked for programming above.
            unsafe { start.add(index).write_volatile(u32::from_le_bytes(*part)) }
        }
        barrier();
        finish(bank, WRITE).await;
    }

    async fn erase(&mut self, sector: u8) {
        let (bank, number) = bank_and_sector(self.address(FlashWord { sector, word: 0 }));
        unlock(bank);
        let mut control = Cr(0);
        control.set_psize(FASTEST);
        control.set_ser(true);
        control.set_snb(number);
        FLASH.bank(bank).cr().write_value(control);
        control.set_start(true);
        FLASH.bank(bank).cr().write_value(control);
        barrier();
        finish(bank, ERASE).await;
    }
}

impl StoreFlash for Area {
    fn bytes(&mut self, found: FoundRecord) -> Option<&[u8]> {
        let start = self.address(found.data);
        // SAFETY: a record is contiguous, because it is within one sector. It does not change while it is borrowed,
        // because writing takes `&mut self`. All its words are readable: each was read when the store was opened, or
        // was written and read back since.
        Some(unsafe { core::slice::from_raw_parts(core::ptr::with_exposed_provenance(start), found.len) })
    }
}

fn barrier() {
    fence(Ordering::SeqCst);
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}

/// Waits for `operation` without an executor. The clock's alarm wakes the core.
pub(super) fn block_on<T>(operation: impl Future<Output = T>, mut feed: impl FnMut()) -> T {
    let mut operation = pin!(operation);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        feed();
        if let Poll::Ready(result) = operation.as_mut().poll(&mut context) {
            return result;
        }
        // An alarm that occurs just before this instruction is not missed: the return from its interrupt sets the event
        // that ends WFE.
        cortex_m::asm::wfe();
    }
}
