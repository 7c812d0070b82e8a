//! Periods on a fixed grid: they keep their phase, never burst, and count missed deadlines.
//!
//! In: the present instant. Out: whether a deadline is due, and how many were missed. Does not know what is done in
//! each period.

use crate::time::{Duration, Instant};

/// A period with an absolute grid: the n-th deadline is `start + n * period`, however late it is served.
#[derive(Debug, Clone, Copy)]
pub struct Grid {
    next: Instant,
    period: Duration,
}

impl Grid {
    /// Shortest period of a grid; shorter ones are raised to it.
    pub const SHORTEST: Duration = Duration::from_micros(1);

    /// A grid whose first deadline is `first`.
    pub const fn starting_at(first: Instant, period: Duration) -> Self {
        let period = if period.as_micros() == 0 { Self::SHORTEST } else { period };
        Self { next: first, period }
    }

    /// The next deadline.
    pub const fn next(&self) -> Instant {
        self.next
    }

    /// The period.
    pub const fn period(&self) -> Duration {
        self.period
    }

    /// If a deadline is due, moves to the first one after `now` and returns how many others were missed.
    pub fn due(&mut self, now: Instant) -> Option<u64> {
        if now < self.next {
            return None;
        }
        let late = now.saturating_since(self.next).as_micros();
        // `period` is at least 1 µs: see `starting_at`.
        let missed = late.checked_div(self.period.as_micros()).unwrap_or(0);
        self.next += self.period.saturating_mul(missed.saturating_add(1));
        Some(missed)
    }
}

/// Whether a peer answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum Presence {
    /// Not asked yet.
    Unknown,
    /// Answered when last asked.
    Up,
    /// Did not answer when last asked.
    Down,
}

impl Presence {
    /// Its name in statistics: `unknown`, `up` or `down`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Up => "up",
            Self::Down => "down",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: fn(u64) -> Instant = Instant::from_millis;

    #[test]
    fn a_late_service_keeps_phase_and_counts_what_it_missed() {
        let mut grid = Grid::starting_at(MS(4), Duration::from_millis(4));
        assert_eq!(grid.due(MS(3)), None);
        assert_eq!(grid.due(MS(4)), Some(0));
        assert_eq!(grid.due(MS(4)), None, "served once");
        assert_eq!(grid.due(MS(9)), Some(0), "1 ms late");
        assert_eq!(grid.next(), MS(12), "and still on the grid");
        assert_eq!(grid.due(MS(25)), Some(3), "12 is late, 16, 20 and 24 were missed");
        assert_eq!(grid.next(), MS(28));
    }

    #[test]
    fn a_period_of_zero_does_not_stand_still() {
        let mut grid = Grid::starting_at(Instant::ZERO, Duration::ZERO);
        assert!(grid.due(MS(1)).is_some());
        assert!(grid.next() > MS(1));
    }
}
