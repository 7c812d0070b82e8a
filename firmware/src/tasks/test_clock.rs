//! The clock of the tests: it stands still until a test moves it.

use std::sync::{Mutex, MutexGuard, PoisonError};

use embassy_time::{Duration, MockDriver};

/// The one clock there is, for one test at a time; at 0 when it is handed over.
pub(crate) struct Clock(#[allow(dead_code, reason = "held")] MutexGuard<'static, ()>);

impl Clock {
    /// Waits until nobody has it.
    pub(crate) fn take() -> Self {
        static CLOCK: Mutex<()> = Mutex::new(());
        let held = CLOCK.lock().unwrap_or_else(PoisonError::into_inner);
        MockDriver::get().reset();
        Self(held)
    }
}

/// Time passes.
pub(crate) fn advance(by: Duration) {
    MockDriver::get().advance(by);
}
