//! Ends a command that would run for ever: by Ctrl-C or a timeout.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Requests the end of a running command.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    asked: Arc<AtomicBool>,
    at: Option<Instant>,
}

impl Stop {
    /// A new stop without a request.
    pub fn new() -> Self {
        Self::default()
    }

    /// The same stop, but also after `time`.
    #[must_use]
    pub fn after(&self, time: Duration) -> Self {
        Self { asked: Arc::clone(&self.asked), at: Instant::now().checked_add(time) }
    }

    /// Requests the end on all clones.
    pub fn ask(&self) {
        self.asked.store(true, Relaxed);
    }

    /// Whether the command is to end.
    pub fn is_asked(&self) -> bool {
        self.was_interrupted() || self.at.is_some_and(|at| Instant::now() >= at)
    }

    /// Whether the end was requested, not only the time is over.
    pub fn was_interrupted(&self) -> bool {
        self.asked.load(Relaxed)
    }

    /// Waits for `time`; returns true early if the command is to end.
    pub fn wait(&self, time: Duration) -> bool {
        let until = Instant::now() + time;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if self.is_asked() || left.is_zero() {
                return self.is_asked();
            }
            std::thread::sleep(left.min(LOOK));
        }
    }
}

/// Interval at which a wait checks for the end.
pub(crate) const LOOK: Duration = Duration::from_millis(50);
