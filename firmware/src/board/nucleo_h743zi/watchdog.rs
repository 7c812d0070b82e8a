//! The independent watchdog: it has its own clock, so it also resets a board whose clock stopped.
//!
//! It has no early interrupt. Instead, when half of the period has passed without a feed, the SysTick handler
//! saves the name of the running task for the next start.

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use embassy_stm32::pac::iwdg::vals::Key;
use embassy_stm32::pac::{DBGMCU, IWDG1 as IWDG1_REGISTERS};
use embassy_stm32::peripherals::IWDG1;
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_time::{Duration, Instant};
use firmware::platform::FeedWatchdog;

use super::crash_record;

/// Time without a feed until the reset.
pub(super) const PERIOD: Duration = Duration::from_secs(4);

/// The watchdog; it cannot be stopped.
pub(crate) struct Watchdog(IndependentWatchdog<'static, IWDG1>);

impl Watchdog {
    pub(super) fn start() -> Self {
        // It stops while a debugger halts the core.
        DBGMCU.apb4fzr1().modify(|w| w.set_iwdg1(true));
        // SAFETY: this is the only handle: `start` is called once, and the register accesses below only write keys,
        // which do not interfere with it.
        let device = unsafe { IWDG1::steal() };
        let mut watchdog = IndependentWatchdog::new(device, PERIOD.as_micros() as u32);
        watchdog.unleash();
        Self(watchdog)
    }

    /// Starts the watchdog if a fault occurs before it was started. With its shortest divider it resets the board
    /// after half a second.
    pub(super) fn ensure_running() {
        IWDG1_REGISTERS.kr().write(|w| w.set_key(Key::START));
    }
}

/// Feeds the watchdog while the start waits for the flash, before the task that feeds it runs.
pub(super) fn feed_during_start() {
    IWDG1_REGISTERS.kr().write(|w| w.set_key(Key::RESET));
    FED.store(millis(), Ordering::Relaxed);
}

impl FeedWatchdog for Watchdog {
    fn feed(&mut self) {
        self.0.pet();
        FED.store(millis(), Ordering::Relaxed);
        if IS_LATE.swap(false, Ordering::Relaxed) {
            crash_record::clear();
        }
    }
}

/// Starts the SysTick interrupt, twelve times a second. The clock must be running already.
pub(super) fn supervise(timer: &mut SYST) {
    FED.store(millis(), Ordering::Relaxed);
    timer.set_clock_source(SystClkSource::External);
    timer.set_reload(EIGHTHS);
    timer.clear_current();
    timer.enable_interrupt();
    timer.enable_counter();
}

#[cortex_m_rt::exception]
fn SysTick() {
    let unfed = millis().wrapping_sub(FED.load(Ordering::Relaxed));
    let is_late = u64::from(unfed) >= PERIOD.as_millis() / 2;
    // Saved only once per hang, because a reset while the record is written would destroy it.
    if is_late && !IS_LATE.swap(true, Ordering::Relaxed) {
        crash_record::save_hang();
    }
}

fn millis() -> u32 {
    Instant::now().as_millis() as u32
}

static FED: AtomicU32 = AtomicU32::new(0);
/// A hang was saved. It is cleared if the watchdog is fed after all.
static IS_LATE: AtomicBool = AtomicBool::new(false);
/// Period of the SysTick interrupt, in cycles of an eighth of the core's clock.
const EIGHTHS: u32 = 4_000_000;
