//! The independent watchdog. RM0433, "Independent watchdog".
//!
//! The loader starts it first, and it keeps running while the firmware starts. So a firmware on trial that hangs before
//! it sets up its own watchdog is reset too.

use super::register::Register;

// SAFETY: the address of IWDG_KR, a 32-bit register; reading it has no effect, and only this module writes to it.
const KEY: Register = unsafe { Register::at(0x5800_4800) };
// SAFETY: the address of IWDG_PR, a 32-bit register; reading it has no effect, and only this module writes to it.
const PRESCALER: Register = unsafe { Register::at(0x5800_4804) };
// SAFETY: the address of IWDG_SR, a read-only 32-bit register; reading it has no effect.
const STATUS: Register = unsafe { Register::at(0x5800_480C) };

const START: u32 = 0xCCCC;
const FEED: u32 = 0xAAAA;
const UNLOCK: u32 = 0x5555;
/// Prescaler: LSI divided by 64. With the reload value after a reset, 4096, the timeout is 8.2 s.
const BY_64: u32 = 4;

/// Starts the watchdog with a timeout of 8 s.
pub(crate) fn start() {
    KEY.write(START);
    KEY.write(UNLOCK);
    PRESCALER.write(BY_64);
    // Wait until the new prescaler is in effect, because the firmware writes the register too. This takes five cycles
    // of LSI; the limit is about a thousand times as long. Without LSI the firmware runs without a watchdog.
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
