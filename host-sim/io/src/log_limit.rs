//! A rate limit for log lines that a peer can cause.

use std::cell::Cell;

use proto_core::time::{Duration, Instant};

/// Allows the first few lines of each interval and counts the others.
#[derive(Debug, Default)]
pub struct LogLimit {
    interval_start: Cell<Instant>,
    logged: Cell<u32>,
    suppressed: Cell<u64>,
}

impl LogLimit {
    /// `Some` if a line may be logged now, with the number of lines suppressed since the last logged line.
    pub fn allow(&self, now: Instant) -> Option<u64> {
        if now.saturating_since(self.interval_start.get()) >= INTERVAL {
            self.interval_start.set(now);
            self.logged.set(0);
        }
        if self.logged.get() == MAX_LINES {
            self.suppressed.set(self.suppressed.get() + 1);
            return None;
        }
        self.logged.set(self.logged.get() + 1);
        Some(self.suppressed.take())
    }
}

const INTERVAL: Duration = Duration::from_secs(10);
const MAX_LINES: u32 = 5;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_line_of_the_next_interval_has_the_number_of_suppressed_ones() {
        let limit = LogLimit::default();
        let at = |seconds| Instant::ZERO + Duration::from_secs(seconds);
        for _ in 0..MAX_LINES {
            assert_eq!(limit.allow(at(100)), Some(0));
        }
        for second in 100..110 {
            assert_eq!(limit.allow(at(second)), None);
        }
        assert_eq!(limit.allow(at(110)), Some(10));
        assert_eq!(limit.allow(at(110)), Some(0));
    }
}
