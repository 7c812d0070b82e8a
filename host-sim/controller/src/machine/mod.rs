//! The controller's states: power and enable, program, safety, mode
//! (docs/simulated-controller.md section 1; the codes are in proto-core/docs/wire/state.md section 4).
//!
//! In: commands, faults, the time, and when the arm has come to rest. Out: what is allowed, what
//! must happen with the arm and the program, and the states as everybody sees them. Knows neither
//! texts nor connections; it neither runs programs nor moves the arm itself.
//!
//! A command that is accepted begins a [`Transition`], which takes its time: [`Machine::progress`]
//! tells what became of it, so that the command can be answered when it is done (D25).

mod errors;
mod transition;

use proto_core::command::{Action, Percent};
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::{OperationMode, ProgramState, RobotState, SafetyState};

use super::motion::Braking;
pub use errors::{ErrorEntry, ErrorId};
use transition::Begun;
pub use transition::{Progress, Transition};

/// The state machines.
#[derive(Debug, Clone)]
pub struct Machine {
    robot: Robot,
    program: Program,
    safety: Safety,
    mode: OperationMode,
    speed_percent: f32,
    collision_axis: Option<u8>,
    error: Option<ErrorEntry>,
    robot_error: Option<ErrorId>,
    /// Transitions begun so far, of power and drives and of the program.
    begun: Begun,
    /// What every transition that a command begins takes beyond its time.
    delay: Duration,
}

/// What must happen with the rest of the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// Nothing more.
    None,
    /// Slow the arm down to rest on its path and hold the program where it is; the arm's rest is
    /// reported with [`Machine::arm_rests_at`].
    Hold,
    /// Go on from there.
    Continue,
    /// End the program and slow the arm down to rest; reported as with [`Effect::Hold`].
    Abort(Braking),
    /// The program has ended and the arm is at rest.
    ProgramEnded,
    /// The controller goes away: everything is closed.
    ShutDown,
}

