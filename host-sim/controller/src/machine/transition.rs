//! Transitions: how an accepted command is followed to its end (D25).

use proto_core::command::Action;

use super::{Machine, Program, Robot};

/// Numbers of transitions. Of each kind only the newest can be in progress.
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
    /// It is in progress.
    InProgress,
    /// It has reached the state that the command asked for.
    Done,
    /// Another one began before its end.
    Superseded,
}

impl Machine {
    /// The state of a transition. To be called after every change: once another transition has begun, this
    /// one counts as superseded, even if it was done.
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
            // It is answered at once, because its end closes every connection.
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
