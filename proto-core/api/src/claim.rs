//! Who may give a board its key: whoever presses its button first.
//!
//! In: presses of the button, claims, the result of writing the key. Out: whether a claim is accepted. A board without
//! a key works, but accepts one only within [`WINDOW`] of a press. Does not know the button, or where keys are stored.

use proto_core::time::{Duration, Instant};

/// How long after a press the board accepts a key.
pub const WINDOW: Duration = Duration::from_secs(60);

/// Whether there is a key, or may be one soon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Claim {
    /// There is no key, and none is accepted.
    Unclaimed,
    /// There is no key, and one is accepted until the end of the window.
    Open {
        /// The end of the window.
        until: Instant,
    },
    /// A key was accepted and is being written. Until it is written, the board has none.
    Writing {
        /// The end of the window, for another attempt if the key cannot be written.
        until: Instant,
    },
    /// There is a key.
    Claimed,
}

/// Why a key is not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ClaimError {
    /// The button was not pressed within the last minute.
    NotPressed,
    /// Another claim is being written.
    Busy,
    /// There is a key already.
    Claimed,
}

impl Claim {
    /// The state at the start.
    pub const fn at_start(has_key: bool) -> Self {
        if has_key { Self::Claimed } else { Self::Unclaimed }
    }

    /// The button was pressed. A press while the window is open restarts the window.
    pub fn pressed(&mut self, now: Instant) {
        if let Self::Unclaimed | Self::Open { .. } = self {
            *self = Self::Open { until: now + WINDOW };
        }
    }

    /// A client offers a key. If it is accepted, the driver writes it and then calls [`Claim::written`].
    pub fn offered(&mut self, now: Instant) -> Result<(), ClaimError> {
        self.poll(now);
        match *self {
            Self::Unclaimed => Err(ClaimError::NotPressed),
            Self::Writing { .. } => Err(ClaimError::Busy),
            Self::Claimed => Err(ClaimError::Claimed),
            Self::Open { until } => {
                *self = Self::Writing { until };
                Ok(())
            }
        }
    }

    /// The accepted key was written, or could not be.
    pub fn written(&mut self, now: Instant, is_written: bool) {
        if let Self::Writing { until } = *self {
            *self = if is_written { Self::Claimed } else { Self::Open { until } };
            self.poll(now);
        }
    }

    /// Ends the window when its time has come.
    pub fn poll(&mut self, now: Instant) {
        if let Self::Open { until } = *self
            && now >= until
        {
            *self = Self::Unclaimed;
        }
    }

    /// When to call [`Claim::poll`].
    pub const fn deadline(&self) -> Instant {
        match *self {
            Self::Open { until } => until,
            _ => Instant::NEVER,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Instant {
        Instant::ZERO + Duration::from_secs(seconds)
    }

    #[test]
    fn a_key_is_taken_once_within_a_minute_of_the_press() {
        let mut claim = Claim::at_start(false);
        assert_eq!(claim.offered(at(0)), Err(ClaimError::NotPressed));
        claim.pressed(at(1));
        assert_eq!(claim.deadline(), at(61));
        assert_eq!(claim.offered(at(61)), Err(ClaimError::NotPressed));
        claim.pressed(at(70));
        claim.pressed(at(100));
        assert_eq!(claim.offered(at(159)), Ok(()));
        assert_eq!(claim.offered(at(159)), Err(ClaimError::Busy));
        claim.written(at(159), true);
        claim.pressed(at(160));
        assert_eq!(claim.offered(at(160)), Err(ClaimError::Claimed));
        assert_eq!(claim.deadline(), Instant::NEVER);
    }

    #[test]
    fn a_key_that_cannot_be_written_can_be_offered_again_in_the_same_minute() {
        let mut claim = Claim::at_start(false);
        claim.pressed(at(0));
        claim.offered(at(1)).unwrap();
        // A press meanwhile does not extend the window.
        claim.pressed(at(2));
        claim.written(at(3), false);
        assert_eq!(claim, Claim::Open { until: at(60) });
        claim.offered(at(4)).unwrap();
        claim.written(at(60), false);
        assert_eq!(claim, Claim::Unclaimed);
    }

    #[test]
    fn a_board_with_a_key_takes_no_other() {
        let mut claim = Claim::at_start(true);
        claim.pressed(at(0));
        assert_eq!(claim.offered(at(0)), Err(ClaimError::Claimed));
    }
}
