//! Printing to stdout and stderr, with handling of failures.
//!
//! Writing never panics. The first failure ends the command: silently if the reader closed the pipe, as
//! `head` does; otherwise with one message.

use std::io::{self, Write, stderr};
use std::process::ExitCode;

/// An output that stores its first failure; nothing is written after it.
#[derive(Debug)]
pub struct Out<W> {
    to: W,
    failed: Option<io::Error>,
}

impl<W: Write> Out<W> {
    /// Writes to `to`.
    pub fn new(to: W) -> Self {
        Self { to, failed: None }
    }

    /// Whether nothing more can be written.
    pub fn has_failed(&self) -> bool {
        self.failed.is_some()
    }

    /// The exit code of a command: that of `done`, unless output was lost.
    pub fn finish(mut self, done: impl FnOnce(Printed) -> ExitCode) -> ExitCode {
        let _ = self.flush();
        match self.failed {
            None => done(Printed::Whole),
            Some(error) if is_broken_pipe(&error) => done(Printed::Enough),
            Some(error) => {
                print_stderr(format_args!("stdout: {error}"));
                ExitCode::FAILURE
            }
        }
    }

    fn keep<T>(&mut self, attempt: impl FnOnce(&mut W) -> io::Result<T>) -> io::Result<T> {
        if let Some(error) = &self.failed {
            return Err(error.kind().into());
        }
        attempt(&mut self.to).inspect_err(|error| {
            if error.kind() != io::ErrorKind::Interrupted {
                self.failed = Some(again(error));
            }
        })
    }
}

/// How much of the output was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Printed {
    /// All of it.
    Whole,
    /// A part of it: the reader closed the pipe.
    Enough,
}

impl<W: Write> Write for Out<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.keep(|to| to.write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.keep(|to| to.flush())
    }
}

/// Whether a failure only means that the reader closed the pipe.
pub fn is_broken_pipe(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::BrokenPipe
}

/// Prints a line to stderr; a failure is ignored.
pub fn print_stderr(message: impl std::fmt::Display) {
    let _ = writeln!(stderr(), "{message}");
}

/// A copy of an error, with the system's text.
fn again(error: &io::Error) -> io::Error {
    error.raw_os_error().map_or_else(|| error.kind().into(), io::Error::from_raw_os_error)
}
