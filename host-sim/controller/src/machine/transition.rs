//! What commands begin, and what becomes of it (D25).

use proto_core::command::Action;

use super::{Machine, Program, Robot};

/// Counts of transitions begun: of two of a kind only the newest can still be under way.
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

/// What became of a [`Transition`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// It goes on.
    UnderWay,
    /// It came to where the command wanted it.
    Done,
    /// Another one began before.
    BrokenOff,
}

impl Machine {
    /// What became of a transition. To be asked after every change: when another one was begun, it
    /// counts as broken off, even if it was done before.
    pub fn progress(&self, transition: Transition) -> Progress {
        let program_rests = self.program == Program::Stopped;
        let done = match transition.action {
            Action::PowerOn => self.robot == Robot::Disabled,
            Action::PowerOff => self.robot == Robot::Off && program_rests,
            Action::Enable => self.robot == Robot::Enabled,
            Action::Disable => self.robot == Robot::Disabled && program_rests,
            Action::Stop => program_rests,
            Action::Pause => self.program == Program::Paused,
            Action::Resume => self.program == Program::Running,
            // Its end is the end of every connection: it is answered while it can be.
            Action::Shutdown => true,
        };
        let is_newest = match transition.action {
            Action::Stop | Action::Pause | Action::Resume => transition.begun.program == self.begun.program,
            _ => transition.begun.robot == self.begun.robot,
        };
        match (is_newest, done) {
            (false, _) => Progress::BrokenOff,
            (true, true) => Progress::Done,
            (true, false) => Progress::UnderWay,
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
