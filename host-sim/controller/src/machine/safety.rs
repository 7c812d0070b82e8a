//! Stops and reduced speed, as safety devices cause them.

use proto_core::time::Instant;
use proto_core::wire::state::SafetyState;

use super::{DISABLE, Effect, ErrorId, Machine, PAUSE, Program, RECOVER, Robot, STOP, Safety};
use crate::motion::Braking;

impl Machine {
    /// Reduced speed on or off, as a safety zone requests it.
    pub fn set_reduced(&mut self, reduced: bool) {
        match (self.safety, reduced) {
            (Safety::Run, true) => self.safety = Safety::Reduced,
            (Safety::Reduced, false) => self.safety = Safety::Run,
            _ => {}
        }
    }

    /// The emergency stop is pressed: the program ends, and the drives are switched off.
    pub fn emergency_stop(&mut self, now: Instant) -> Effect {
        self.safety_stop(now, SafetyState::Stop0, ErrorId::EmergencyStop, "emergency stop")
    }

    /// A protective stop: the program ends, and the drives are switched off.
    pub fn protective_stop(&mut self, now: Instant) -> Effect {
        self.safety_stop(now, SafetyState::Stop1, ErrorId::ProtectiveStop, "protective stop")
    }

    /// The arm has collided on this axis: it stops on its path, and the program is paused.
    pub fn collide(&mut self, now: Instant, axis: u8) -> Effect {
        self.safety = Safety::Stopped(SafetyState::Stop2);
        self.collision_axis = Some(axis);
        self.fail(ErrorId::Collision, format!("collision on axis {axis}"));
        if self.program == Program::Running {
            self.begin_program(Program::Pausing { until: now + PAUSE });
            return Effect::Hold;
        }
        Effect::None
    }

    /// The cause of a stop was removed and acknowledged.
    pub fn clear_stop(&mut self, now: Instant) {
        if matches!(self.safety, Safety::Stopped(_)) {
            self.safety = Safety::Recovering { until: now + RECOVER };
        }
        self.collision_axis = None;
    }

    /// Clears a stop, as [`Self::clear_stop`] does, and the errors.
    pub fn reset(&mut self, now: Instant) {
        self.clear_stop(now);
        self.clear_error();
    }

    fn safety_stop(&mut self, now: Instant, shown: SafetyState, id: ErrorId, message: &str) -> Effect {
        self.safety = Safety::Stopped(shown);
        self.fail(id, message);
        if matches!(self.robot, Robot::Enabled | Robot::Enabling { .. }) {
            self.begin_robot(Robot::Disabling { shown: self.robot(), until: now + DISABLE });
        }
        self.abort(now + STOP, Braking::Hard)
    }

    pub(super) fn stopped_by_safety(&self) -> bool {
        !matches!(self.safety, Safety::Run | Safety::Reduced)
    }
}
