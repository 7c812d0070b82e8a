//! One mistake in a file or an override, on one line.

use std::fmt;

/// A mistake, displayed as `FILE:LINE:COLUMN: KEY: what is wrong; what is allowed`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileError {
    /// The place.
    pub source: Source,
    /// The key as a path, such as `port.rs485-1.baud`; empty if the text is not TOML.
    pub key: String,
    /// What is wrong, and what is allowed.
    pub message: String,
}

/// The place of a mistake.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// In a file, counted from 1.
    File {
        /// The file's name.
        file: String,
        /// Line.
        line: usize,
        /// Column, in characters.
        column: usize,
    },
    /// The file as a whole.
    WholeFile {
        /// The file's name.
        file: String,
    },
    /// In a `--set` override.
    Override {
        /// The override's text.
        text: String,
    },
}

impl fmt::Display for FileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.source {
            Source::File { file, line, column } => {
                write_line(f, file)?;
                write!(f, ":{line}:{column}: ")?;
            }
            Source::WholeFile { file } => {
                write_line(f, file)?;
                f.write_str(": ")?;
            }
            Source::Override { text } => {
                f.write_str("--set ")?;
                write_line(f, text)?;
                f.write_str(": ")?;
            }
        }
        if !self.key.is_empty() {
            write_line(f, &self.key)?;
            f.write_str(": ")?;
        }
        write_line(f, &self.message)
    }
}

impl std::error::Error for FileError {}

/// Keeps a message on one line, whatever a key or a value contains.
fn write_line(f: &mut fmt::Formatter<'_>, text: &str) -> fmt::Result {
    for c in text.chars() {
        if c.is_control() { write!(f, "{}", c.escape_default())? } else { write!(f, "{c}")? }
    }
    Ok(())
}
