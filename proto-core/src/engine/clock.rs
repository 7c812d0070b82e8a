//! What every call looks at: the present, when the engine has to be called again, and what is to be asked then.

use super::io::Output;
use crate::time::{Duration, Instant};

/// If two calls of the engine are further apart than this, the gateway was asleep: stopped,
/// suspended, or in a debugger.
pub const ASLEEP: Duration = Duration::from_millis(500);

/// The engine asks to be called at least this often, even if it has nothing to do, so that it
/// notices sleep.
pub(super) const HEARTBEAT: Duration = Duration::from_millis(250);

/// After sleep, input from the field is discarded for this long, and until the next tick: drivers
/// read what waits in devices in pieces.
pub(super) const AFTER_SLEEP: Duration = Duration::from_millis(50);

/// The clock's last instant. [`Instant::NEVER`] is after it, so that "no deadline" never comes.
const LAST: Instant = Instant::from_micros(u64::MAX - 1);

/// What every call looks at. In one place, because an engine is so large that the address of each of
/// its fields is worked out anew.
#[derive(Debug, Clone)]
pub(super) struct Clock {
    /// Nothing but partial frames depends on the clock before this. It may be earlier than needed, never later.
    pub timer_at: Instant,
    /// No partial frame ends by silence before this; the same. On a busy line it passes often and finds that more bytes
    /// have come.
    pub partial_at: Instant,
    /// The newest instant of a call.
    pub now: Instant,
    /// A deadline has come and its tick has not been reported. Expired data may still wait, so
    /// nothing is sent before that tick.
    pub is_overdue: bool,
    /// The instant of the newest [`Output::Sleep`]; it stays while its tick is not reported.
    pub announced: Instant,
    /// The engine asks to be called by then, because calls further apart than [`ASLEEP`] mean
    /// sleep.
    pub beat_at: Instant,
    /// Number of times that the gateway slept.
    pub sleeps: u32,
    /// Input from field ports is discarded, because it waited while the gateway slept.
    pub has_slept: bool,
    pub slept_until: Instant,
    /// What [`Engine::poll_output`] asks before it sleeps.
    pub dirty: Dirty,
    /// The engine sleeps, as announced, until then, and the newest call was before: what sets no deadline, and asks
    /// nobody, leaves everything as it is. [`Instant::ZERO`] if that is not known.
    pub idle_until: Instant,
}

impl Clock {
    /// Before the first call, which asks every port and link, because `timer_at` has come.
    pub(super) const START: Self = Self {
        timer_at: Instant::ZERO,
        partial_at: Instant::ZERO,
        now: Instant::ZERO,
        is_overdue: false,
        announced: Instant::ZERO,
        beat_at: Instant::ZERO,
        sleeps: 0,
        has_slept: false,
        slept_until: Instant::ZERO,
        dirty: Dirty::NONE,
        idle_until: Instant::ZERO,
    };
}

impl Clock {
    /// Whether an input at `now` finds the engine asleep, and no deadline or beat has come.
    pub(super) fn is_idle(&self, now: Instant) -> bool {
        now >= self.now && now < self.idle_until
    }

    /// The same of an engine without ports, too, which is not called at every beat.
    pub(super) fn is_asleep(&self, now: Instant) -> bool {
        self.is_idle(now) && now < self.beat_at
    }

    /// Whether a call at `now` finds nothing to do, and the timer is right.
    pub(super) fn is_quiet(&self, now: Instant) -> bool {
        self.dirty == Dirty::ARMED && now.max(self.now) < self.timer_at
    }

    /// A tick came before anything was due: the engine sleeps on, as long as it may by now.
    pub(super) fn announce_anew(&mut self, has_ports: bool) {
        let until = self.next_call(has_ports);
        (self.announced, self.idle_until) = (until, until);
    }

    /// Something depends on the clock from `at` on. If it is due already, it is handled before the
    /// engine sleeps, or at the tick that is late.
    pub(super) fn arm(&mut self, at: Instant) {
        if at > self.now {
            self.timer_at = self.timer_at.min(at);
        }
    }

    /// The next deadline or beat; the timer is right.
    fn next_call(&self, has_ports: bool) -> Instant {
        if !has_ports {
            return self.timer_at;
        }
        self.timer_at.min(self.partial_at).min(self.beat_at)
    }

    /// Until the next deadline or beat; the timer is right.
    pub(super) fn sleep<'b>(&mut self, has_ports: bool) -> Output<'b> {
        let until = self.next_call(has_ports);
        if until == Instant::NEVER {
            return Output::Sleep { until };
        }
        let until = self.announced.min(until);
        self.announced = until;
        if self.dirty == Dirty::ARMED && self.now < until && !self.has_slept {
            self.idle_until = until;
        }
        Output::Sleep { until }
    }

    /// `now`, but no earlier than the previous call, and no later than the clock's last instant.
    pub(super) fn forward(&self, now: Instant) -> Instant {
        if now < self.now || now > LAST { self.clamped(now) } else { now }
    }

    fn clamped(&self, now: Instant) -> Instant {
        now.min(LAST).max(self.now)
    }
}

/// What has to be asked: ports and links that may have an output, and the timer. One that had no output is not
/// asked again until something happens to it, a deadline comes, or the next beat.
// As bits, so that one comparison tells that there is nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Dirty(u8);

impl Dirty {
    pub(super) const NONE: Self = Self(0);
    /// Links that may send; the command link is only asked with the others.
    pub(super) const LINKS: Self = Self(1 | 16 | 32);
    /// Recipe links that may send.
    pub(super) const RECIPES: Self = Self(16);
    /// The Modbus link, which may send.
    pub(super) const MODBUS: Self = Self(32);
    /// Links that may be opened or closed.
    pub(super) const ACTIONS: Self = Self(2);
    /// Ports that may send.
    pub(super) const PORTS: Self = Self(4);
    /// Not to be asked: `timer_at` was computed since the clock was last checked.
    // This way round, because an engine without a configuration is all zeros, which take no flash.
    pub(super) const ARMED: Self = Self(8);
    /// All ports and links.
    pub(super) const ALL: Self = Self(Self::LINKS.0 | 2 | 4);

    /// Whether it is to be asked.
    pub(super) const fn has(self, what: Self) -> bool {
        self.0 & what.0 != 0
    }

    /// It is to be asked, too.
    pub(super) const fn add(&mut self, what: Self) {
        self.0 |= what.0;
    }

    /// It was asked.
    pub(super) const fn remove(&mut self, what: Self) {
        self.0 &= !what.0;
    }

    /// The same, if it is.
    pub(super) const fn when(self, wanted: bool) -> Self {
        if wanted { self } else { Self::NONE }
    }
}
