//! A timeline's file: TOML to checked steps, or the first mistake with its place.

use std::collections::VecDeque;

use proto_core::time::{Duration, Instant};
use recipe_config::SimConfig;
use recipe_config::file::{FileError, Source};
use serde::Deserialize;
use serde_json::{Map, Value};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::{StepTrigger, Timeline, TimelineStep};
use crate::Controller;
use crate::condition::Condition;
use crate::operations::{Operation, Refused, time};

impl Timeline {
    /// Reads a timeline for a controller of this configuration. `name` is the file's name in messages.
    ///
    /// # Errors
    /// The first mistake, with its place.
    pub fn parse(name: &str, text: &str, config: &SimConfig) -> Result<Self, FileError> {
        let file = File { name, text };
        let root = DeTable::parse(text).map_err(|error| {
            let message = error.message().split_whitespace().collect::<Vec<_>>().join(" ");
            file.error(error.span().map_or(0, |span| span.start), "", format!("invalid TOML: {message}"))
        })?;
        let mut trial = TrialController::new(config).map_err(|error| file.whole(error))?;
        let (mut steps, mut tables) = (Vec::<TimelineStep>::new(), Vec::new());
        for (key, value) in root.get_ref() {
            let DeValue::Array(items) = value.get_ref() else {
                return Err(file.error(key.span().start, key.get_ref(), UNKNOWN));
            };
            if key.get_ref() != "step" {
                return Err(file.error(key.span().start, key.get_ref(), UNKNOWN));
            }
            for (item, number) in items.iter().zip(1..) {
                let key = format!("step[{number}]");
                let DeValue::Table(table) = item.get_ref() else {
                    return Err(file.error(item.span().start, &key, "expected a table, written [[step]]"));
                };
                tables.push((key.clone(), table));
                steps.push(file.step(&key, item.span().start, table, &mut trial)?);
            }
        }
        for (step, (key, table)) in steps.iter().zip(tables) {
            let checked = trial.controller.check_program(&step.operation);
            checked.map_err(|error| file.nearest(&key, "program", table, &error))?;
        }
        Ok(Self { steps, began: None })
    }
}

struct File<'a> {
    name: &'a str,
    text: &'a str,
}

impl File<'_> {
    fn step(
        &self,
        key: &str,
        at: usize,
        table: &DeTable<'_>,
        trial: &mut TrialController,
    ) -> Result<TimelineStep, FileError> {
        let mut fields = Map::new();
        for (name, value) in table {
            let value = json(value)
                .map_err(|(at, message)| self.error(at, &format!("{key}.{}", name.get_ref()), message))?;
            fields.insert(name.get_ref().to_string(), value);
        }
        let place =
            |name: &str| table.iter().find(|(key, _)| key.get_ref() == name).map(|(_, v)| v.span().start);
        let wrong = |name: &str, message: &str| {
            self.error(place(name).unwrap_or(at), &format!("{key}.{name}"), message)
        };
        let seconds = |name: &str, value: Value| {
            let Some(seconds) = value.as_f64() else {
                return Err(wrong(name, &format!("{value} is not a number of seconds")));
            };
            time(name, seconds).map_err(|error| self.nearest(key, name, table, &error))
        };
        let (at_s, when) = (fields.remove("at_s"), fields.remove("when"));
        let (after_s, repeat) = (fields.remove("after_s"), fields.remove("repeat"));
        let trigger = match (at_s, when) {
            (Some(at_s), None) => {
                for (name, value) in [("after_s", &after_s), ("repeat", &repeat)] {
                    if value.is_some() {
                        return Err(wrong(
                            name,
                            "belongs to `when`; a step with `at_s` is done once, at that time",
                        ));
                    }
                }
                StepTrigger::At(seconds("at_s", at_s)?)
            }
            (None, Some(when)) => {
                let condition = Condition::deserialize(when).map_err(|error| Refused(error.to_string()));
                let condition = condition.and_then(|condition| condition.check().map(|()| condition));
                let condition = condition.map_err(|error| self.nearest(key, "when", table, &error))?;
                let repeat = match repeat {
                    None => false,
                    Some(Value::Bool(repeat)) => repeat,
                    Some(other) => return Err(wrong("repeat", &format!("{other} is not true or false"))),
                };
                let after = after_s.map_or(Ok(Duration::ZERO), |after| seconds("after_s", after))?;
                StepTrigger::When { condition: Box::new(condition), after, repeat, held: false, since: 0 }
            }
            (Some(_), Some(_)) => return Err(wrong("when", "a step has either `at_s` or `when`, not both")),
            (None, None) => {
                return Err(self.error(at, key, "at_s or when is missing: when the step is done"));
            }
        };
        let operation = Operation::from_json(fields).and_then(|operation| trial.check(operation));
        let operation = operation.map_err(|error| self.nearest(key, "do", table, &error))?;
        Ok(TimelineStep { trigger, operation, due: VecDeque::new(), done: None })
    }

    /// An error at the key or the value that its message names first, or at `otherwise`.
    fn nearest(&self, key: &str, otherwise: &str, table: &DeTable<'_>, error: &Refused) -> FileError {
        let named = |text: &str| find(table, text).map(|(path, at)| (format!("{key}.{path}"), at));
        let quoted = |quote: char| error.0.split(quote).nth(1).and_then(named);
        let before = error.0.split_once(": ").and_then(|(name, message)| Some((named(name)?, message)));
        // The place already includes the name.
        let (place, message) = match before {
            Some((place, message)) => (Some(place), message),
            None => (quoted('`').or_else(|| quoted('"')), error.0.as_str()),
        };
        let (path, at) = place.or_else(|| named(otherwise)).unwrap_or_else(|| (key.to_owned(), 0));
        self.error(if at == 0 { self.table_start(table) } else { at }, &path, message)
    }

    fn table_start(&self, table: &DeTable<'_>) -> usize {
        table.iter().map(|(key, _)| key.span().start).min().unwrap_or(0)
    }

    fn error(&self, at: usize, key: &str, message: impl Into<String>) -> FileError {
        let before = self.text.get(..at).unwrap_or(self.text);
        let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
        let source = Source::File {
            file: self.name.to_owned(),
            line: before.matches('\n').count() + 1,
            column: before.get(line_start..).unwrap_or("").chars().count() + 1,
        };
        FileError { source, key: key.to_owned(), message: message.into() }
    }

    fn whole(&self, message: String) -> FileError {
        FileError { source: Source::WholeFile { file: self.name.to_owned() }, key: String::new(), message }
    }
}

