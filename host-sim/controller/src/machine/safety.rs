//! Stops and reduced speed, as caused by safety devices.

use proto_core::time::Instant;
use proto_core::wire::state::SafetyState;
use serde::{Deserialize, Serialize};

use super::{DISABLE, Effect, ErrorId, Machine, PAUSE, Program, RECOVER, Robot, STOP, Safety};
use crate::motion::Braking;

/// A stop, the weakest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Stop {
    /// The arm stops on its path.
    Collision,
    Protective,
    Emergency,
}

impl Stop {
    pub(super) fn state(self) -> SafetyState {
        match self {
            Self::Collision => SafetyState::Stop2,
            Self::Protective => SafetyState::Stop1,
            Self::Emergency => SafetyState::Stop0,
        }
    }
}

/// Why the safety controller does not monitor the robot, which then must not move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SafetyHold {
    /// SS_WAIT.
    Wait,
    /// SS_CONFIG: the safety parameters are being changed.
    Config,
    /// SS_MODEL.
    Model,
    /// SS_UPDATE: the safety firmware is being updated. The power cannot be switched on.
    Update,
    /// SS_FAIL: the safety controller has failed. The power cannot be switched on.
    Fail,
}

impl SafetyHold {
    /// The state shown to clients.
    pub fn state(self) -> SafetyState {
        match self {
            Self::Wait => SafetyState::Wait,
            Self::Config => SafetyState::Config,
            Self::Model => SafetyState::Model,
            Self::Update => SafetyState::Update,
            Self::Fail => SafetyState::Fail,
        }
    }
}

impl Machine {
    /// Switches reduced speed on or off, as a safety zone does. A stop takes precedence; reduced speed applies after
    /// it.
    pub fn set_reduced(&mut self, reduced: bool) {
        self.is_reduced = reduced;
    }

    /// The safety controller stops working: the program ends, and the drives are switched off.
    pub fn hold_safety(&mut self, now: Instant, hold: SafetyHold) -> Effect {
        self.hold = Some(hold);
        if hold == SafetyHold::Fail {
            self.fail(ErrorId::SafetyFailure, "the safety controller has failed");
        }
        self.drop_drives(now)
    }

    /// The safety controller works again. A stop remains.
    pub fn release_safety(&mut self) {
        self.hold = None;
    }

    /// The emergency stop is pressed: the program ends, and the drives are switched off.
    pub fn emergency_stop(&mut self, now: Instant) -> Effect {
        self.safety_stop(now, Stop::Emergency, ErrorId::EmergencyStop, "emergency stop")
    }

    /// A protective stop: the program ends, and the drives are switched off.
    pub fn protective_stop(&mut self, now: Instant) -> Effect {
        self.safety_stop(now, Stop::Protective, ErrorId::ProtectiveStop, "protective stop")
    }

    /// The arm has collided on this axis: it stops on its path, and the program is paused.
    pub fn collide(&mut self, now: Instant, axis: u8) -> Effect {
        self.show_stop(Stop::Collision);
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

    fn safety_stop(&mut self, now: Instant, stop: Stop, id: ErrorId, message: &str) -> Effect {
        self.show_stop(stop);
        self.fail(id, message);
        self.drop_drives(now)
    }

    /// Shows a stop, unless a stronger stop is shown.
    fn show_stop(&mut self, stop: Stop) {
        self.safety = match self.safety {
            Safety::Stopped(present) => Safety::Stopped(present.max(stop)),
            Safety::Run | Safety::Recovering { .. } => Safety::Stopped(stop),
        };
    }

    fn drop_drives(&mut self, now: Instant) -> Effect {
        if matches!(self.robot, Robot::Enabled | Robot::Enabling { .. }) {
            self.begin_robot(Robot::Disabling { shown: self.robot(), until: now + DISABLE });
        }
        self.abort(now + STOP, Braking::Hard)
    }

    /// Why the robot must not move; `None` if it may.
    pub(super) fn safety_forbids(&self) -> Option<&'static str> {
        match (self.safety, self.hold) {
            (Safety::Stopped(_) | Safety::Recovering { .. }, _) => Some("a safety stop is active"),
            (Safety::Run, Some(_)) => Some("the safety controller does not work"),
            (Safety::Run, None) => None,
        }
    }

    pub(super) fn safety_forbids_power(&self) -> bool {
        matches!(self.hold, Some(SafetyHold::Update | SafetyHold::Fail))
    }

    /// Whether a shown safety state already explains what happens to the program and the drives.
    pub(super) fn safety_has_acted(&self) -> bool {
        matches!(self.safety, Safety::Stopped(_)) || self.hold == Some(SafetyHold::Fail)
    }
}
