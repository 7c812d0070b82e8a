//! The watchdog: a counter that raises a non-maskable interrupt at its first zero and resets the machine at its
//! second. `qemu-system-arm -no-reboot` ends the emulation instead.

use embassy_time::Duration;
use firmware::platform::FeedWatchdog;

use super::console;
use super::registers::{WATCHDOG, write};

const LOAD: u32 = WATCHDOG;
const CONTROL: u32 = WATCHDOG + 0x8;
const INTCLEAR: u32 = WATCHDOG + 0xC;
const LOCK: u32 = WATCHDOG + 0xC00;
const UNLOCK: u32 = 0x1ACC_E551;
/// Interrupt and reset enabled.
const CONTROL_ON: u32 = 0b11;
const CYCLES_PER_MICRO: u64 = 25;

/// Time without a feed until the reset. Long, because the emulator's host may be busy.
pub(super) const PERIOD: Duration = Duration::from_secs(8);

#[derive(Debug)]
pub(crate) struct Watchdog;

impl Watchdog {
    pub(super) fn start() -> Self {
        write(LOCK, UNLOCK);
        write(LOAD, (PERIOD.as_micros() / 2 * CYCLES_PER_MICRO) as u32);
        write(CONTROL, CONTROL_ON);
        write(LOCK, 0);
        Self
    }
}

impl FeedWatchdog for Watchdog {
    fn feed(&mut self) {
        write(LOCK, UNLOCK);
        write(INTCLEAR, 1);
        write(LOCK, 0);
    }
}

/// First timeout: half of the period has passed.
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() {
    console::print(format_args!("the watchdog was not fed\r\n"));
    super::print_running();
}
