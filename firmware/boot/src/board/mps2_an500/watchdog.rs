//! The watchdog: a counter that raises a non-maskable interrupt at its first zero and resets the machine at its second.
//!
//! The loader starts it first, and it keeps running while the firmware starts. So a firmware on trial that hangs before
//! it sets up its own watchdog is reset too.

use super::registers::{WATCHDOG, write};

const LOAD: u32 = WATCHDOG;
const CONTROL: u32 = WATCHDOG + 0x8;
const INTCLEAR: u32 = WATCHDOG + 0xC;
const LOCK: u32 = WATCHDOG + 0xC00;
const UNLOCK: u32 = 0x1ACC_E551;
/// Interrupt and reset enabled.
const CONTROL_ON: u32 = 0b11;
/// Cycles of 25 MHz until the counter is zero: 4 s, as in the firmware.
const HALF: u32 = 100_000_000;

/// Starts the watchdog with a timeout of 8 s.
pub(crate) fn start() {
    write(LOCK, UNLOCK);
    write(LOAD, HALF);
    write(CONTROL, CONTROL_ON);
    write(LOCK, 0);
}

pub(crate) fn feed() {
    write(LOCK, UNLOCK);
    write(INTCLEAR, 1);
    write(LOCK, 0);
}

/// First timeout: ignored, because the emulator's host may be busy. The second one resets.
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() {}