/// A controller of the same configuration, to check operations that do not depend on its state.
struct TrialController {
    controller: Controller,
}

impl TrialController {
    fn new(config: &SimConfig) -> Result<Self, String> {
        let controller = Controller::new(config).map_err(|error| error.to_string())?;
        Ok(Self { controller })
    }

    fn check(&mut self, operation: Operation) -> Result<Operation, Refused> {
        match &operation {
            reading if reading.is_reading() => {
                return Err(Refused(
                    "a timeline does only what changes something; use `when` to wait".into(),
                ));
            }
            // These depend on the state, and on the programs that exist then.
            Operation::Run { .. }
            | Operation::Remove { .. }
            | Operation::Stop {}
            | Operation::Pause {}
            | Operation::Resume {}
            | Operation::PowerOn {}
            | Operation::PowerOff {}
            | Operation::Enable {}
            | Operation::Disable {}
            | Operation::Restart { .. } => {}
            other => drop(self.controller.operate(NOW, other)?),
        }
        Ok(operation)
    }
}

/// The path and the place of the first key or string with this text.
fn find(table: &DeTable<'_>, text: &str) -> Option<(String, usize)> {
    table.iter().find_map(|(key, value)| {
        let name = key.get_ref();
        if name == text {
            return Some((name.to_string(), key.span().start));
        }
        let (path, at) = find_in(value, text)?;
        let dot = if path.is_empty() { "" } else { "." };
        Some((format!("{name}{dot}{path}"), at))
    })
}

fn find_in(value: &Spanned<DeValue<'_>>, text: &str) -> Option<(String, usize)> {
    match value.get_ref() {
        DeValue::Table(table) => find(table, text),
        DeValue::String(string) if string == text => Some((String::new(), value.span().start)),
        DeValue::Array(items) => items.iter().find_map(|item| find_in(item, text)),
        _ => None,
    }
}

/// The value as JSON, or the place of a value that JSON does not have.
fn json(value: &Spanned<DeValue<'_>>) -> Result<Value, (usize, String)> {
    let wrong = |message: &str| (value.span().start, message.to_owned());
    Ok(match value.get_ref() {
        DeValue::String(text) => Value::String(text.to_string()),
        DeValue::Integer(number) => {
            let number = i64::from_str_radix(number.as_str(), number.radix());
            Value::from(number.map_err(|_| wrong("the number is out of range"))?)
        }
        DeValue::Float(number) => {
            let number = number.as_str().parse().ok().and_then(serde_json::Number::from_f64);
            Value::Number(
                number.ok_or_else(|| wrong("not a finite number; a spoiled value is \"nan\" or \"inf\""))?,
            )
        }
        DeValue::Boolean(value) => Value::Bool(*value),
        DeValue::Datetime(_) => return Err(wrong("a date has no use here")),
        DeValue::Array(items) => Value::Array(items.iter().map(json).collect::<Result<_, _>>()?),
        DeValue::Table(table) => {
            let entries = table.iter().map(|(key, value)| Ok((key.get_ref().to_string(), json(value)?)));
            Value::Object(entries.collect::<Result<_, _>>()?)
        }
    })
}

const UNKNOWN: &str = "unknown key; a timeline has only steps, written [[step]]";
/// The time of all checks.
const NOW: Instant = Instant::from_millis(1);
