//! The NUCLEO-H743ZI2: slots and stores are in the chip's flash, and a slot runs in place. There is no log.

mod flash;
mod led;
#[path = "../../../../src/board/nucleo_h743zi/readable.rs"]
mod readable;
mod register;
mod watchdog;

use core::fmt;

use recipe_store::Side;
pub(crate) use recipe_update::NUCLEO_H743ZI as BOARD;
use recipe_update::{Chosen, IMAGE_OFFSET, Slot};

pub(crate) use flash::Area;
pub(crate) use led::blink as nothing_runs;

/// Starts the watchdog and the instruction cache, before the slots are read.
pub(crate) fn start() {
    watchdog::start();
    if let Some(mut core) = cortex_m::Peripherals::take() {
        // Speeds up execution from flash, which has seven wait states after a reset.
        core.SCB.enable_icache();
    }
}

/// The slots, A first.
///
/// # Safety
/// Must be called at most once.
pub(crate) unsafe fn slots() -> Option<[Area; 2]> {
    // SAFETY: the caller calls this once, so each slot gets one `Area`. A test of the layout checks that slots and
    // stores do not overlap.
    Some(Slot::ALL.map(|slot| unsafe { Area::slot(slot) }))
}

/// The places for the store.
///
/// # Safety
/// Must be called at most once.
pub(crate) unsafe fn stores() -> Option<(Area, Option<Area>)> {
    // SAFETY: the caller calls this once, so each place gets one `Area`. A test of the layout checks that slots and
    // stores do not overlap.
    let [first, second] = [Side::First, Side::Second].map(|side| unsafe { Area::store(side) });
    Some((first, Some(second)))
}

/// Does nothing, because there is no log: how a trial ended is recorded in the marks.
pub(crate) fn say(_: fmt::Arguments<'_>) {}

/// The address of the vector table of the chosen image, which runs in place.
pub(crate) fn load(chosen: &Chosen, _: &[Area; 2]) -> Option<u32> {
    Some(BOARD.slot(chosen.slot).saturating_add(IMAGE_OFFSET))
}

/// Prepares the jump to the firmware. The watchdog keeps running: a firmware that hangs before its first feed is reset,
/// and has used up one start of its trial.
pub(crate) fn leave() {
    watchdog::feed();
    // SAFETY: the handle that `start` took has been dropped, and nothing else in the loader uses the core peripherals.
    unsafe { cortex_m::Peripherals::steal() }.SCB.disable_icache();
}
