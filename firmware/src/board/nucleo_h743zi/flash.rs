//! The flash of the stores and of the slots. Only the bank that the program does not run from is written, so the
//! program continues while a sector is erased; a store that another firmware has left in the program's bank is only
//! read. RM0433, "Embedded Flash memory".
//!
//! Not the driver of `embassy-stm32`, which would copy torn flash words: a bus fault.

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
/// Where the loader has its public key, behind this mark (firmware/boot/loader.x).
const KEY: usize = FLASH_START + 0x400;
const KEY_MARK: [u8; 4] = *b"RGUK";
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// Clears all flags of a bank.
const ALL_FLAGS: Ccr = Ccr(0x0FEF_0000);
/// 64 bits at a time: the supply is 3.3 V.
const FASTEST: u8 = 3;
// Datasheet DS12110, "Flash memory programming": at most 2 s, and 0.4 ms.
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
/// To be called once.
pub(super) unsafe fn stores() -> StorePlaces<Area> {
    let place = |side: Side| {
        let [first, second] = STORES.sectors(side);
        Area { sectors: [first, second, second, second, second], count: 2 }
    };
    let first = place(Side::First);
    match running() {
        Some(slot) => StorePlaces { first, second: Some(place(Side::Second)), own: Stores::of(slot) },
        // Without a loader, slot A may hold a firmware, but it does not run.
        None => StorePlaces { first, second: None, own: Side::First },
    }
}

/// The slots.
///
/// # Safety
/// To be called once.
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

/// The public key of the loader.
fn key() -> Option<[u8; 32]> {
    let mut bytes = [0; 2 * WORD];
    for (part, address) in bytes.as_chunks_mut::<WORD>().0.iter_mut().zip((KEY..).step_by(WORD)) {
        if !can_read(address) {
            return None;
        }
        // SAFETY: readable flash that nothing writes.
        *part = unsafe { core::ptr::with_exposed_provenance::<Word>(address).read_volatile() };
    }
    bytes.strip_prefix(&KEY_MARK)?.first_chunk().copied()
}

impl Area {
    /// Address of a word; that of the first sector if the sector does not exist.
    fn address(&self, FlashWord { sector, word }: FlashWord) -> usize {
        let [first, ..] = self.sectors;
        let start = self.sectors.get(usize::from(sector)).copied().unwrap_or(first);
        start as usize + WORD * usize::from(word)
    }
}

/// Index of the bank of an address in the registers, and of its sector in the bank.
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

/// Waits for the bank, then locks it. An operation that does not end in time is found when the word is read back.
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
        // SAFETY: a word of this area in flash, which is readable, and written by nobody else.
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
            // SAFETY: within the word, in flash that is this area's alone; the bank is unlocked for it.
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
        // SAFETY: the record lies in one sector. It is not changed while it is borrowed: writing takes `&mut self`.
        // All its words were read when the store was opened, or written and read back since.
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
        // An alarm before this instruction is not missed: the end of an interrupt is an event.
        cortex_m::asm::wfe();
    }
}
