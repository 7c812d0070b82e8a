//! What a user is told of each fault: the table of `matrix.toml`, whose rows were written before the code.
//!
//! Here it is checked for being whole: each cause has a row, and each cell is a cause or says why it is none.

use std::collections::{BTreeMap, BTreeSet};

use recipe_doctor::Cause;
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Matrix {
    verdicts: BTreeSet<String>,
    new: BTreeSet<String>,
    reasons: BTreeMap<String, String>,
    places: BTreeMap<String, Vec<Row>>,
}

/// Name, fault, verdict, cause, what `check` says, exit code of `doctor`.
#[derive(Deserialize)]
struct Row(String, String, String, String, String, u8);

fn matrix() -> Matrix {
    toml::from_str(include_str!("matrix.toml")).unwrap()
}

#[test]
fn each_cell_is_a_cause_or_says_why_it_is_none() {
    let Matrix { verdicts, new, reasons, places } = matrix();
    let causes: BTreeSet<&str> =
        Cause::ALL.iter().map(|cause| cause.name()).chain(new.iter().map(String::as_str)).collect();
    let mut names = BTreeSet::new();
    for (place, rows) in &places {
        for Row(name, fault, verdict, cause, check, exit) in rows {
            assert!(names.insert(name), "{place}: {name} twice");
            assert!(!fault.is_empty() && verdicts.contains(verdict) && *exit <= 2, "{name}");
            let is_silent = cause == "-" && verdict == "arrives" && *exit == 0;
            assert!(is_silent || causes.contains(&**cause), "{name}: {cause}");
            let is_reason = check.strip_prefix('-').is_some_and(|reason| reasons.contains_key(reason));
            assert!(is_reason || causes.contains(&**check), "{name}: check says {check}");
        }
    }
    assert!(names.len() >= 120, "{} rows", names.len());
}

#[test]
fn each_cause_has_a_row() {
    let Matrix { new, places, .. } = matrix();
    let rows = || places.values().flatten();
    let expected: BTreeSet<&str> =
        rows().flat_map(|Row(_, _, _, cause, check, _)| [&**cause, &**check]).collect();
    for cause in Cause::ALL {
        assert!(expected.contains(cause.name()), "no row expects {}", cause.name());
        assert!(!new.contains(cause.name()), "{} is known now", cause.name());
    }
    for cause in &new {
        assert!(expected.contains(&**cause), "no row expects {cause}");
    }
}

#[test]
fn a_value_that_is_missing_or_wrong_is_never_nothing_found() {
    for Row(name, _, verdict, cause, _, exit) in matrix().places.into_values().flatten() {
        if ["missing", "wrong"].contains(&&*verdict) {
            assert!(cause != "-" && exit > 0, "{name}");
        }
    }
}
