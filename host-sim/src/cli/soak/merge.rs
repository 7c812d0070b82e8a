//! `soak merge`: one result of the shares of a run.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration as WallTime;

use clap::Args;
use recipe_cell::soak::{FORMAT, Level, Part};
use recipe_runtime::out::print_stderr;
use serde_json::Value;

use super::table::{failure, rare_outcomes, table};
use super::{PASS, wrong};

pub(super) const EXAMPLES: &str = "\
Give one file for each share, in any order, all with the same --hours, --seed, --faults,
--cell and host-sim. A file that is missing, given twice, or of another run is refused.
The table and the trace hash are those of one machine that has run everything; the wall
time is the longest.

Examples:
  host-sim soak merge 1.json 2.json 3.json
  host-sim soak merge shares/*.json --json > all.json

Exit codes: 0 all invariants held; 1 one was violated; 2 a file cannot be used.";

/// Arguments of `soak merge`.
#[derive(Debug, Args)]
pub(in crate::cli) struct MergeArgs {
    /// Outputs of `soak --shard NTH/OF --json`, one for each share
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Print one JSON document instead of the table
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &MergeArgs, out: &mut dyn Write) -> ExitCode {
    let parts: Result<Vec<_>, _> = args.files.iter().map(|file| read(file)).collect();
    let merged = parts.and_then(|parts| {
        Part::merge(&parts).map_err(|error| match error.nth.and_then(|nth| args.files.get(nth)) {
            Some(file) => format!("{}: {error}", file.display()),
            None => error.to_string(),
        })
    });
    let total = merged.and_then(|merged| Ok((merged.total()?, merged)));
    let (total, merged) = match total {
        Ok(total) => total,
        Err(message) => return wrong(message),
    };
    let cells: Vec<_> = merged.cells.iter().filter_map(|cell| cell.chosen.clone()).collect();
    let level =
        [Level::None, Level::Mild, Level::Harsh].into_iter().find(|level| level.name() == merged.faults);
    let rare = level.and_then(|level| rare_outcomes(&total, level));
    let failed = merged.failure.as_ref().map(|failed| failure(failed, &cells, &merged.faults)).or(rare);
    if args.json {
        let _ = writeln!(out, "{}", serde_json::to_string(&merged).unwrap_or_default());
        failed.iter().for_each(print_stderr);
    } else {
        let wall = WallTime::from_micros(merged.wall_us);
        let _ = write!(out, "{}", table(&total, merged.seed, &merged.faults, wall));
        let _ = writeln!(out, "\n{}", failed.as_deref().unwrap_or(PASS));
    }
    if failed.is_some() { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

fn read(file: &Path) -> Result<Part, String> {
    let of = |error: &dyn std::fmt::Display| format!("{}: {error}", file.display());
    let text = fs::read_to_string(file).map_err(|error| of(&format_args!("cannot be read: {error}")))?;
    let document: Value = serde_json::from_str(&text)
        .map_err(|error| of(&format_args!("not what `soak --json` prints: {error}")))?;
    // Said first: a document of another version may have other keys.
    match document.get("soak").and_then(Value::as_u64) {
        None => return Err(of(&"not what `soak --json` prints: there is no key soak with a number")),
        Some(format) if format != u64::from(FORMAT) => {
            return Err(of(&format_args!(
                "soak: format {format}; this host-sim reads {FORMAT}; run it with the same host-sim"
            )));
        }
        Some(_) => {}
    }
    serde_json::from_str(&text).map_err(|error| of(&format_args!("not what `soak --json` prints: {error}")))
}
