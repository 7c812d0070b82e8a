//! The independent watchdog: it has its own clock, so it also restarts a board whose clock stopped.
//!
//! It gives no warning. The system timer looks after it instead, and keeps the name of the task that has
//! the processor for the next start when half of the period has gone by without a feed.

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use embassy_stm32::pac::iwdg::vals::Key;
use embassy_stm32::pac::{DBGMCU, IWDG1 as IWDG1_REGISTERS};
use embassy_stm32::peripherals::IWDG1;
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_time::{Duration, Instant};
use firmware::platform::Feed;

use super::last_words;

/// Without being fed for so long, the board starts again.
pub(super) const PERIOD: Duration = Duration::from_secs(4);

/// The watchdog; it cannot be stopped.
pub(crate) struct Watchdog(IndependentWatchdog<'static, IWDG1>);

impl Watchdog {
    /// Starts it.
    pub(super) fn start() -> Self {
        // A debugger that halts the core halts it too.
        DBGMCU.apb4fzr1().modify(|w| w.set_iwdg1(true));
        // SAFETY: called once; nobody else has it.
        let device = unsafe { IWDG1::steal() };
        let mut watchdog = IndependentWatchdog::new(device, PERIOD.as_micros() as u32);
        watchdog.unleash();
        Self(watchdog)
    }

    /// Starts it where nothing else can be relied on, such as in a fault that comes before the start: with
    /// its shortest divider it bites after half a second. One that runs goes on as it does.
    pub(super) fn start_anyhow() {
        IWDG1_REGISTERS.kr().write(|w| w.set_key(Key::START));
    }
}

impl Feed for Watchdog {
    fn feed(&mut self) {
        self.0.pet();
        FED.store(millis(), Ordering::Relaxed);
        if IS_LATE.swap(false, Ordering::Relaxed) {
            last_words::forget();
        }
    }
}

/// Looks after it from now on, twelve times a second. Only once there is a time.
pub(super) fn look_after(timer: &mut SYST) {
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
    // Once: a reset in the middle of it would leave nothing.
    if is_late && !IS_LATE.swap(true, Ordering::Relaxed) {
        last_words::keep_hang();
    }
}

fn millis() -> u32 {
    Instant::now().as_millis() as u32
}

/// When it was fed last, in milliseconds.
static FED: AtomicU32 = AtomicU32::new(0);
/// A hang is kept that may not be one.
static IS_LATE: AtomicBool = AtomicBool::new(false);
/// Cycles of an eighth of the core's clock, from one look to the next.
const EIGHTHS: u32 = 4_000_000;
