//! The engine's clock: the present, when the engine has to be called again, and what to check then.

use super::io::Output;
use crate::time::{Duration, Instant};

/// If two calls of the engine are further apart than this, the gateway was asleep: stopped, suspended, or in a
/// debugger.
pub const ASLEEP: Duration = Duration::from_millis(500);

/// Heartbeat: the engine asks to be called at least this often, to notice that it was asleep.
pub(super) const HEARTBEAT: Duration = Duration::from_millis(250);

/// After sleep, field input is discarded for this long and until the next tick: drivers read what waits in devices in
/// pieces.
pub(super) const AFTER_SLEEP: Duration = Duration::from_millis(50);

/// The clock's last instant. [`Instant::NEVER`] is after it, so "no deadline" is never reached.
const LAST: Instant = Instant::from_micros(u64::MAX - 1);

/// State that every call reads. It is kept together because an engine is so large that each separate field costs an
/// address computation.
#[derive(Debug, Clone)]
pub(super) struct Clock {
    /// The next deadline except those of partial frames. May be too early, never too late.
    pub timer_at: Instant,
    /// When silence ends the first partial frame. May be too early, never too late: on a busy line it often passes
    /// because more bytes have arrived.
    pub partial_at: Instant,
    /// The instant of the newest call.
    pub now: Instant,
    /// A deadline has passed whose tick has not been reported. Expired data may still wait, so nothing is sent before
    /// that tick.
    pub is_overdue: bool,
    /// The instant of the newest [`Output::Sleep`], until its tick is reported.
    pub announced: Instant,
    /// The next heartbeat: calls further apart than [`ASLEEP`] mean sleep.
    pub beat_at: Instant,
    /// How often the gateway slept.
    pub sleeps: u32,
    /// Input from field ports is discarded because it waited while the gateway slept.
    pub has_slept: bool,
    pub slept_until: Instant,
    /// What [`Engine::poll_output`] checks before it sleeps.
    pub dirty: Dirty,
    /// Until then the engine sleeps as announced: an input that sets no deadline and no dirty flag changes nothing.
    /// [`Instant::ZERO`] if unknown.
    pub idle_until: Instant,
}

impl Clock {
    /// Before the first call. `timer_at` has passed, so that call checks every port and link.
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
    /// Whether the engine is asleep at `now`: the announced deadline or heartbeat is still to come.
    pub(super) fn is_idle(&self, now: Instant) -> bool {
        now >= self.now && now < self.idle_until
    }

    /// Like [`Self::is_idle`], and no heartbeat has passed: an engine without ports may sleep beyond one.
    pub(super) fn is_asleep(&self, now: Instant) -> bool {
        self.is_idle(now) && now < self.beat_at
    }

    /// Whether a call at `now` has nothing to do and `timer_at` is up to date.
    pub(super) fn is_quiet(&self, now: Instant) -> bool {
        self.dirty == Dirty::ARMED && now.max(self.now) < self.timer_at
    }

    /// A tick came before anything was due: announces sleep again, for as long as now possible.
    pub(super) fn announce_anew(&mut self, has_ports: bool) {
        let until = self.next_call(has_ports);
        (self.announced, self.idle_until) = (until, until);
    }

    /// Adds a deadline. One that has passed is ignored: it is handled before the engine sleeps, or at the overdue tick.
    pub(super) fn arm(&mut self, at: Instant) {
        if at > self.now {
            self.timer_at = self.timer_at.min(at);
        }
    }

    /// The next deadline or heartbeat; needs an up-to-date timer.
    fn next_call(&self, has_ports: bool) -> Instant {
        if !has_ports {
            return self.timer_at;
        }
        self.timer_at.min(self.partial_at).min(self.beat_at)
    }

    /// Sleep until the next deadline or heartbeat; needs an up-to-date timer.
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

    /// `now`, but not before the previous call nor after the clock's last instant.
    pub(super) fn forward(&self, now: Instant) -> Instant {
        if now < self.now || now > LAST { self.clamped(now) } else { now }
    }

    fn clamped(&self, now: Instant) -> Instant {
        now.min(LAST).max(self.now)
    }
}

/// Flags of what to check: ports and links that may have an output, and the timer. What had no output is not checked
/// again before an event, a deadline or the next heartbeat.
// A bit set, so that one comparison shows that there is nothing to check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Dirty(u8);

impl Dirty {
    pub(super) const NONE: Self = Self(0);
    /// Links that may send; the command link is only checked together with the others.
    pub(super) const LINKS: Self = Self(1 | 16 | 32);
    pub(super) const RECIPES: Self = Self(16);
    pub(super) const MODBUS: Self = Self(32);
    /// Links that may be opened or closed.
    pub(super) const ACTIONS: Self = Self(2);
    pub(super) const PORTS: Self = Self(4);
    /// The timer is up to date: `timer_at` was computed since the clock was last checked.
    // Inverted, so that an engine without a configuration is all zeros and takes no flash.
    pub(super) const ARMED: Self = Self(8);
    pub(super) const ALL: Self = Self(Self::LINKS.0 | 2 | 4);

    pub(super) const fn has(self, what: Self) -> bool {
        self.0 & what.0 != 0
    }

    pub(super) const fn add(&mut self, what: Self) {
        self.0 |= what.0;
    }

    pub(super) const fn remove(&mut self, what: Self) {
        self.0 &= !what.0;
    }

    /// The flags if `wanted`, else none.
    pub(super) const fn when(self, wanted: bool) -> Self {
        if wanted { self } else { Self::NONE }
    }
}
