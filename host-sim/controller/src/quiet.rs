//! When [`Controller::advance`] can be skipped: nothing changes until the next input or deadline.
//!
//! Most calls are Modbus requests that only read from an idle controller, where [`Controller::advance`] has nothing to
//! do.

use proto_core::time::Instant;

use super::Controller;

/// The end of the time in which [`Controller::advance`] has nothing to do. Other changes must call [`Self::ends`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Quiet {
    until: Instant,
    /// The value of [`Controller::deadline`] until then.
    deadline: Instant,
    /// False in a test that compares the controller with one that always advances.
    #[cfg(test)]
    allowed: bool,
}

impl Default for Quiet {
    fn default() -> Self {
        Self {
            until: Instant::ZERO,
            deadline: Instant::NEVER,
            #[cfg(test)]
            allowed: true,
        }
    }
}

impl Quiet {
    /// Whether nothing is due at `now`.
    pub(super) fn lasts(&self, now: Instant) -> bool {
        now < self.until
    }

    /// The controller's deadline, if it is known without computing it.
    pub(super) fn deadline(&self, now: Instant) -> Option<Instant> {
        self.lasts(now).then_some(self.deadline)
    }

    /// Something has changed the controller.
    pub(super) fn ends(&mut self) {
        self.until = Instant::ZERO;
    }

    fn begins(&mut self, until: Instant, deadline: Instant) {
        #[cfg(test)]
        let until = if self.allowed { until } else { Instant::ZERO };
        (self.until, self.deadline) = (until, deadline);
    }

    #[cfg(test)]
    pub(super) fn forbid(&mut self) {
        *self = Self { allowed: false, ..Self::default() };
    }
}

impl Controller {
    /// Records that nothing is left to do, and until when. Returns the deadline.
    pub(super) fn rest(&mut self) -> Instant {
        let deadline = self.deadline();
        // A program may wait for more than an instant.
        let until = match self.running {
            Some(_) => Instant::ZERO,
            // Without clients, the state stream has no deadline but its grid continues.
            None => deadline.min(self.state_grid.next()).min(self.next_arm_state()),
        };
        self.quiet.begins(until, deadline);
        deadline
    }
}
