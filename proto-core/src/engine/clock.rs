//! Time in the engine: what a call says about it, deadlines, and sleep of the gateway itself.
//!
//! In: the instant of each call. Out: everything whose time has come, and when the engine has to be
//! called again. Does not know what the deadlines are for.

use super::counters::{add, bump};
use super::field_port::FieldPort;
use super::store::Overdue;
use super::user::silence_commands;
use super::{Ask, Engine};
use crate::time::{Duration, Instant};

/// If two calls of the engine are further apart than this, the gateway was asleep: stopped,
/// suspended, or in a debugger.
pub const ASLEEP: Duration = Duration::from_millis(500);

/// The engine asks to be called at least this often, even if it has nothing to do, so that it
/// notices sleep.
const HEARTBEAT: Duration = Duration::from_millis(250);

/// After sleep, input from the field is discarded for this long, and until the next tick: drivers
/// read what waits in devices in pieces.
const DEAF: Duration = Duration::from_millis(50);

/// The clock's last instant. [`Instant::NEVER`] is after it, so that "no deadline" never comes.
const LAST: Instant = Instant::from_micros(u64::MAX - 1);

impl<const PORTS: usize, const UPLINKS: usize, const FIELDS: usize, const TAP: usize, const EXCHANGES: usize>
    Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>
{
    /// The deadlines up to `now` pass.
    pub(super) fn tick(&mut self, now: Instant) {
        (self.is_late, self.announced) = (false, Instant::NEVER);
        self.is_deaf &= now < self.deaf_until;
        if now >= self.timer_at {
            self.advance(now);
        }
    }

    /// When the engine has something to do without an input, computed exactly. [`super::Output::Sleep`]
    /// may be earlier, never later.
    pub fn deadline(&self) -> Instant {
        let ports = self.ports.iter().map(FieldPort::deadline);
        let ports = ports.min().unwrap_or(Instant::NEVER);
        let hears_at = if self.is_deaf { self.deaf_until } else { Instant::NEVER };
        let own = ports.min(self.links.deadline()).min(self.store.deadline()).min(hears_at);
        if self.exchanges.is_used() { own.min(self.talk_deadline()) } else { own }
    }

    /// The present, and whether the gateway has slept until now.
    pub(super) fn present(&mut self, now: Instant) -> Instant {
        let now = self.forward(now);
        self.store.now = now;
        if now >= self.beat_at {
            // A configured engine is called at every beat; before the first call nothing was late.
            if self.now != Instant::ZERO && now.saturating_since(self.now) > ASLEEP {
                self.wake(now);
            }
            self.beat_at = now + HEARTBEAT;
            self.ask = Ask::ALL;
        }
        self.now = now;
        now
    }

    /// `now`, but no earlier than the previous call, and no later than the clock's last instant.
    pub(super) fn forward(&self, now: Instant) -> Instant {
        if now < self.now || now > LAST { self.clamped(now) } else { now }
    }

    #[cold]
    fn clamped(&self, now: Instant) -> Instant {
        now.min(LAST).max(self.now)
    }

    /// The gateway itself slept: the age of everything that waits is unknown. Overdue safe values
    /// go first, no command is sent, and every connection is opened again.
    #[cold]
    fn wake(&mut self, now: Instant) {
        self.sleeps = self.sleeps.wrapping_add(1);
        // Before deadlines pass: one of them may be to open a link that has been down.
        self.links.slept(&mut self.store);
        self.is_deaf = true;
        self.advance(now);
        self.ports.iter_mut().for_each(|port| port.slept(&mut self.tap, now));
        self.talk_slept();
        self.deaf_until = now + DEAF;
        self.arm(self.deaf_until);
    }

    /// Something depends on the clock from `at` on. If it is due already, it is handled before the
    /// engine sleeps, or at the tick that is late.
    pub(super) fn arm(&mut self, at: Instant) {
        if at > self.now {
            self.timer_at = self.timer_at.min(at);
        }
    }

    /// Handles everything that depends on the clock.
    fn advance(&mut self, now: Instant) {
        // At one instant the clock is checked once: what is done now is due later.
        self.timer_at = now + Duration::from_micros(1);
        self.ask = Ask::ALL;
        self.is_armed = false;
        self.expire_frames(now);
        for index in 0..self.ports.len() {
            if let Some(port) = self.ports.get_mut(index)
                && port.advance(&mut self.tap, now)
            {
                let id = port.id;
                self.port_silent(id, now);
            }
        }
        if self.exchanges.is_used() {
            self.advance_talk(now);
        }
        self.links.advance(&mut self.store);
        self.carry_results();
    }

    fn expire_frames(&mut self, now: Instant) {
        let mut timed_out = false;
        while let Some(overdue) = self.store.next_timeout(&self.safe_values) {
            let Overdue::Frame(frame, dropped) = overdue else {
                self.check_health(now);
                continue;
            };
            timed_out = true;
            if let Some(port) = self.ports.get_mut(usize::from(frame.port)) {
                bump(&mut port.counters.timeouts);
                add(&mut port.counters.values_expired, dropped);
            }
            silence_commands(frame.bindings.of(&self.bindings.inputs), self.links.command.first_mut(), now);
        }
        if timed_out {
            self.drop_forgotten(now);
            self.image_changed();
            self.tell_alive(now);
        }
        self.expire_waiting();
    }

    /// Drops values that have waited too long.
    #[inline(always)]
    pub(super) fn expire_waiting(&mut self) {
        if self.store.may_expire() {
            self.drop_expired();
        }
    }

    #[inline(never)]
    fn drop_expired(&mut self) {
        let ports = &mut self.ports;
        self.store.expire_waiting(|port, dropped| {
            if let Some(port) = ports.get_mut(port) {
                add(&mut port.counters.values_expired, dropped);
            }
        });
    }
}
