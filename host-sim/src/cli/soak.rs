//! `soak`: cells in virtual time with faults and checks of everything that the gateway does, the replay of
//! a failed run, and one result of a run that several machines have shared.
//!
//! Progress goes to stderr, the table or the document to stdout.

mod merge;
mod table;

use std::io::{IsTerminal, Write};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration as WallTime, Instant as WallInstant};

use clap::{Args, Subcommand, ValueEnum};
use proto_core::time::Duration;
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::wrong;
use recipe_cell::Cell;
use recipe_cell::soak::{Batch, Level, Part, PartFailure, Progress, Scenario, Share, Soak, show_trace};
use recipe_runtime::out::print_stderr;
use table::{failure, progress_line, rare_outcomes, show_seconds, table};

pub(super) const EXAMPLES: &str = "\
Runs the gateway's engine against the simulated controller in virtual time. Devices
send valid and invalid data, networks and lines fail, both programs restart. An
independent model checks every step of the gateway: each value written was sent by its
owner, in time and once; lost edges are counted; nothing stale is shown; and so on. At
the robot's side it checks that values and commands are recent when they arrive, and
that stops and safe values do arrive (docs/cell.md).

The same seed gives the same trace hash on every machine and for any --jobs. A
violation is printed with the command that reproduces it.

Examples:
  host-sim soak                                  one hour
  host-sim soak --hours 24 --seed 42 --faults harsh
  host-sim soak --hours 2 --cell force-sensor --cell can-hand
  host-sim soak --cell cell.toml,robot.toml      your own gateway and controller
  host-sim soak --replay 93570312@41.250300 --trace

On three machines with the same host-sim, shards 1/3 to 3/3, then on one of them:
  host-sim soak --hours 72 --seed 42 --shard 1/3 --json > 1.json
  host-sim soak merge 1.json 2.json 3.json       the table and the hash of all 72 hours

Exit codes: 0 all invariants held; 1 one was violated; 2 an argument is invalid.";

/// Arguments of `soak`.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(super) struct SoakArgs {
    #[command(subcommand)]
    command: Option<SoakCommand>,
    /// Virtual hours of all runs together, such as 24 or 0.5, at most 100000
    #[arg(long, value_name = "HOURS", default_value = "1", value_parser = parse_hours)]
    hours: Duration,
    /// Seed from which the seeds of all runs are derived
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// How often faults are injected
    #[arg(long, value_name = "LEVEL", default_value = "harsh")]
    faults: LevelName,
    /// An embedded cell by name, such as force-sensor, or GATEWAY.toml,CONTROLLER.toml; repeatable
    /// [default: all embedded cells]
    #[arg(long, value_name = "CELL")]
    cell: Vec<String>,
    /// Number of threads, at most 1024 [default: one per processor]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Run only this share of the runs, such as 1/3; `soak merge` combines the results. Needs --json
    #[arg(long, value_name = "NTH/OF", requires = "json")]
    shard: Option<Share>,
    /// Print one JSON document instead of the table
    #[arg(long)]
    json: bool,
    /// Repeat one run up to this instant, with the same --cell and --faults
    #[arg(long, value_name = "SEED@SECONDS", value_parser = parse_replay, conflicts_with_all = ["shard", "json"])]
    replay: Option<(u64, Duration)>,
    /// With --replay: print the trace of the last two seconds
    #[arg(long, requires = "replay")]
    trace: bool,
}

