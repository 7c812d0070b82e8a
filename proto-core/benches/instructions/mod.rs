//! Instruction counts of a benchmark's work, repeatable to the instruction where times are not.
//!
//! `cargo bench -p proto-core --bench NAME -- instructions` runs each work twice under callgrind,
//! with different numbers of iterations; the difference of the two counts, divided by the
//! difference of the iterations, is one iteration's count without start-up and shut-down.

use std::process::{Command, ExitCode};

/// One thing to count.
pub(crate) struct Work {
    /// What it is called in the table.
    pub(crate) name: &'static str,
    /// The most instructions it may take, where a limit is set.
    pub(crate) limit: Option<u64>,
    /// Does it this many times.
    pub(crate) run: fn(u64),
}

/// A limit that depends on another work's count.
#[derive(Clone, Copy)]
pub(crate) struct Beside {
    /// The limited work.
    pub(crate) name: &'static str,
    /// The work it is compared with.
    pub(crate) bare: &'static str,
    /// The most it may take.
    pub(crate) limit: Limit,
}

/// How much more than its bare limit a work may take.
#[derive(Clone, Copy)]
#[allow(dead_code, reason = "not every benchmark has such limits")]
pub(crate) enum Limit {
    /// So many times as many instructions.
    Times(f64),
    /// So many instructions more.
    Plus(u64),
}

/// Counts or runs `works` if the arguments ask for that; `None` when they ask for a timed benchmark.
#[allow(dead_code, reason = "benchmarks with limits beside each other call the other one")]
pub(crate) fn main(works: &[Work]) -> Option<ExitCode> {
    main_beside(works, &[])
}

/// The same, with limits beside each other.
pub(crate) fn main_beside(works: &[Work], beside: &[Beside]) -> Option<ExitCode> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.first().map(String::as_str) {
        Some("instructions") => Some(count_all(works, beside)),
        Some("run") => {
            let (name, iterations) = (args.get(1)?, args.get(2)?.parse().ok()?);
            let work = works.iter().find(|work| work.name == name)?;
            (work.run)(iterations);
            Some(ExitCode::SUCCESS)
        }
        _ => None,
    }
}

fn count_all(works: &[Work], beside: &[Beside]) -> ExitCode {
    let mut code = ExitCode::SUCCESS;
    let mut counts_of = Vec::new();
    for work in works {
        let counts = (count(work.name, FEW), count(work.name, MANY));
        let (Some(few), Some(many)) = counts else {
            eprintln!("skipped: valgrind does not run here, so no instructions were counted");
            return ExitCode::SUCCESS;
        };
        let each = (many - few) / (MANY - FEW);
        counts_of.push((work.name, (many - few) as f64 / (MANY - FEW) as f64));
        match work.limit {
            Some(limit) if each > limit => {
                println!("{:<40}{each:>8} instructions, OVER the limit of {limit}", work.name);
                code = ExitCode::FAILURE;
            }
            Some(limit) => println!("{:<40}{each:>8} instructions, limit {limit}", work.name),
            None => println!("{:<40}{each:>8} instructions", work.name),
        }
    }
    for pair in beside {
        let count_of = |name| counts_of.iter().find(|count| count.0 == name).map_or(0.0, |count| count.1);
        let (taken, bare) = (count_of(pair.name), count_of(pair.bare));
        let (over, text) = match pair.limit {
            Limit::Times(factor) => {
                (taken > factor * bare, format!("{:.2} times, limit {factor}", taken / bare))
            }
            Limit::Plus(more) => {
                (taken > bare + more as f64, format!("plus {:.1}, limit {more}", taken - bare))
            }
        };
        println!("{}: {:?} {text}{}", pair.name, pair.bare, if over { ", OVER" } else { "" });
        if over {
            code = ExitCode::FAILURE;
        }
    }
    code
}

/// Instructions of a whole process that does the work `iterations` times.
pub(crate) fn count(name: &str, iterations: u64) -> Option<u64> {
    let output = Command::new("valgrind")
        // A work may become another program.
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null", "--trace-children=yes"])
        .arg(std::env::current_exe().ok()?)
        .args(["run", name, &iterations.to_string()])
        .output()
        .ok()?;
    let report = String::from_utf8_lossy(&output.stderr);
    report.lines().find_map(|line| line.split("Collected : ").nth(1)?.trim().parse().ok())
}

const FEW: u64 = 1_000;
const MANY: u64 = 3_000;
