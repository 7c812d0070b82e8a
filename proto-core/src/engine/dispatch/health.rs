//! The health of ports and links as values, for output fields and for variables that the robot reads.
//!
//! In: states and counters of ports, states of links. Out: extra values of the image, set just before a frame is made;
//! variables, sent to the controller like those of a field frame. Does not know how they are written.

use super::EngineView;
use crate::config::PortValue;
use crate::engine::clock::Dirty;
use crate::engine::field::bindings::wrapping_count;
use crate::engine::field::health::{CHECK_EVERY, HealthVariable, Of, REPEAT_EVERY, Shown, state_of};
use crate::engine::io::PortState;
use crate::image::{GroupId, InputSet, saturate_to_field};
use crate::sysvar::SysVar;
use crate::time::Instant;
use crate::wire::scalar::Scalar;

impl EngineView<'_> {
    fn health_of(&self, index: u8, value: PortValue, now: Instant) -> u32 {
        let Some(port) = self.ports.get(usize::from(index)) else { return 0 };
        match value {
            PortValue::Alive => {
                let state = state_of(usize::from(index), port, &self.store.frames, self.exchanges.peers);
                u32::from(state == PortState::Working)
            }
            PortValue::Frames => port.counters.frames_in,
            PortValue::Rejected => port.counters.rejected(),
            PortValue::Ignored => port.counters.ignored,
            PortValue::Age => {
                let own = (0..).zip(&self.store.frames).filter(|(_, frame)| frame.port == index);
                let heard_at = own.filter_map(|(group, _)| self.store.image.stamp_of(GroupId(group))).max();
                heard_at.map_or(u32::MAX, |at| {
                    u32::try_from(now.saturating_since(at).as_millis()).unwrap_or(u32::MAX)
                })
            }
        }
    }

    /// Sets the extra values through which output fields show the health of ports and links.
    pub(crate) fn show_health(&mut self, now: Instant) {
        for nth in 0..self.health.shown.len() {
            let Some(&Shown { of, extra }) = self.health.shown.get(nth) else { break };
            let number = match of {
                Of::Port(port, value) => self.health_of(port, value, now),
                Of::Link(link) => u32::from(self.links.view().is_up(link)),
            };
            self.store.image.receive_extra(extra, f64::from(number));
        }
    }

    /// Reports changes to the robot, and updates the values for the field just before the cycles of the ports that show
    /// them.
    pub(crate) fn check_health(&mut self, now: Instant) {
        if self.health.is_reported && now >= self.health.report_at {
            self.report_changes(now);
            self.health.report_at = now + CHECK_EVERY;
        }
        self.show_health(now);
        let shows = self.ports.iter().filter(|port| port.sender.shows_health);
        let next = shows.map(|port| port.sender.next_cycle(now)).min().unwrap_or(Instant::NEVER);
        let report_at = if self.health.is_reported { self.health.report_at } else { Instant::NEVER };
        self.store.check_health_at(next.min(report_at));
    }

    /// Reports changes to the robot, and everything from time to time.
    fn report_changes(&mut self, now: Instant) {
        let repeats = now >= self.health.repeat_at;
        if repeats {
            self.health.repeat_at = now + REPEAT_EVERY;
        }
        self.report_health(|_| true, repeats, now);
        if self.exchanges.is_used() {
            self.report_outcomes(repeats);
        }
        self.store.image.stamp(self.health.group, now);
    }

    /// Reports at once to the robot whether ports work.
    pub(crate) fn report_alive(&mut self, now: Instant) {
        self.report_health(|value| value == PortValue::Alive, false, now);
    }

    fn report_health(&mut self, is_asked: impl Fn(PortValue) -> bool, repeats: bool, now: Instant) {
        let mut news = InputSet::EMPTY;
        for nth in 0..self.health.variables.len() {
            let Some(&HealthVariable { port, value, var, last }) = self.health.variables.get(nth) else {
                break;
            };
            if !is_asked(value) {
                continue;
            }
            let number = self.health_of(port, value, now);
            if last == Some(number) && !repeats {
                continue;
            }
            // Cannot fail: the value has the variable's type.
            let _ = self.store.image.set(var, scalar_of(var, value, number));
            news.insert(var);
            if let Some(own) = self.health.variables.get_mut(nth) {
                own.last = Some(number);
            }
        }
        if !news.is_empty() {
            self.store.tell(&news);
            self.clock.dirty.add(Dirty::LINKS);
        }
    }
}

/// The value of a port's health in the type of its variable.
fn scalar_of(var: SysVar, value: PortValue, number: u32) -> Scalar {
    if value.is_count() {
        wrapping_count(var.ty(), number)
    } else {
        saturate_to_field(var.ty(), f64::from(number), 1.0, 0.0)
    }
}
