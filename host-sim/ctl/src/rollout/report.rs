//! The report of a rollout: a table for people, a document for programs, and how to continue.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::{BoardOutcome, Left, RolloutEntry};
use crate::failure::{Failure, Verdict};
use crate::table::{Look, TableCell, TableView, TextTable};
use crate::update::Health;

/// The result of a rollout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RolloutReport {
    /// The version of the firmware.
    pub version: String,
    /// The boards in the order of the inventory.
    pub entries: Vec<RolloutEntry>,
    /// Whether the end was requested.
    pub was_stopped: bool,
}

impl RolloutReport {
    /// The report of a rollout that has not begun.
    pub fn before<'a>(version: &str, names: impl Iterator<Item = &'a str>) -> Self {
        Self {
            version: version.to_owned(),
            entries: names.map(RolloutEntry::new).collect(),
            was_stopped: false,
        }
    }

    /// One line with the outcome of a board.
    pub fn line(entry: &RolloutEntry) -> String {
        format!("{}: {}", crate::shown::line(&entry.name), crate::shown::line(&entry.outcome.words().0))
    }

    /// The boards that have failed.
    pub fn failed(&self) -> impl Iterator<Item = &RolloutEntry> {
        self.entries.iter().filter(|entry| matches!(entry.outcome, BoardOutcome::Failed { .. }))
    }

    /// A table with a row for each board.
    pub fn table(&self, view: TableView) -> String {
        let health = |health: &Option<Health>| {
            health.as_ref().map_or(TableCell::of(""), |health| TableCell::of(health.to_string()))
        };
        let mut table = TextTable::new(&["gateway", "was", "before", "after", "outcome"]);
        for entry in &self.entries {
            let was = TableCell::of(entry.was.as_deref().unwrap_or_default());
            let (words, look) = entry.outcome.words();
            table.row([
                TableCell::of(&entry.name),
                was,
                health(&entry.before),
                health(&entry.after),
                TableCell::of(words).look(look),
            ]);
        }
        table.show(view)
    }

    /// The number of boards of each outcome, and how to continue.
    pub fn summary(&self) -> String {
        let count = |wanted: &str| self.entries.iter().filter(|entry| entry.outcome.name() == wanted).count();
        let (updated, already, failed) = (count("updated"), count("already"), count("failed"));
        let mut text = format!(
            "{} of {} boards run {}: {updated} updated, {already} before; {failed} failed",
            updated + already,
            self.entries.len(),
            self.version
        );
        let left: Vec<_> =
            self.entries.iter().filter(|entry| entry.outcome == BoardOutcome::NotBegun).collect();
        if let Some(first) = left.first() {
            let why = if self.was_stopped { "ended" } else { "stopped by the failure" };
            let name = crate::shown::line(&first.name);
            text += &format!("; {why}, {} not begun, from {name} on", left.len());
        }
        if !left.is_empty() || failed > 0 {
            text += "; the same command goes on with those that do not run it";
        }
        text
    }

    /// The report as a document.
    pub fn document(&self) -> Value {
        let health = |health: &Option<Health>| match health {
            Some(health) => {
                json!({ "health": health.word, "links_up": health.links_up, "ports_working": health.ports_working })
            }
            None => Value::Null,
        };
        let entry = |entry: &RolloutEntry| {
            let mut document = json!({
                "gateway": entry.name,
                "outcome": entry.outcome.name(),
                "was": entry.was,
                "before": health(&entry.before),
                "after": health(&entry.after),
            });
            if let BoardOutcome::Failed { step, why, left } = &entry.outcome {
                document["step"] = step.name().into();
                document["error"] = why.as_str().into();
                document["left"] = left.name().into();
            }
            document
        };
        let mut counts = BTreeMap::from(["updated", "already", "failed", "not_begun"].map(|name| (name, 0)));
        for entry in &self.entries {
            *counts.entry(entry.outcome.name()).or_default() += 1;
        }
        json!({
            "version": self.version,
            "stopped": self.was_stopped,
            "counts": counts,
            "gateways": self.entries.iter().map(entry).collect::<Vec<_>>(),
        })
    }

    /// The verdict for the exit code: well if all boards run the firmware.
    ///
    /// # Errors
    /// The summary if a board does not run it.
    pub fn verdict(&self) -> Result<Verdict, Failure> {
        let is_there =
            |entry: &RolloutEntry| matches!(entry.outcome, BoardOutcome::Updated | BoardOutcome::Already);
        match self.entries.iter().all(is_there) {
            true => Ok(Verdict::Well),
            false => Err(Failure::refused(self.summary())),
        }
    }
}

impl BoardOutcome {
    /// The name in a document.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::NotBegun => "not_begun",
            Self::Already => "already",
            Self::Updated => "updated",
            Self::Failed { .. } => "failed",
        }
    }

    pub(crate) fn words(&self) -> (String, Look) {
        match self {
            Self::NotBegun => ("not begun".into(), Look::Warning),
            Self::Already => ("ran it already".into(), Look::Well),
            Self::Updated => ("updated".into(), Look::Well),
            Self::Failed { step, why, left } => {
                let left = match left {
                    Left::Before => "runs the firmware before",
                    Left::OnTrial => "runs the new one on trial, until its time is over",
                    Left::New => "runs the new one",
                    Left::Unknown => "what it runs is not known",
                };
                (format!("failed at {}: {why}; {left}", step.name()), Look::Wrong)
            }
        }
    }
}
