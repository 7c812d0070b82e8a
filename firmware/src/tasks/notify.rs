//! A notification for one waiter on the same executor.

use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::signal::Signal;

/// A notification. It stays set until a task waits for it; several notifications count as one.
pub(crate) struct Notify(Signal<NoopRawMutex, ()>);

impl Notify {
    pub(crate) const fn new() -> Self {
        Self(Signal::new())
    }

    pub(crate) fn notify(&self) {
        self.0.signal(());
    }

    /// Waits for the next notification and consumes it.
    pub(crate) async fn notified(&self) {
        self.0.wait().await;
    }
}
