//! The clock of the tests, which only tests advance.

use std::sync::{Mutex, MutexGuard, PoisonError};

use embassy_time::{Duration, MockDriver};

/// The only clock, for one test at a time; it starts at 0.
pub(crate) struct TestClock(#[allow(dead_code, reason = "held")] MutexGuard<'static, ()>);

impl TestClock {
    /// Waits until no other test uses it.
    pub(crate) fn take() -> Self {
        static CLOCK: Mutex<()> = Mutex::new(());
        let held = CLOCK.lock().unwrap_or_else(PoisonError::into_inner);
        MockDriver::get().reset();
        Self(held)
    }
}

pub(crate) fn advance(by: Duration) {
    MockDriver::get().advance(by);
}