/// Where power and drives stand; each state owns its deadline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Robot {
    Booting { shown: RobotState, until: Instant },
    Off,
    PoweringOn { until: Instant },
    Disabled,
    Enabling { until: Instant },
    Enabled,
    Disabling { shown: RobotState, until: Instant },
    PoweringOff { shown: RobotState, until: Instant },
    ShuttingDown { until: Instant },
    Gone,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Program {
    Stopped,
    Running,
    Pausing { until: Instant },
    Paused,
    Stopping { until: Instant },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Safety {
    Run,
    Reduced,
    Stopped(SafetyState),
    Recovering { until: Instant },
}

/// How far the robot is powered up at the start.
pub use recipe_config::Power;

impl Machine {
    /// A controller that has been up for a while.
    pub fn new(power: Power, mode: OperationMode) -> Self {
        let robot = match power {
            Power::Off => Robot::Off,
            Power::On => Robot::Disabled,
            Power::Enabled => Robot::Enabled,
        };
        Self {
            robot,
            program: Program::Stopped,
            safety: Safety::Run,
            mode,
            speed_percent: 100.0,
            collision_axis: None,
            error: None,
            robot_error: None,
            begun: Begun::default(),
            delay: Duration::ZERO,
        }
    }

    /// A controller that is just being switched on: it goes through its start to power off.
    pub fn booting(now: Instant, mode: OperationMode) -> Self {
        let until = now + BOOT[0].1;
        Self { robot: Robot::Booting { shown: BOOT[0].0, until }, ..Self::new(Power::Off, mode) }
    }

    /// Robot state.
    pub fn robot(&self) -> RobotState {
        match self.robot {
            Robot::Booting { shown, .. }
            | Robot::Disabling { shown, .. }
            | Robot::PoweringOff { shown, .. } => shown,
            Robot::Off | Robot::PoweringOn { .. } | Robot::ShuttingDown { .. } | Robot::Gone => {
                RobotState::PowerOff
            }
            Robot::Disabled | Robot::Enabling { .. } => RobotState::Disable,
            Robot::Enabled => RobotState::Enable,
        }
    }

    /// Program state.
    pub fn program(&self) -> ProgramState {
        match self.program {
            Program::Stopped => ProgramState::Stopped,
            Program::Running => ProgramState::Running,
            Program::Pausing { .. } => ProgramState::Pausing,
            Program::Paused => ProgramState::Paused,
            Program::Stopping { .. } => ProgramState::Stopping,
        }
    }

    /// Safety state.
    pub fn safety(&self) -> SafetyState {
        match (self.safety, self.robot) {
            (Safety::Stopped(state), _) => state,
            (_, Robot::Booting { shown: RobotState::Start, .. }) => SafetyState::Boot,
            (_, Robot::Booting { .. }) => SafetyState::Init,
            _ if self.robot() == RobotState::PowerOff => SafetyState::PowerOff,
            (Safety::Run, _) => SafetyState::Run,
            (Safety::Reduced, _) => SafetyState::Reduce,
            (Safety::Recovering { .. }, _) => SafetyState::Recovery,
        }
    }

    /// Operation mode.
    pub fn mode(&self) -> OperationMode {
        self.mode
    }

    /// Program speed, per cent.
    pub fn speed_percent(&self) -> f32 {
        self.speed_percent
    }

    /// The axis of the collision that stopped the robot, until it is cleared.
    pub fn collision_axis(&self) -> Option<u8> {
        self.collision_axis
    }

    /// The newest error of the robot or of a program; a refused command is none.
    pub fn robot_error(&self) -> Option<ErrorId> {
        self.robot_error
    }

    /// The newest error of any kind.
    pub fn error(&self) -> Option<&ErrorEntry> {
        self.error.as_ref()
    }

    /// Whether the drives hold the arm.
    pub fn drives_on(&self) -> bool {
        matches!(self.robot, Robot::Enabled | Robot::Disabling { shown: RobotState::Enable, .. })
    }

    /// The share of its planned speed that motion runs at now.
    pub fn rate(&self) -> f64 {
        let reduced = if self.safety == Safety::Reduced { REDUCED_RATE } else { 1.0 };
        f64::from(self.speed_percent) / 100.0 * reduced
    }

    /// Whether the program may go on.
    pub fn program_runs(&self) -> bool {
        self.program == Program::Running
    }

    /// `speed(V)`.
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

    /// Whether `run` is allowed now; the program is to be started when it is, with
    /// [`Machine::program_started`].
    ///
    /// # Errors
    /// The error that was recorded.
    pub fn check_run(&mut self) -> Result<(), ErrorId> {
        let why = if self.robot != Robot::Enabled {
            "run: the robot is not enabled"
        } else if self.mode == OperationMode::Manual {
            "run: the robot is in manual mode"
        } else if self.stopped_by_safety() {
            "run: a safety stop is active"
        } else if self.program != Program::Stopped {
            "run: a program is already running"
        } else {
            return Ok(());
        };
        Err(self.refuse(ErrorId::WrongState, why))
    }

    /// The program has begun.
    pub fn program_started(&mut self) {
        self.program = Program::Running;
    }

    /// The program has come to its end by itself.
    pub fn program_ended(&mut self) {
        self.program = Program::Stopped;
    }

    /// One of the keywords that are answered with success or fail: begins what it asks for.
    ///
    /// # Errors
    /// The error that was recorded; nothing else changed.
    pub fn act(&mut self, now: Instant, action: Action) -> Result<(Effect, Transition), ErrorId> {
        let effect = match self.begin(now, action) {
            Ok(effect) => effect,
            Err(why) => return Err(self.refuse(ErrorId::WrongState, why)),
        };
        Ok((effect, Transition { action, begun: self.begun }))
    }

    /// Why not, or what must happen with the rest.
    fn begin(&mut self, now: Instant, action: Action) -> Result<Effect, &'static str> {
        let begins = now + self.delay;
        let after = |length: Duration| begins + length;
        match action {
            Action::PowerOn => match self.robot {
                Robot::Off => {
                    self.begin_robot(Robot::PoweringOn { until: after(POWER_ON) });
                    Ok(Effect::None)
                }
                _ => Err("poweron: the robot is not powered off"),
            },
            Action::PowerOff => match self.robot {
                // Whatever is under way must not keep the power on.
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
                _ => Err("poweroff: the robot is not powered, or is losing power"),
            },
            Action::Enable => match self.robot {
                Robot::Disabled if self.stopped_by_safety() => Err("enable: a safety stop is active"),
                Robot::Disabled => {
                    self.begin_robot(Robot::Enabling { until: after(ENABLE) });
                    Ok(Effect::None)
                }
                _ => Err("enable: the robot is not powered on, or already enabled"),
            },
            Action::Disable => match self.robot {
                Robot::Enabling { .. } | Robot::Enabled => {
                    self.begin_robot(Robot::Disabling { shown: self.robot(), until: after(DISABLE) });
                    Ok(self.abort(after(STOP), Braking::Hard))
                }
                _ => Err("disable: the robot is not enabled"),
            },
            Action::Stop => match self.program {
                Program::Running | Program::Pausing { .. } | Program::Paused => {
                    Ok(self.abort(after(STOP), Braking::Normal))
                }
                Program::Stopped | Program::Stopping { .. } => Err("stop: no program is running"),
            },
            Action::Pause => match self.program {
                Program::Running => {
                    self.begin_program(Program::Pausing { until: after(PAUSE) });
                    Ok(Effect::Hold)
                }
                _ => Err("pause: no program is running"),
            },
            Action::Resume => match self.program {
                Program::Paused if self.stopped_by_safety() => Err("resume: a safety stop is active"),
                Program::Paused => {
                    self.begin_program(Program::Running);
                    Ok(Effect::Continue)
                }
                _ => Err("resume: no program is paused"),
            },
            Action::Shutdown => match self.robot {
                Robot::Off => {
                    self.begin_robot(Robot::ShuttingDown { until: now + SHUT_DOWN });
                    Ok(Effect::None)
                }
                _ => Err("shutdown: the robot is not powered off"),
            },
        }
    }

    /// A command whose transition was begun is answered with fail: records it, unless a safety stop
    /// was the cause, which is the better thing to read.
    pub fn not_completed(&mut self, action: Action, why: &str) {
        if !matches!(self.safety, Safety::Stopped(_)) {
            self.fail(ErrorId::NotCompleted, format!("{}: {why}", action.word()));
        }
    }

    /// What commands begin takes this much longer from now on.
    pub fn delay_transitions(&mut self, by: Duration) {
        self.delay = by;
    }

    /// When the arm, which was told to slow down, will be at rest.
    pub fn arm_rests_at(&mut self, rest: Instant) {
        if let Program::Pausing { until } | Program::Stopping { until } = &mut self.program {
            *until = (*until).max(rest);
        }
    }

    /// When something changes by itself.
    pub fn deadline(&self) -> Option<Instant> {
        let robot = match self.robot {
            Robot::Booting { until, .. }
            | Robot::PoweringOn { until }
            | Robot::Enabling { until }
            | Robot::Disabling { until, .. }
            | Robot::PoweringOff { until, .. }
            | Robot::ShuttingDown { until } => Some(until),
            Robot::Off | Robot::Disabled | Robot::Enabled | Robot::Gone => None,
        };
        let program = match self.program {
            Program::Pausing { until } | Program::Stopping { until } => Some(until),
            Program::Stopped | Program::Running | Program::Paused => None,
        };
        let safety = match self.safety {
            Safety::Recovering { until } => Some(until),
            Safety::Run | Safety::Reduced | Safety::Stopped(_) => None,
        };
        [robot, program, safety].into_iter().flatten().min()
    }

    /// Carries out what has become due; to be called until it returns `None`.
    pub fn poll(&mut self, now: Instant) -> Option<Effect> {
        if let Safety::Recovering { until } = self.safety
            && now >= until
        {
            self.safety = Safety::Run;
            return Some(Effect::None);
        }
        match self.program {
            Program::Pausing { until } if now >= until => {
                self.program = Program::Paused;
                return Some(Effect::None);
            }
            Program::Stopping { until } if now >= until => {
                self.program = Program::Stopped;
                return Some(Effect::ProgramEnded);
            }
            _ => {}
        }
        self.robot = match self.robot {
            Robot::Booting { shown, until } if now >= until => {
                let next = BOOT.iter().position(|phase| phase.0 == shown).map_or(0, |nth| nth + 1);
                match BOOT.get(next) {
                    Some(&(shown, length)) => Robot::Booting { shown, until: until + length },
                    None => Robot::Off,
                }
            }
            Robot::PoweringOn { until } if now >= until => Robot::Disabled,
            Robot::Enabling { until } if now >= until => Robot::Enabled,
            Robot::Disabling { until, .. } if now >= until => Robot::Disabled,
            Robot::PoweringOff { until, .. } if now >= until => Robot::Off,
            Robot::ShuttingDown { until } if now >= until => {
                self.robot = Robot::Gone;
                return Some(Effect::ShutDown);
            }
            _ => return None,
        };
        Some(Effect::None)
    }

    /// Records an error.
    pub fn fail(&mut self, id: ErrorId, message: impl Into<String>) {
        if !id.is_refusal() {
            self.robot_error = Some(id);
        }
        self.error = Some(ErrorEntry { id, message: message.into() });
    }

    /// Changes the operation mode, as a key switch would.
    pub fn set_mode(&mut self, mode: OperationMode) {
        self.mode = mode;
    }

    /// Reduced speed on or off, as a safety zone would ask for it.
    pub fn set_reduced(&mut self, reduced: bool) {
        match (self.safety, reduced) {
            (Safety::Run, true) => self.safety = Safety::Reduced,
            (Safety::Reduced, false) => self.safety = Safety::Run,
            _ => {}
        }
    }

    /// The emergency stop is pressed: the program ends, the drives are switched off.
    pub fn emergency_stop(&mut self, now: Instant) -> Effect {
        self.safety_stop(now, SafetyState::Stop0, ErrorId::EmergencyStop, "emergency stop")
    }

    /// A protective stop: the program ends, the drives are switched off once the arm is at rest.
    pub fn protective_stop(&mut self, now: Instant) -> Effect {
        self.safety_stop(now, SafetyState::Stop1, ErrorId::ProtectiveStop, "protective stop")
    }

    /// The arm has hit something on this axis: it stops on its path and the program is paused.
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

    /// The cause of a stop is gone and was acknowledged.
    pub fn clear_stop(&mut self, now: Instant) {
        if matches!(self.safety, Safety::Stopped(_)) {
            self.safety = Safety::Recovering { until: now + RECOVER };
        }
        self.collision_axis = None;
    }

    fn safety_stop(&mut self, now: Instant, shown: SafetyState, id: ErrorId, message: &str) -> Effect {
        self.safety = Safety::Stopped(shown);
        self.fail(id, message);
        if matches!(self.robot, Robot::Enabled | Robot::Enabling { .. }) {
            self.begin_robot(Robot::Disabling { shown: self.robot(), until: now + DISABLE });
        }
        self.abort(now + STOP, Braking::Hard)
    }

    fn abort(&mut self, until: Instant, braking: Braking) -> Effect {
        match self.program {
            Program::Stopped | Program::Stopping { .. } => Effect::None,
            Program::Running | Program::Pausing { .. } | Program::Paused => {
                self.begin_program(Program::Stopping { until });
                Effect::Abort(braking)
            }
        }
    }

    fn stopped_by_safety(&self) -> bool {
        !matches!(self.safety, Safety::Run | Safety::Reduced)
    }

    fn refuse(&mut self, id: ErrorId, message: &str) -> ErrorId {
        self.fail(id, message);
        id
    }
}

/// What a controller shows while it starts, and for how long.
const BOOT: [(RobotState, Duration); 4] = [
    (RobotState::Start, Duration::from_millis(200)),
    (RobotState::Initialize, Duration::from_millis(300)),
    (RobotState::Logout, Duration::from_millis(100)),
    (RobotState::Login, Duration::from_millis(100)),
];
const POWER_ON: Duration = Duration::from_millis(300);
const POWER_OFF: Duration = Duration::from_millis(200);
const ENABLE: Duration = Duration::from_millis(200);
const DISABLE: Duration = Duration::from_millis(100);
const SHUT_DOWN: Duration = Duration::from_millis(100);
/// The shortest a pause and a stop take; an arm in motion makes them longer.
const PAUSE: Duration = Duration::from_millis(20);
const STOP: Duration = Duration::from_millis(20);
const RECOVER: Duration = Duration::from_millis(200);
/// Share of the planned speed in the reduced safety state.
const REDUCED_RATE: f64 = 0.25;
