//! Why a command failed, and the results that determine the exit code.

use std::fmt;
use std::io;

/// The result of a command that was executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing is wrong.
    Well,
    /// The gateway or its doctor reports a problem.
    Trouble,
}

/// Why a command was not executed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// The gateway refused the request or was not reached.
    Refused(String),
    /// A file or an argument is wrong.
    Wrong(String),
    /// Nothing more can be printed.
    Printing,
}

impl Failure {
    /// A refusal with this text.
    pub fn refused(words: impl fmt::Display) -> Self {
        Self::Refused(words.to_string())
    }

    /// A mistake in a file or an argument, with this text.
    pub fn wrong(words: impl fmt::Display) -> Self {
        Self::Wrong(words.to_string())
    }

    /// The message for people; empty if there is none.
    pub fn message(&self) -> &str {
        match self {
            Self::Refused(message) | Self::Wrong(message) => message,
            Self::Printing => "",
        }
    }
}

/// Only writing output fails with an `io::Error`.
impl From<io::Error> for Failure {
    fn from(_: io::Error) -> Self {
        Self::Printing
    }
}

impl From<recipe_config::file::FileError> for Failure {
    fn from(error: recipe_config::file::FileError) -> Self {
        Self::wrong(error)
    }
}
