//! Why a command did not do what it was asked for, and what the exit code says.

use std::fmt;
use std::io;

/// How a command ended that did what it was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing is wrong.
    Well,
    /// The gateway, or its doctor, says that something is.
    Trouble,
}

/// Why a command did not.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// The gateway refused, or was not reached.
    Refused(String),
    /// A file or an argument is wrong.
    Wrong(String),
    /// Nothing more can be printed.
    Printing,
}

impl Failure {
    /// A refusal in these words.
    pub fn refused(words: impl fmt::Display) -> Self {
        Self::Refused(words.to_string())
    }

    /// A mistake in a file or an argument, in these words.
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

/// Writing output is all that fails with such an error.
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
