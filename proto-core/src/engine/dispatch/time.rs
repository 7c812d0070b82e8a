//! Time: the present, passing deadlines, and sleep of the gateway itself.
//!
//! In: the instant of each call. Out: everything that is due, and when the engine has to be called again. Does not know
//! what the deadlines are for.

use super::EngineView;
use crate::engine::clock::{AFTER_SLEEP, ASLEEP, Clock, Dirty, HEARTBEAT};
use crate::engine::counters::{add, bump};
use crate::engine::field::bindings::silence_commands;
use crate::engine::field::port::FieldPort;
use crate::engine::io::{Handled, Output};
use crate::engine::link::links::LinksView;
use crate::engine::values::store::{Overdue, Store};
use crate::time::{Duration, Instant};

/// The exact times at which the engine has something to do without an input: apart from partial frames, and for partial
/// frames.
pub(crate) fn deadlines(
    clock: &Clock,
    ports: &[FieldPort],
    links: LinksView<'_>,
    store: &Store,
    has_exchanges: bool,
) -> (Instant, Instant) {
    let mut firm = links.deadline().min(store.deadline());
    if clock.has_slept {
        firm = firm.min(clock.slept_until);
    }
    let mut partial = Instant::NEVER;
    for port in ports {
        (firm, partial) = (firm.min(port.send_deadline()), partial.min(port.partial_until()));
        if has_exchanges && !clock.has_slept {
            firm = firm.min(port.exchange_deadline());
        }
    }
    (firm, partial)
}

