//! The independent watchdog. RM0433, "Independent watchdog".
//!
//! It runs from the first instruction of the loader on and during the start of the firmware, so a firmware on trial that
//! hangs before it sets up its own watchdog is reset too.

use super::register::Register;

// SAFETY: IWDG_KR; only this module writes it.
const KEY: Register = unsafe { Register::at(0x5800_4800) };
// SAFETY: IWDG_PR; only this module writes it.
const PRESCALER: Register = unsafe { Register::at(0x5800_4804) };
// SAFETY: IWDG_SR, read-only.
const STATUS: Register = unsafe { Register::at(0x5800_480C) };

const START: u32 = 0xCCCC;
const FEED: u32 = 0xAAAA;
const UNLOCK: u32 = 0x5555;
/// Cycles of LSI divided by 64: with the reload of a reset, 4096, that is 8.2 s.
const BY_64: u32 = 4;

/// Starts the watchdog with a timeout of 8 s.
pub(crate) fn start() {
    KEY.write(START);
    KEY.write(UNLOCK);
    PRESCALER.write(BY_64);
    // Wait until the prescaler is taken over, because the firmware writes it too. That takes five cycles of LSI; the
    // limit is about a thousand times as long. Without LSI there is no watchdog, and the firmware runs without it.
    for _ in 0..LOOKS {
        if STATUS.read() == 0 {
            break;
        }
    }
    feed();
}

pub(crate) fn feed() {
    KEY.write(FEED);
}

const LOOKS: u32 = 1_000_000;
