//! The flash of the store: three sectors of the second bank, of which the program runs in the first, so it goes
//! on while a sector is erased. RM0433, "Embedded Flash memory".
//!
//! Not by the driver of `embassy-stm32`: that one copies from flash words that a power cut has torn, which is a
//! bus fault.

use core::future::Future;
use core::pin::pin;
use core::sync::atomic::{Ordering, fence};
use core::task::{Context, Poll, Waker};

use embassy_stm32::pac::FLASH;
use embassy_stm32::pac::flash::regs::{Ccr, Cr};
use embassy_time::{Duration, Instant, Timer};
use firmware::kept::StoreFlash;
use recipe_store::{Found, Geometry, Place, WORD, Word};

use super::storage::{FLASH_WORD, can_read};

unsafe extern "C" {
    static _store_start: u8;
    static _store_rest: u8;
}

const _: () = assert!(FLASH_WORD == WORD);

/// Size of a sector in bytes.
const SECTOR: usize = 128 * 1024;
const SECOND_BANK: usize = 0x0810_0000;
/// Index of the second bank in the registers.
const BANK: usize = 1;
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// Clears all flags of a bank.
const ALL_FLAGS: Ccr = Ccr(0x0FEF_0000);
/// 64 bits at a time: the supply is 3.3 V.
const FASTEST: u8 = 3;
// Datasheet DS12110, "Flash memory programming": at most 2 s, and 0.4 ms.
const ERASE: Wait = Wait { look: Duration::from_millis(2), limit: Duration::from_secs(4) };
const WRITE: Wait = Wait { look: Duration::from_micros(100), limit: Duration::from_millis(10) };

/// How often to look whether the bank is done, and when to give up.
struct Wait {
    look: Duration,
    limit: Duration,
}

/// The sectors of the store; nothing else writes flash.
pub(crate) struct Flash(());

impl Flash {
    /// # Safety
    /// There is only one.
    pub(super) unsafe fn new() -> Self {
        Self(())
    }
}

/// Address of a word.
fn address(Place { sector, word }: Place) -> usize {
    let start = match sector {
        0 | 1 => (&raw const _store_start).addr() + SECTOR * usize::from(sector),
        _ => (&raw const _store_rest).addr(),
    };
    start + WORD * usize::from(word)
}

fn unlock() {
    let bank = FLASH.bank(BANK);
    if bank.cr().read().lock() {
        KEYS.into_iter().for_each(|key| bank.keyr().write_value(key));
    }
    // Flags of an earlier operation, or of reading a torn word, would refuse this one.
    bank.ccr().write_value(ALL_FLAGS);
}

/// Waits for the bank, then locks it. If it does not end in time, what was written is missing when it is read.
async fn finish(wait: Wait) {
    let begun = Instant::now();
    loop {
        let state = FLASH.bank(BANK).sr().read();
        if !state.bsy() && !state.qw() || begun.elapsed() > wait.limit {
            break;
        }
        Timer::after(wait.look).await;
    }
    FLASH.bank(BANK).ccr().write_value(ALL_FLAGS);
    FLASH.bank(BANK).cr().write(|w| {
        w.set_psize(FASTEST);
        w.set_lock(true);
    });
}

impl recipe_store::Flash for Flash {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 3, words: (SECTOR / WORD) as u16 }
    }

    fn read(&self, place: Place) -> Word {
        let address = address(place);
        if !can_read(address) {
            return [0; WORD];
        }
        // SAFETY: a word of the store in flash, which is readable, and written by nobody else.
        unsafe { core::ptr::with_exposed_provenance::<Word>(address).read_volatile() }
    }

    async fn write(&mut self, place: Place, word: &Word) {
        unlock();
        let mut control = Cr(0);
        control.set_psize(FASTEST);
        control.set_pg(true);
        FLASH.bank(BANK).cr().write_value(control);
        barrier();
        let start = core::ptr::with_exposed_provenance_mut::<u32>(address(place));
        for (index, part) in word.as_chunks().0.iter().enumerate() {
            // SAFETY: within the word, in flash that is the store's alone; the bank is unlocked for it.
            unsafe { start.add(index).write_volatile(u32::from_le_bytes(*part)) }
        }
        barrier();
        finish(WRITE).await;
    }

    async fn erase(&mut self, sector: u8) {
        unlock();
        let number = (address(Place { sector, word: 0 }) - SECOND_BANK) / SECTOR;
        let mut control = Cr(0);
        control.set_psize(FASTEST);
        control.set_ser(true);
        control.set_snb(number as u8);
        FLASH.bank(BANK).cr().write_value(control);
        control.set_start(true);
        FLASH.bank(BANK).cr().write_value(control);
        barrier();
        finish(ERASE).await;
    }
}

impl StoreFlash for Flash {
    fn bytes(&mut self, found: Found) -> Option<&[u8]> {
        let start = address(found.data);
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
