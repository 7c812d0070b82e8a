//! Findings about values that gave no command, and about presses that may be in discarded input.

use proto_core::config::{ConfigView, Recipe};
use proto_core::engine::{DropReason, Rejection};
use proto_core::sysvar::Direction;

use crate::bytes::count;
use crate::command::{REPORTED_FOR, ago, is_command};
use crate::finding::{Cause, Finding};
use crate::port_case::PortCase;
use crate::state::Withheld;

pub(crate) fn examine(seen: &PortCase<'_>, findings: &mut Vec<Finding>) {
    if !gives_commands(seen.case.config, seen.recipe) {
        return;
    }
    findings.extend(slept(seen));
    findings.extend(seen.status.not_given.as_ref().and_then(|withheld| no_command(seen, withheld)));
}

/// Whether a value of the recipe can pick a command.
fn gives_commands(config: ConfigView<'_>, recipe: &Recipe) -> bool {
    config.fields_of(recipe, Direction::Input).any(|(_, _, field)| is_command(field))
}

/// A value that should have been a command but picked none.
fn no_command(seen: &PortCase<'_>, withheld: &Withheld) -> Option<Finding> {
    let &Withheld { why, value, age, .. } = withheld;
    // A command since then shows that the device is understood.
    let given = seen.record.newest_command().map(|at| seen.case.status.at.saturating_since(at));
    if age >= REPORTED_FOR || given.is_some_and(|given| given <= age) {
        return None;
    }
    let (value, age) = (format!("value {value}"), ago(age));
    match why? {
        DropReason::Based => Some(seen.place.warning(
            Cause::FirstValue,
            format!(
                "{value} gave no command{age}: it was the first after the start, silence, sleep or a lost device"
            ),
            "another value before it: the first one only sets the base",
            "A button was pressed in the first frame, or the device sends only changes",
            "Release it and press again. If the device sends only changes, write base = \"keep\" beside commands, \
             a longer timeout_ms, and level for a stop button",
        )),
        DropReason::Unknown => Some(seen.place.warning(
            Cause::UnknownValue,
            format!("{value} gave no command{age}: it is in no entry of the table"),
            "a value of the table `commands`, or the idle one",
            "The device sends another number than the table has, or the field is at another place",
            "Add the value to `commands`, write it as `idle`, or correct the field",
        )),
        // The port's reply shows commands that were picked and not sent.
        _ => None,
    }
}

/// Input that was discarded because the gateway itself slept.
fn slept(seen: &PortCase<'_>) -> Option<Finding> {
    let last = seen.status.rejection.as_ref();
    let last = last.filter(|last| last.why == Rejection::Asleep && last.age < REPORTED_FOR);
    let counted = seen.counters.asleep as usize;
    if last.is_none() && counted == 0 {
        return None;
    }
    let age = last.map_or_else(String::new, |last| ago(last.age));
    let chunks = match counted {
        0 => "Input".to_owned(),
        _ => count(counted, "chunk") + " of input",
    };
    Some(seen.place.warning(
        Cause::Slept,
        format!(
            "{chunks} discarded{age}: the gateway itself had slept, and what waited is of an unknown age"
        ),
        "a gateway that is called at least twice a second",
        "The machine was suspended or overloaded; a button that was pressed meanwhile gave no command",
        "Press again. A panel that sends only changes should repeat its frame while stop is held",
    ))
}
