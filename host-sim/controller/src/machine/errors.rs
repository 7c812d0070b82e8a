//! The error numbers that `getlasterror` and the state stream show (docs/simulated-controller.md section 2).
//!
//! The interface description lists none; these numbers are the simulated controller's own.

/// An error's number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ErrorId {
    /// No program has this name.
    NoSuchProgram,
    /// A program ended with an error.
    ProgramFailed,
    /// A command came in a state that does not allow it.
    WrongState,
    /// A command's argument is out of range.
    BadArgument,
    /// A command was accepted, but its transition did not complete.
    NotCompleted,
    /// The emergency stop was pressed.
    EmergencyStop,
    /// A protective stop.
    ProtectiveStop,
    /// The arm has collided.
    Collision,
    /// The safety controller has failed.
    SafetyFailure,
    /// Raised by an operation at run time, which also chooses the number.
    Raised(u32),
}

impl ErrorId {
    /// The number that clients receive.
    pub const fn code(self) -> u32 {
        match self {
            Self::NoSuchProgram => 0x1001,
            Self::ProgramFailed => 0x1002,
            Self::WrongState => 0x2001,
            Self::BadArgument => 0x2002,
            Self::NotCompleted => 0x2003,
            Self::EmergencyStop => 0x3001,
            Self::ProtectiveStop => 0x3002,
            Self::Collision => 0x3003,
            Self::SafetyFailure => 0x3004,
            Self::Raised(code) => code,
        }
    }

    /// Whether the error concerns only one command, not the robot or a program.
    pub const fn is_refusal(self) -> bool {
        matches!(self, Self::NoSuchProgram | Self::WrongState | Self::BadArgument | Self::NotCompleted)
    }
}

/// The newest error.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ErrorEntry {
    /// Its number.
    pub id: ErrorId,
    /// One line of text.
    pub message: String,
}
