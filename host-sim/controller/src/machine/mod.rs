//! The controller's states: power and enable, program, safety, mode
//! (docs/simulated-controller.md section 1; the codes are in proto-core/docs/wire/state.md section 4).
//!
//! In: commands, faults, the time, and when the arm comes to rest. Out: whether a command is allowed, its effect on arm
//! and program, and the states shown to clients. Does not know command texts or connections, does not run programs or
//! move the arm.
//!
//! An accepted command begins a [`Transition`]. [`Machine::progress`] returns its state, and the command is answered at
//! its end (D25).

mod commands;
mod errors;
mod safety;
mod transition;

use proto_core::time::{Duration, Instant};
use proto_core::wire::state::{OperationMode, ProgramState, RobotState, SafetyState};

use super::motion::Braking;
pub use errors::{ErrorEntry, ErrorId};
pub use safety::SafetyHold;
use safety::Stop;
use transition::Begun;
pub use transition::{Transition, TransitionProgress};

/// The state machines.
#[derive(Debug, Clone)]
pub struct Machine {
    robot: Robot,
    program: Program,
    safety: Safety,
    /// A person is in a zone of reduced speed.
    is_reduced: bool,
    /// Why the safety controller is not working.
    hold: Option<SafetyHold>,
    mode: OperationMode,
    speed_percent: f32,
    collision_axis: Option<u8>,
    error: Option<ErrorEntry>,
    robot_error: Option<ErrorId>,
    /// Errors, and `None` for acknowledgements, since [`Machine::take_errors`].
    new_errors: Vec<Option<ErrorEntry>>,
    /// Number of transitions of power and drives, and of the program.
    begun: Begun,
    /// Additional time of every transition begun by a command.
    delay: Duration,
}

/// What the rest of the controller has to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// Nothing.
    None,
    /// Decelerate the arm to rest on its path, and hold the program. Report the time of rest with
    /// [`Machine::arm_rests_at`].
    Hold,
    /// Continue after [`Effect::Hold`].
    Continue,
    /// End the program and decelerate the arm to rest; report the time as for [`Effect::Hold`].
    Abort(Braking),
    /// The program has ended and the arm is at rest.
    ProgramEnded,
    /// The controller is shut down: close everything.
    ShutDown,
}

/// The state of power and drives. A transient state has a deadline.
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
    Stopped(Stop),
    Recovering { until: Instant },
}

pub use recipe_config::Power;

impl Machine {
    /// A booted controller, or with [`Power::Boot`] one that waits for [`Self::booting`].
    pub fn new(power: Power, mode: OperationMode) -> Self {
        let robot = match power {
            // `booting` sets the time in the first call.
            Power::Boot => Robot::Booting { shown: BOOT[0].0, until: Instant::NEVER },
            Power::Off => Robot::Off,
            Power::On => Robot::Disabled,
            Power::Enabled => Robot::Enabled,
        };
        Self {
            robot,
            program: Program::Stopped,
            safety: Safety::Run,
            is_reduced: false,
            hold: None,
            mode,
            speed_percent: 100.0,
            collision_axis: None,
            error: None,
            robot_error: None,
            new_errors: Vec::new(),
            begun: Begun::default(),
            delay: Duration::ZERO,
        }
    }

    /// A controller that was just switched on: it boots to power off.
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
            (Safety::Stopped(stop), _) => stop.state(),
            _ if self.hold.is_some() => self.hold.map_or(SafetyState::Fail, SafetyHold::state),
            (_, Robot::Booting { shown: RobotState::Start, .. }) => SafetyState::Boot,
            (_, Robot::Booting { .. }) => SafetyState::Init,
            _ if self.robot() == RobotState::PowerOff => SafetyState::PowerOff,
            (Safety::Run, _) if self.is_reduced => SafetyState::Reduce,
            (Safety::Run, _) => SafetyState::Run,
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

    /// The axis of the collision that has stopped the robot; `None` once the collision is cleared.
    pub fn collision_axis(&self) -> Option<u8> {
        self.collision_axis
    }

    /// The newest error of the robot or of a program; `None` if there is none. Refused commands do not count.
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

    /// The present speed divided by the planned speed.
    pub fn rate(&self) -> f64 {
        let reduced = if self.is_reduced { REDUCED_RATE } else { 1.0 };
        f64::from(self.speed_percent) / 100.0 * reduced
    }

    /// Whether the program runs.
    pub fn program_runs(&self) -> bool {
        self.program == Program::Running
    }

    /// Reports that the program was started.
    pub fn program_started(&mut self) {
        self.program = Program::Running;
    }

    /// Reports that the program has ended by itself.
    pub fn program_ended(&mut self) {
        self.program = Program::Stopped;
    }

    /// Makes transitions begun by commands longer by `by` from now on.
    pub fn delay_transitions(&mut self, by: Duration) {
        self.delay = by;
    }

    /// Reports when the decelerating arm will be at rest.
    pub fn arm_rests_at(&mut self, rest: Instant) {
        if let Program::Pausing { until } | Program::Stopping { until } = &mut self.program {
            *until = (*until).max(rest);
        }
    }

    /// When the next state change is due; `None` if none is.
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
            Safety::Run | Safety::Stopped(_) => None,
        };
        [robot, program, safety].into_iter().flatten().min()
    }

    /// Executes the next due state change. Call it until it returns `None`.
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
        let error = ErrorEntry { id, message: message.into() };
        self.error = Some(error.clone());
        self.note_error(Some(error));
    }

    /// Raises an error with any number, as the robot itself does.
    pub fn raise(&mut self, code: u32, message: impl Into<String>) {
        self.fail(ErrorId::Raised(code), message);
    }

    /// Acknowledges the error, as on the pendant.
    pub fn clear_error(&mut self) {
        if self.error.take().is_some() || self.robot_error.is_some() {
            self.robot_error = None;
            self.note_error(None);
        }
    }

    /// Errors, and `None` for each acknowledgement, since the last call; at most the newest [`MAX_NEW_ERRORS`].
    pub(crate) fn take_errors(&mut self) -> Vec<Option<ErrorEntry>> {
        std::mem::take(&mut self.new_errors)
    }

    fn note_error(&mut self, error: Option<ErrorEntry>) {
        if self.new_errors.len() >= MAX_NEW_ERRORS {
            self.new_errors.remove(0);
        }
        self.new_errors.push(error);
    }

    /// Changes the operation mode, as a key switch would.
    pub fn set_mode(&mut self, mode: OperationMode) {
        self.mode = mode;
    }
}

/// The robot states while the controller boots, with their durations.
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
/// Maximum number of errors that wait to be reported.
const MAX_NEW_ERRORS: usize = 64;
/// Minimum duration of a pause and a stop; a moving arm makes it longer.
const PAUSE: Duration = Duration::from_millis(20);
const STOP: Duration = Duration::from_millis(20);
const RECOVER: Duration = Duration::from_millis(200);
/// Fraction of the planned speed in the reduced safety state.
const REDUCED_RATE: f64 = 0.25;