impl EngineView<'_> {
    /// A tick: handles the deadlines up to `now`.
    pub(crate) fn tick(&mut self, now: Instant) {
        (self.clock.is_overdue, self.clock.announced) = (false, Instant::NEVER);
        self.clock.has_slept &= now < self.clock.slept_until;
        if now >= self.clock.timer_at || now >= self.clock.partial_at && self.ends_partial(now) {
            self.advance(now);
        }
    }

    /// Whether silence has ended a partial frame. If not, updates when it may.
    fn ends_partial(&mut self, now: Instant) -> bool {
        let first = self.ports.iter().map(FieldPort::partial_until).min();
        self.clock.partial_at = first.unwrap_or(Instant::NEVER);
        now >= self.clock.partial_at
    }

    /// Sleep until the next deadline or heartbeat.
    pub(crate) fn poll_sleep<'b>(&mut self) -> Output<'b> {
        if !self.clock.dirty.has(Dirty::ARMED) {
            self.clock.dirty.add(Dirty::ARMED);
            let (ports, links) = (&self.ports[..], self.links.view());
            let deadlines = deadlines(self.clock, ports, links, self.store, self.exchanges.is_used());
            (self.clock.timer_at, self.clock.partial_at) = deadlines;
        }
        self.clock.sleep(!self.ports.is_empty())
    }

    /// Begins the handling of an input and returns the present. A sleeping engine has no overdue deadline or heartbeat
    /// to check.
    pub(crate) fn begin(&mut self, was_asleep: bool, now: Instant) -> Instant {
        self.clock.idle_until = Instant::ZERO;
        if was_asleep {
            debug_assert!(!self.clock.is_overdue && !self.clock.has_slept);
            (self.clock.now, self.store.now) = (now, now);
            return now;
        }
        let now = self.present(now);
        self.clock.is_overdue = now >= self.clock.announced;
        now
    }

    /// Ends the handling of an input: asleep if the engine was and still has nothing to do before it wakes.
    pub(crate) fn end(&mut self, was_asleep: bool) -> Handled {
        if was_asleep
            && self.clock.dirty == Dirty::ARMED
            && self.clock.timer_at.min(self.clock.partial_at) >= self.clock.announced
        {
            self.clock.idle_until = self.clock.announced;
            return Handled::Asleep;
        }
        Handled::Poll
    }

    /// The present; also notices that the gateway has slept.
    fn present(&mut self, now: Instant) -> Instant {
        let now = self.clock.forward(now);
        self.store.now = now;
        if now >= self.clock.beat_at {
            // A configured engine is called at every heartbeat; before the first call nothing was late.
            if self.clock.now != Instant::ZERO && now.saturating_since(self.clock.now) > ASLEEP {
                self.wake(now);
            }
            self.clock.beat_at = now + HEARTBEAT;
            self.clock.dirty.add(Dirty::ALL);
        }
        self.clock.now = now;
        now
    }

    /// The gateway itself slept: the age of everything that waits is unknown. Overdue safe values go first, no command
    /// is sent, and every connection is reopened.
    fn wake(&mut self, now: Instant) {
        self.clock.sleeps = self.clock.sleeps.wrapping_add(1);
        // Before deadlines pass, because one of them may open a link that is down.
        self.links.slept(self.store);
        self.clock.has_slept = true;
        self.advance(now);
        self.ports.iter_mut().for_each(|port| port.slept(self.tap, now));
        self.exchanges_slept();
        self.clock.slept_until = now + AFTER_SLEEP;
        self.arm(self.clock.slept_until);
    }

    pub(crate) fn arm(&mut self, at: Instant) {
        self.clock.arm(at);
    }

    /// Asks the driver for another tick at the same instant.
    pub(crate) fn tick_again(&mut self) {
        self.clock.timer_at = self.clock.timer_at.min(self.clock.now);
    }

    /// Handles everything that depends on the time.
    fn advance(&mut self, now: Instant) {
        // The clock is checked once per instant: what is set now is due later.
        self.clock.timer_at = now + Duration::from_micros(1);
        self.clock.dirty.add(Dirty::ALL);
        self.clock.dirty.remove(Dirty::ARMED);
        self.expire_frames(now);
        let mut is_ended = false;
        for port in self.ports.iter_mut() {
            is_ended |= port.advance(self.tap, now);
        }
        if is_ended {
            self.read_ended(now);
        }
        if self.exchanges.is_used() {
            self.advance_exchange(now);
        }
        self.links.advance(self.store);
        if !self.links.devices.is_empty() {
            self.advance_connections(now);
        }
        self.carry_results();
    }

    /// Reads the frames of all ports on which silence has ended one.
    fn read_ended(&mut self, now: Instant) {
        for index in 0..self.ports.len() {
            if let Some(port) = self.ports.get(index)
                && now >= port.partial_until()
            {
                let id = port.id;
                self.port_silent(id, now);
            }
        }
    }

    fn expire_frames(&mut self, now: Instant) {
        let mut timed_out = false;
        while let Some(overdue) = self.store.next_timeout(self.safe_values) {
            let (frame, dropped) = match overdue {
                Overdue::Frame(frame, dropped) => (frame, dropped),
                Overdue::Health => {
                    self.check_health(now);
                    continue;
                }
                Overdue::Fields(port, dropped) => {
                    timed_out = true;
                    if let Some(port) = self.ports.get_mut(usize::from(port)) {
                        add(&mut port.counters.values_expired, dropped);
                    }
                    continue;
                }
                Overdue::Command(field) => {
                    timed_out = true;
                    if let Some(link) = self.links.command.first_mut() {
                        link.silent(field, now);
                    }
                    continue;
                }
            };
            timed_out = true;
            if let Some(port) = self.ports.get_mut(usize::from(frame.port)) {
                bump(&mut port.counters.timeouts);
                add(&mut port.counters.values_expired, dropped);
            }
            silence_commands(frame.bindings.of(self.bindings.inputs), self.links.command.first_mut(), now);
        }
        if timed_out {
            self.drop_commands_of_gone(now);
            self.image_changed();
            self.report_alive(now);
        }
        self.expire_waiting();
    }

    /// Drops values that have waited too long.
    pub(crate) fn expire_waiting(&mut self) {
        if !self.store.may_expire() {
            return;
        }
        let ports = &mut *self.ports;
        self.store.expire_waiting(|port, dropped| {
            if let Some(port) = ports.get_mut(port) {
                add(&mut port.counters.values_expired, dropped);
            }
        });
    }
}
