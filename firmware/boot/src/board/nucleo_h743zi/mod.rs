//! The NUCLEO-H743ZI2: slots and stores in the chip's flash, a slot runs where it is, and there is no log.

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

/// Runs before anything is read.
pub(crate) fn start() {
    watchdog::start();
    if let Some(mut core) = cortex_m::Peripherals::take() {
        // After a reset flash has seven wait states.
        core.SCB.enable_icache();
    }
}

/// The slots, A first.
///
/// # Safety
/// To be called once.
pub(crate) unsafe fn slots() -> Option<[Area; 2]> {
    // SAFETY: each area is made once, and they do not overlap (a test of the layout).
    Some(Slot::ALL.map(|slot| unsafe { Area::slot(slot) }))
}

/// The places for the store.
///
/// # Safety
/// To be called once.
pub(crate) unsafe fn stores() -> Option<(Area, Option<Area>)> {
    // SAFETY: each place is made once; places and slots do not overlap (a test of the layout).
    let [first, second] = [Side::First, Side::Second].map(|side| unsafe { Area::store(side) });
    Some((first, Some(second)))
}

/// No log: the marks say what became of a trial.
pub(crate) fn say(_: fmt::Arguments<'_>) {}

/// The address of the vector table of what was chosen.
pub(crate) fn load(chosen: &Chosen, _: &[Area; 2]) -> Option<u32> {
    Some(BOARD.slot(chosen.slot).saturating_add(IMAGE_OFFSET))
}

/// Prepares for the firmware. The watchdog keeps running: a firmware that hangs before it feeds it has used a start.
pub(crate) fn leave() {
    watchdog::feed();
    // SAFETY: nothing else of the loader uses the core peripherals, and it ends here.
    unsafe { cortex_m::Peripherals::steal() }.SCB.disable_icache();
}
