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

/// Counts or runs `works` if the arguments ask for that; `None` when they ask for a timed benchmark.
pub(crate) fn main(works: &[Work]) -> Option<ExitCode> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.first().map(String::as_str) {
        Some("instructions") => Some(count_all(works)),
        Some("run") => {
            let (name, iterations) = (args.get(1)?, args.get(2)?.parse().ok()?);
            let work = works.iter().find(|work| work.name == name)?;
            (work.run)(iterations);
            Some(ExitCode::SUCCESS)
        }
        _ => None,
    }
}

fn count_all(works: &[Work]) -> ExitCode {
    let mut code = ExitCode::SUCCESS;
    for work in works {
        let counts = (count(work.name, FEW), count(work.name, MANY));
        let (Some(few), Some(many)) = counts else {
            eprintln!("skipped: valgrind does not run here, so no instructions were counted");
            return ExitCode::SUCCESS;
        };
        let each = (many - few) / (MANY - FEW);
        match work.limit {
            Some(limit) if each > limit => {
                println!("{:<40}{each:>8} instructions, OVER the limit of {limit}", work.name);
                code = ExitCode::FAILURE;
            }
            Some(limit) => println!("{:<40}{each:>8} instructions, limit {limit}", work.name),
            None => println!("{:<40}{each:>8} instructions", work.name),
        }
    }
    code
}

/// Instructions of a whole process that does the work `iterations` times.
fn count(name: &str, iterations: u64) -> Option<u64> {
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(std::env::current_exe().ok()?)
        .args(["run", name, &iterations.to_string()])
        .output()
        .ok()?;
    let report = String::from_utf8_lossy(&output.stderr);
    report.lines().find_map(|line| line.split("Collected : ").nth(1)?.trim().parse().ok())
}

const FEW: u64 = 1_000;
const MANY: u64 = 3_000;