#[derive(Debug, Subcommand)]
enum SoakCommand {
    /// Combine the results of all shares, as if one machine had run them
    #[command(after_help = merge::EXAMPLES)]
    Merge(merge::MergeArgs),
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum LevelName {
    /// No faults; devices still send invalid frames
    None,
    /// A fault every 30 s
    Mild,
    /// A fault every second, on a network that delays, splits and joins data
    Harsh,
}

impl From<LevelName> for Level {
    fn from(name: LevelName) -> Self {
        match name {
            LevelName::None => Self::None,
            LevelName::Mild => Self::Mild,
            LevelName::Harsh => Self::Harsh,
        }
    }
}

/// Runs a batch or a share of it, replays one run, or merges shares.
pub(super) fn run(args: &SoakArgs, out: &mut dyn Write) -> ExitCode {
    if let Some(SoakCommand::Merge(args)) = &args.command {
        return merge::run(args, out);
    }
    let scenarios = match scenarios(&args.cell) {
        Ok(scenarios) => scenarios,
        Err(message) => return wrong(message),
    };
    match args.replay {
        Some((seed, at)) => replay(args, &scenarios, seed, at, out),
        None => batch(args, scenarios, out),
    }
}

fn scenarios(cells: &[String]) -> Result<Vec<Scenario>, String> {
    let mut scenarios = Vec::new();
    for cell in cells {
        scenarios.push(match cell.split_once(',') {
            Some((gateway, controller)) => Scenario::load(Path::new(gateway), Path::new(controller))
                .map_err(|error| error.to_string())?,
            None => Scenario::named(cell).map_err(|error| error.to_string())?.ok_or_else(|| {
                let names: Vec<_> = Scenario::names().collect();
                format!(
                    "--cell {cell}: there is no such cell; there are {}; or give GATEWAY.toml,CONTROLLER.toml",
                    names.join(", ")
                )
            })?,
        });
    }
    if scenarios.is_empty() {
        scenarios = Scenario::all().map_err(|error| error.to_string())?;
    }
    for scenario in &scenarios {
        Cell::new(&scenario.gateway, &scenario.controller, 0)
            .map_err(|error| format!("--cell {}: {error}", scenario.name))?;
    }
    Ok(scenarios)
}

fn batch(args: &SoakArgs, scenarios: Vec<Scenario>, out: &mut dyn Write) -> ExitCode {
    let batch = Batch::new(scenarios, args.faults.into(), args.seed, args.hours);
    let share = args.shard.unwrap_or_default();
    if share.of() > batch.runs() {
        let runs = batch.runs();
        return wrong(format!("--shard {share}: there are only {runs} runs, so at most {runs} shards"));
    }
    let batch = Arc::new(batch.only(share));
    let jobs =
        args.jobs.map_or_else(|| std::thread::available_parallelism().map_or(1, usize::from), usize::from);
    let began = WallInstant::now();
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return wrong(error),
    };
    // Registered once, so that a signal between two calls of `recv` is not lost.
    let interrupt = {
        let _inside = runtime.enter();
        signal(SignalKind::interrupt())
    };
    let interrupt = match interrupt {
        Ok(interrupt) => interrupt,
        Err(error) => return wrong(error),
    };
    let workers = (0..jobs.min(batch.share_runs().len())).map(|_| {
        let batch = Arc::clone(&batch);
        std::thread::Builder::new().stack_size(STACK).spawn(move || batch.work())
    });
    let workers: Vec<_> = match workers.collect() {
        Ok(workers) => workers,
        Err(error) => return wrong(error),
    };
    let interrupted = runtime.block_on(watch(&batch, &workers, interrupt, began));
    batch.stop();
    for worker in workers {
        // Workers catch the panics of their runs.
        let _ = worker.join();
    }
    let wall = began.elapsed();
    let interrupted = interrupted.then(|| {
        let Progress { runs, .. } = batch.progress();
        format!("interrupted: {runs} of {} runs were finished", batch.share_runs().len())
    });
    let failed = batch
        .failure()
        .map(|failed| failure(&PartFailure::from(failed), &args.cell, Level::from(args.faults).name()));
    // Of one share nobody can say.
    let is_whole = share == Share::default() && interrupted.is_none() && failed.is_none();
    let rare = is_whole.then(|| rare_outcomes(&batch.total(), args.faults.into())).flatten();
    if args.json {
        let part = Part::of(&batch, &args.cell, wall.as_micros() as u64);
        let _ = writeln!(out, "{}", serde_json::to_string(&part).unwrap_or_default());
        failed.iter().chain(&interrupted).chain(&rare).for_each(print_stderr);
    } else {
        let total = batch.total();
        let _ = write!(out, "{}", table(&total, args.seed, Level::from(args.faults).name(), wall));
        let last = failed.as_ref().or(interrupted.as_ref()).or(rare.as_ref()).map_or(PASS, String::as_str);
        let _ = writeln!(out, "\n{last}");
    }
    if failed.is_some() || rare.is_some() { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

/// Shows progress until all workers are done; returns true after SIGINT.
async fn watch(
    batch: &Batch,
    workers: &[std::thread::JoinHandle<()>],
    mut interrupt: Signal,
    began: WallInstant,
) -> bool {
    let is_terminal = std::io::stderr().is_terminal();
    let mut shown = WallInstant::now();
    loop {
        let wait = if is_terminal { REDRAW_EVERY } else { LINE_EVERY };
        if shown.elapsed() >= wait {
            shown = WallInstant::now();
            let line = progress_line(batch.progress(), batch.span(), began.elapsed());
            if is_terminal {
                show(format_args!("\r{line}\x1B[K"));
            } else {
                print_stderr(line);
            }
        }
        if workers.iter().all(std::thread::JoinHandle::is_finished) {
            break;
        }
        tokio::select! {
            _ = interrupt.recv() => {
                if is_terminal {
                    print_stderr("");
                }
                return true;
            }
            () = tokio::time::sleep(POLL_EVERY) => {}
        }
    }
    if is_terminal {
        show("\r\x1B[K");
    }
    false
}

/// Writes progress; errors are ignored, since it is no result.
fn show(text: impl std::fmt::Display) {
    let _ = write!(std::io::stderr(), "{text}");
}

fn replay(args: &SoakArgs, scenarios: &[Scenario], seed: u64, at: Duration, out: &mut dyn Write) -> ExitCode {
    let Some(scenario) = Batch::scenario_of(scenarios, seed) else { return wrong("there are no cells") };
    let mut soak = match Soak::new(scenario, seed, args.faults.into()) {
        Ok(soak) => soak,
        Err(error) => return wrong(error),
    };
    let _ = writeln!(out, "cell {}, seed {seed}, faults {}", scenario.name, Level::from(args.faults).name());
    let shown = Duration::from_micros(at.as_micros().saturating_sub(SHOWN.as_micros()));
    soak.run_to(shown);
    if args.trace {
        soak.cell_mut().keep_trace(MAX_ENTRIES);
    }
    // One millisecond longer, to include the instant itself.
    soak.run_to(at + Duration::from_millis(1));
    if args.trace {
        let _ = write!(out, "{}", show_trace(&soak));
    }
    match soak.report().violation {
        Some((what, after)) => {
            let _ = writeln!(out, "\nFAIL  {} s: {what}", show_seconds(after));
            ExitCode::FAILURE
        }
        None => {
            let _ = writeln!(out, "\nall invariants held up to {} s", show_seconds(soak.elapsed()));
            ExitCode::SUCCESS
        }
    }
}

fn parse_hours(text: &str) -> Result<Duration, String> {
    let refused =
        || format!("{text:?} is not a number of hours above 0 and at most 100000, such as 24 or 0.5");
    let hours: f64 = text.parse().map_err(|_| refused())?;
    let micros = (hours * 3.6e9).round();
    if hours <= 100_000.0 && micros >= 1.0 {
        Ok(Duration::from_micros(micros as u64))
    } else {
        Err(refused())
    }
}

fn parse_replay(text: &str) -> Result<(u64, Duration), String> {
    let refused = || format!("{text:?} is not SEED@SECONDS, such as 93570312@41.250300");
    let (seed, at) = text.split_once('@').ok_or_else(refused)?;
    let (whole, fraction) = at.split_once('.').unwrap_or((at, ""));
    let digits = |text: &str| text.len() <= 6 && text.bytes().all(|byte| byte.is_ascii_digit());
    if whole.is_empty() || !digits(whole) || !digits(fraction) {
        return Err(refused());
    }
    let micros = format!("{fraction:0<6}").parse::<u64>().map_err(|_| refused())?;
    let seconds = whole.parse::<u64>().map_err(|_| refused())?;
    Ok((seed.parse().map_err(|_| refused())?, Duration::from_micros(seconds * 1_000_000 + micros)))
}

/// The last line of a run without a violation.
const PASS: &str = "PASS  all invariants held";
/// Time before the end of a replay that the trace shows.
const SHOWN: Duration = Duration::from_secs(2);
const MAX_ENTRIES: usize = 100_000;
/// A build for debugging moves whole cells through the stack.
const STACK: usize = 16 << 20;
const REDRAW_EVERY: WallTime = WallTime::from_millis(500);
const LINE_EVERY: WallTime = WallTime::from_secs(15);
const POLL_EVERY: WallTime = WallTime::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_instant_of_a_run_is_read_back_as_it_was_printed() {
        let at = Duration::from_micros(41_250_300);
        assert_eq!(parse_replay(&format!("7@{}", show_seconds(at))), Ok((7, at)));
        assert_eq!(parse_replay("7@5"), Ok((7, Duration::from_secs(5))));
        for wrong in ["", "7", "@", "7@", "7@.", "x@1", "7@1.1234567", "7@-1", "7@1s"] {
            assert!(parse_replay(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn hours_are_some() {
        assert_eq!(parse_hours("0.5"), Ok(Duration::from_secs(1_800)));
        for wrong in ["", "0", "-1", "nan", "inf", "1h", "100001"] {
            assert!(parse_hours(wrong).is_err(), "{wrong:?}");
        }
    }
}
