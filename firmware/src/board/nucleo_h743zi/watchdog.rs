//! The independent watchdog: it has its own clock, so it also restarts a board whose clock stopped.

use embassy_stm32::pac::DBGMCU;
use embassy_stm32::peripherals::IWDG1;
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_time::Duration;

/// Without being fed for so long, the board starts again.
pub(crate) const WATCHDOG_PERIOD: Duration = Duration::from_secs(4);

/// The watchdog; it cannot be stopped.
pub(crate) struct Watchdog(IndependentWatchdog<'static, IWDG1>);

impl Watchdog {
    /// Starts it.
    pub(super) fn start() -> Self {
        // A debugger that halts the core halts it too.
        DBGMCU.apb4fzr1().modify(|w| w.set_iwdg1(true));
        // SAFETY: called once; nobody else has it.
        let device = unsafe { IWDG1::steal() };
        let mut watchdog = IndependentWatchdog::new(device, WATCHDOG_PERIOD.as_micros() as u32);
        watchdog.unleash();
        Self(watchdog)
    }

    /// Another period.
    pub(crate) fn feed(&mut self) {
        self.0.pet();
    }
}
