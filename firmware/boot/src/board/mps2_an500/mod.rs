//! QEMU's `mps2-an500`: slots and store are files on the host. The chosen slot is copied to program RAM and runs there.
//! The log is on UART 3.

#[path = "../../../../src/board/mps2_an500/arguments.rs"]
mod arguments;
#[path = "../../../../src/board/mps2_an500/console.rs"]
mod console;
#[path = "../../../../src/board/mps2_an500/host_flash.rs"]
mod host_flash;
#[path = "../../../../src/board/mps2_an500/registers.rs"]
#[allow(dead_code, reason = "the firmware uses more devices")]
mod registers;
mod watchdog;

use core::fmt;

use recipe_store::{FlashWord, WORD};
pub(crate) use recipe_update::MPS2_AN500 as BOARD;
use recipe_update::{Chosen, IMAGE_OFFSET, Slot, SlotFlash};

use arguments::FileName;
pub(crate) use host_flash::HostFlash as Area;

/// Starts the watchdog and the console, before any flash is read.
pub(crate) fn start() {
    watchdog::start();
    console::start();
}

/// The slots, A first.
///
/// # Safety
/// Must be called at most once. (Required by the other board; the signature is common to both.)
pub(crate) unsafe fn slots() -> Option<[Area; 2]> {
    let open = |slot: Slot| {
        let name = FileName::argument(SLOTS)?;
        Area::open(&name, BOARD.slot_offset(slot), BOARD.slot_sectors)
    };
    let opened = open(Slot::A).zip(open(Slot::B));
    if opened.is_none() {
        say(format_args!("the file of the slots, the sixth semihosting argument, cannot be opened"));
    }
    opened.map(<[Area; 2]>::from)
}

/// The place for the store.
///
/// # Safety
/// Must be called at most once. (Required by the other board; the signature is common to both.)
pub(crate) unsafe fn stores() -> Option<(Area, Option<Area>)> {
    let store = Area::open(&FileName::argument(STORE)?, 0, STORE_SECTORS)?;
    Some((store, None))
}

pub(crate) fn say(line: fmt::Arguments<'_>) {
    console::print(format_args!("loader: {line}\r\n"));
}

/// Copies the chosen image to its address; returns the address of its vector table.
pub(crate) fn load(chosen: &Chosen, slots: &[Area; 2]) -> Option<u32> {
    let [a, b] = slots;
    let slot = match chosen.slot {
        Slot::A => a,
        Slot::B => b,
    };
    let start = BOARD.slot(chosen.slot).checked_add(IMAGE_OFFSET)?;
    let words = BOARD.sector.checked_div(WORD as u32)?;
    let first = IMAGE_OFFSET.checked_div(WORD as u32)?;
    for nth in 0..chosen.header.length().div_ceil(WORD as u32) {
        let word = first.checked_add(nth)?;
        let sector = u8::try_from(word.checked_div(words)?).ok()?;
        let place = FlashWord { sector, word: u16::try_from(word.checked_rem(words)?).ok()? };
        let bytes = slot.whole(place)?;
        let address = start.checked_add(nth.checked_mul(WORD as u32)?)?;
        // SAFETY: the address is in program RAM, within the slot: the check of the header ensured that the image fits
        // into this slot. The loader itself is located before the slots, and nothing else uses their RAM.
        unsafe { core::ptr::with_exposed_provenance_mut::<[u8; WORD]>(address as usize).write(bytes) }
    }
    let trial = if chosen.is_trial { " on trial" } else { "" };
    say(format_args!("slot {:?} runs{trial}, version {}", chosen.slot, chosen.header.version()));
    Some(start)
}

/// Feeds the watchdog before the jump to the firmware. The watchdog keeps running: a firmware that hangs before its
/// first feed is reset, and has used up one start of its trial.
pub(crate) fn leave() {
    watchdog::feed();
}

/// Reports that no slot can run, and waits forever.
pub(crate) fn nothing_runs() -> ! {
    say(format_args!("no slot holds a firmware that can run"));
    loop {
        // The watchdog's interrupt wakes the core.
        cortex_m::asm::wfi();
        watchdog::feed();
    }
}

/// Indices of the semihosting arguments with the names of the files. The firmware uses the same indices.
const STORE: usize = 3;
const SLOTS: usize = 5;
const STORE_SECTORS: u8 = 2;
