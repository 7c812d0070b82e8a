//! Results of programs (docs/control.md section 3).

use serde::Serialize;

use super::Controller;
use super::program::End;

/// An ended run of a program.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Run {
    /// Number of the run, from 1.
    pub run: u64,
    /// The program's name.
    pub program: String,
    /// How it ended.
    pub outcome: RunOutcome,
    /// Why it failed, or what stopped it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The line in the script where it failed, from 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub line: Option<usize>,
    /// The column, from 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub column: Option<usize>,
    /// When it was started, in seconds since the controller's start.
    pub started_s: f64,
    /// When the program had ended and the arm was at rest.
    pub ended_s: f64,
}

/// How a program ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RunOutcome {
    /// The program reached its end.
    Finished,
    /// The program did not catch an error.
    Failed,
    /// A command, a person or a safety stop has ended the program.
    Stopped,
}

impl std::fmt::Display for Run {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { run, program, .. } = self;
        let seconds = self.ended_s - self.started_s;
        match self.outcome {
            RunOutcome::Finished => write!(f, "run {run} of {program} has finished after {seconds:.3} s"),
            RunOutcome::Failed => {
                write!(f, "run {run} of {program} has failed: {}", self.reason.as_deref().unwrap_or("?"))?;
                match (self.line, self.column) {
                    (Some(line), Some(column)) => write!(f, " (line {line}, column {column})"),
                    _ => Ok(()),
                }
            }
            RunOutcome::Stopped => {
                write!(f, "run {run} of {program} was stopped: {}", self.reason.as_deref().unwrap_or("?"))
            }
        }
    }
}

#[derive(Debug, Default)]
pub(super) struct Runs {
    pub started: u64,
    started_s: f64,
    /// Why the running program is being ended, if it is.
    cause: Option<&'static str>,
    last: Option<Run>,
}

impl Runs {
    pub(super) fn begin(&mut self, time_s: f64) -> u64 {
        self.started += 1;
        (self.started_s, self.cause) = (time_s, None);
        self.started
    }

    /// The first cause counts.
    pub(super) fn ends_by(&mut self, cause: &'static str) {
        self.cause.get_or_insert(cause);
    }

    pub(super) fn end(&mut self, program: &str, end: Option<&End>, time_s: f64) -> Run {
        let failure = match end {
            Some(End::Failed(message)) => Some(position_of(message)),
            _ => None,
        };
        let (outcome, reason, place) = match (failure, end) {
            (Some((reason, place)), _) => (RunOutcome::Failed, Some(reason), place),
            (None, Some(End::Finished)) => (RunOutcome::Finished, None, None),
            (None, _) => (RunOutcome::Stopped, Some(self.cause.unwrap_or("stop").to_owned()), None),
        };
        let run = Run {
            run: self.started,
            program: program.to_owned(),
            outcome,
            reason,
            line: place.map(|place| place.0),
            column: place.map(|place| place.1),
            started_s: self.started_s,
            ended_s: time_s,
        };
        self.last = Some(run.clone());
        run
    }

    pub(super) fn forget(&mut self) {
        (self.cause, self.last) = (None, None);
    }
}

impl Controller {
    /// The last ended run since the controller was switched on.
    pub fn last_run(&self) -> Option<&Run> {
        self.runs.last.as_ref()
    }

    /// Number of programs started so far.
    pub fn runs(&self) -> u64 {
        self.runs.started
    }
}

/// The text and the position of an interpreter's message, which ends with `(line 7, position 5)`.
fn position_of(message: &str) -> (String, Option<(usize, usize)>) {
    let place = || {
        let (text, place) = message.strip_suffix(')')?.rsplit_once("(line ")?;
        let (line, column) = place.split_once(", position ")?;
        Some((text.trim_end().to_owned(), (line.parse().ok()?, column.parse().ok()?)))
    };
    match place() {
        Some((text, place)) => (text, Some(place)),
        None => (message.to_owned(), None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_has_its_position_if_one_is_known() {
        let found = position_of("Runtime error: no (part) (line 7, position 5)");
        assert_eq!(found, ("Runtime error: no (part)".to_owned(), Some((7, 5))));
        for none in ["no part", "no part (line 7)", "(line 7, position 5) no part", ")"] {
            assert_eq!(position_of(none), (none.to_owned(), None));
        }
    }
}
