//! Transitions: from an accepted command to its result (D25).

use proto_core::command::Action;

use super::{Machine, Program, Robot};

/// Number of transitions of each kind. Only the newest of a kind can be in progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Begun {
    pub(super) robot: u64,
    pub(super) program: u64,
}

/// A transition that a command has begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transition {
    pub(super) action: Action,
    pub(super) begun: Begun,
}

impl Transition {
    /// The command.
    pub fn action(self) -> Action {
        self.action
    }
}

/// The state of a [`Transition`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransitionProgress {
    /// The transition is in progress.
    InProgress,
    /// The requested state is reached.
    Done,
    /// Another transition began before the end of this one.
    Superseded,
}

impl Machine {
    /// The state of a transition. Call it after every change: once another transition has begun, this one counts as
    /// superseded, even if it was done.
    pub fn progress(&self, transition: Transition) -> TransitionProgress {
        let program_rests = self.program == Program::Stopped;
        let done = match transition.action {
            Action::PowerOn => self.robot == Robot::Disabled,
            Action::PowerOff => self.robot == Robot::Off && program_rests,
            Action::Enable => self.robot == Robot::Enabled,
            Action::Disable => self.robot == Robot::Disabled && program_rests,
            Action::Stop => program_rests,
            Action::Pause => self.program == Program::Paused,
            Action::Resume => self.program == Program::Running,
            // Answered at once, because its end closes every connection.
            Action::Shutdown => true,
        };
        let is_newest = match transition.action {
            Action::Stop | Action::Pause | Action::Resume => transition.begun.program == self.begun.program,
            _ => transition.begun.robot == self.begun.robot,
        };
        match (is_newest, done) {
            (false, _) => TransitionProgress::Superseded,
            (true, true) => TransitionProgress::Done,
            (true, false) => TransitionProgress::InProgress,
        }
    }

    pub(super) fn begin_robot(&mut self, robot: Robot) {
        self.robot = robot;
        self.begun.robot += 1;
    }

    pub(super) fn begin_program(&mut self, program: Program) {
        self.program = program;
        self.begun.program += 1;
    }
}
