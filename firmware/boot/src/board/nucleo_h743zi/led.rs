//! LD3, the red LED, at PB14. It blinks if no slot can run.

use super::register::Register;
use super::watchdog;

// SAFETY: the address of RCC_AHB4ENR, a 32-bit register; reading it has no effect. Only this module of the loader
// writes to it, and the firmware does not run yet.
const CLOCKS: Register = unsafe { Register::at(0x5802_44E0) };
// SAFETY: the address of GPIOB_MODER, a 32-bit register; reading it has no effect, and only this module writes to it.
const MODE: Register = unsafe { Register::at(0x5802_0400) };
// SAFETY: the address of GPIOB_BSRR, a 32-bit register; reading it has no effect, and only this module writes to it.
const SET: Register = unsafe { Register::at(0x5802_0418) };

const GPIOB: u32 = 1 << 1;
const PIN: u32 = 14;
const OUTPUT: u32 = 1;
/// Delay in cycles: at least a quarter of a second at 64 MHz.
const QUARTER: u32 = 16_000_000;

/// Blinks once or twice a second forever: only a debug probe can recover the board.
pub(crate) fn blink() -> ! {
    CLOCKS.write(CLOCKS.read() | GPIOB);
    // Enabling the clock takes two cycles.
    CLOCKS.read();
    MODE.write(MODE.read() & !(3 << (2 * PIN)) | OUTPUT << (2 * PIN));
    loop {
        for level in [PIN, PIN + 16] {
            SET.write(1 << level);
            watchdog::feed();
            cortex_m::asm::delay(QUARTER);
        }
    }
}
