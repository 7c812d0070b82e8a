//! How often a peer's doing is worth a line of the log.

use std::cell::Cell;

use proto_core::time::{Duration, Instant};

/// Lets the first few of a stretch of time through and counts the others.
#[derive(Debug, Default)]
pub struct Quota {
    since: Cell<Instant>,
    passed: Cell<u32>,
    held_back: Cell<u64>,
}

impl Quota {
    /// Whether this one passes; if so, how many were held back since the one before.
    pub fn take(&self, now: Instant) -> Option<u64> {
        if now.saturating_since(self.since.get()) >= STRETCH {
            self.since.set(now);
            self.passed.set(0);
        }
        if self.passed.get() == MOST {
            self.held_back.set(self.held_back.get() + 1);
            return None;
        }
        self.passed.set(self.passed.get() + 1);
        Some(self.held_back.take())
    }
}

const STRETCH: Duration = Duration::from_secs(10);
const MOST: u32 = 5;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_few_pass_and_the_first_later_one_tells_of_the_others() {
        let quota = Quota::default();
        let at = |seconds| Instant::ZERO + Duration::from_secs(seconds);
        for _ in 0..MOST {
            assert_eq!(quota.take(at(100)), Some(0));
        }
        for second in 100..110 {
            assert_eq!(quota.take(at(second)), None);
        }
        assert_eq!(quota.take(at(110)), Some(10));
        assert_eq!(quota.take(at(110)), Some(0));
    }
}
