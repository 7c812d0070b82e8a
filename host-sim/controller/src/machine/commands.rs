//! Commands of clients: which states allow a command, and the transition that it begins (D25).

use proto_core::command::{Action, Percent};
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::{OperationMode, RobotState};

use super::{
    DISABLE, ENABLE, Effect, ErrorId, Machine, PAUSE, POWER_OFF, POWER_ON, Program, Robot, SHUT_DOWN, STOP,
    Transition,
};
use crate::motion::Braking;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Starter {
    Client,
    Pendant,
}

impl Machine {
    /// The command `speed(V)`; `None` if V is out of range.
    ///
    /// # Errors
    /// The error that was recorded; nothing else changed.
    pub fn set_speed(&mut self, speed: Option<Percent>) -> Result<(), ErrorId> {
        match speed {
            Some(speed) => {
                self.speed_percent = speed.value();
                Ok(())
            }
            None => Err(self.refuse(ErrorId::BadArgument, "speed: not within (0, 100]")),
        }
    }

    /// Whether `run` is allowed now. The caller then starts the program and reports [`Machine::program_started`].
    ///
    /// # Errors
    /// The error that was recorded.
    pub fn check_run(&mut self) -> Result<(), ErrorId> {
        self.check_start(Starter::Client)
    }

    /// As [`Self::check_run`] for the pendant, which can also start a program in manual mode.
    ///
    /// # Errors
    /// The error that was recorded.
    pub fn check_run_at_pendant(&mut self) -> Result<(), ErrorId> {
        self.check_start(Starter::Pendant)
    }

    fn check_start(&mut self, by: Starter) -> Result<(), ErrorId> {
        let why = if self.robot != Robot::Enabled {
            "the robot is not enabled"
        } else if self.mode == OperationMode::Manual && by == Starter::Client {
            "the robot is in manual mode"
        } else if let Some(why) = self.safety_forbids() {
            why
        } else if self.program != Program::Stopped {
            "a program is already running"
        } else {
            return Ok(());
        };
        Err(self.refuse(ErrorId::WrongState, &format!("run: {why}")))
    }

    /// Executes a command that is answered with success or fail: begins its transition.
    ///
    /// # Errors
    /// The error that was recorded; nothing else changed.
    pub fn act(&mut self, now: Instant, action: Action) -> Result<(Effect, Transition), ErrorId> {
        let effect = match self.begin(now, action) {
            Ok(effect) => effect,
            Err(why) => {
                return Err(self.refuse(ErrorId::WrongState, &format!("{}: {why}", action.word())));
            }
        };
        Ok((effect, Transition { action, begun: self.begun }))
    }

    /// Whether the robot is already in the state that the command leads to. Only for power and drives: without a
    /// program, `stop` and `pause` are refused.
    pub fn is_already(&self, action: Action) -> bool {
        match action {
            Action::PowerOn => matches!(
                self.robot,
                Robot::Disabled | Robot::Enabling { .. } | Robot::Enabled | Robot::Disabling { .. }
            ),
            Action::PowerOff => self.robot == Robot::Off,
            Action::Enable => self.robot == Robot::Enabled,
            Action::Disable => self.robot == Robot::Disabled,
            Action::Stop | Action::Pause | Action::Resume | Action::Shutdown => false,
        }
    }

    /// The effect on the rest of the controller, or why the command is refused.
    fn begin(&mut self, now: Instant, action: Action) -> Result<Effect, &'static str> {
        let begins = now + self.delay;
        let after = |length: Duration| begins + length;
        match action {
            Action::PowerOn => match self.robot {
                Robot::Off if self.safety_forbids_power() => Err("the safety controller does not work"),
                Robot::Off => {
                    self.begin_robot(Robot::PoweringOn { until: after(POWER_ON) });
                    Ok(Effect::None)
                }
                _ => Err("the robot is not powered off"),
            },
            Action::PowerOff => match self.robot {
                // Allowed during every transition, because no transition may keep the power on.
                Robot::PoweringOn { .. }
                | Robot::Disabled
                | Robot::Enabling { .. }
                | Robot::Enabled
                | Robot::Disabling { .. } => {
                    let shown = match self.robot {
                        Robot::PoweringOn { .. } => RobotState::PowerOff,
                        _ => RobotState::Disable,
                    };
                    self.begin_robot(Robot::PoweringOff { shown, until: after(POWER_OFF) });
                    Ok(self.abort(after(STOP), Braking::Hard))
                }
                _ => Err("the robot is not powered, or is losing power"),
            },
            Action::Enable => match self.robot {
                Robot::Disabled => {
                    if let Some(why) = self.safety_forbids() {
                        return Err(why);
                    }
                    self.begin_robot(Robot::Enabling { until: after(ENABLE) });
                    Ok(Effect::None)
                }
                _ => Err("the robot is not powered on, or already enabled"),
            },
            Action::Disable => match self.robot {
                Robot::Enabling { .. } | Robot::Enabled => {
                    self.begin_robot(Robot::Disabling { shown: self.robot(), until: after(DISABLE) });
                    Ok(self.abort(after(STOP), Braking::Hard))
                }
                _ => Err("the robot is not enabled"),
            },
            Action::Stop => match self.program {
                Program::Running | Program::Pausing { .. } | Program::Paused => {
                    Ok(self.abort(after(STOP), Braking::Normal))
                }
                Program::Stopped | Program::Stopping { .. } => Err("no program is running"),
            },
            Action::Pause => match self.program {
                Program::Running => {
                    self.begin_program(Program::Pausing { until: after(PAUSE) });
                    Ok(Effect::Hold)
                }
                _ => Err("no program is running"),
            },
            Action::Resume => match self.program {
                Program::Paused => {
                    if let Some(why) = self.safety_forbids() {
                        return Err(why);
                    }
                    self.begin_program(Program::Running);
                    Ok(Effect::Continue)
                }
                _ => Err("no program is paused"),
            },
            Action::Shutdown => match self.robot {
                Robot::Off => {
                    self.begin_robot(Robot::ShuttingDown { until: now + SHUT_DOWN });
                    Ok(Effect::None)
                }
                _ => Err("the robot is not powered off"),
            },
        }
    }

    /// Records that an accepted command is answered with fail. The error of a safety stop that caused this is kept.
    pub fn not_completed(&mut self, action: Action, why: &str) {
        if !self.safety_has_acted() {
            self.fail(ErrorId::NotCompleted, format!("{}: {why}", action.word()));
        }
    }

    pub(super) fn abort(&mut self, until: Instant, braking: Braking) -> Effect {
        match self.program {
            Program::Stopped | Program::Stopping { .. } => Effect::None,
            Program::Running | Program::Pausing { .. } | Program::Paused => {
                self.begin_program(Program::Stopping { until });
                Effect::Abort(braking)
            }
        }
    }

    fn refuse(&mut self, id: ErrorId, message: &str) -> ErrorId {
        self.fail(id, message);
        id
    }
}
