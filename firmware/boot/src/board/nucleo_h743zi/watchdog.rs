//! The independent watchdog. RM0433, "Independent watchdog".
//!
//! It runs from the first instruction on, also over the start of the firmware: a firmware on trial that hangs before
//! it has a watchdog of its own comes to an end too.

use super::register::Register;

// SAFETY: registers of IWDG1, which the loader alone uses.
const KEY: Register = unsafe { Register::at(0x5800_4800) };
// SAFETY: as above.
const PRESCALER: Register = unsafe { Register::at(0x5800_4804) };
// SAFETY: as above.
const STATUS: Register = unsafe { Register::at(0x5800_480C) };

const START: u32 = 0xCCCC;
const FEED: u32 = 0xAAAA;
const UNLOCK: u32 = 0x5555;
/// Cycles of LSI divided by 64: with the reload of a reset, 4096, that is 8.2 s.
const BY_64: u32 = 4;

/// Starts it, with 8 s until the reset.
pub(crate) fn start() {
    KEY.write(START);
    KEY.write(UNLOCK);
    PRESCALER.write(BY_64);
    // The firmware writes it too, and may not before this was taken. It takes five cycles of LSI, and is looked for
    // a thousand times as long: without LSI there is no watchdog, and a firmware all the same.
    for _ in 0..LOOKS {
        if STATUS.read() == 0 {
            break;
        }
    }
    feed();
}

/// Begins its time anew.
pub(crate) fn feed() {
    KEY.write(FEED);
}

const LOOKS: u32 = 1_000_000;
