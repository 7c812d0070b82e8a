//! `host-sim doctor`: listens for some seconds as a gateway would, and says what is wrong.
//!
//! In: a gateway file, devices, a time. Out: findings in words or as JSON, and an exit code: 0 nothing found,
//! 1 findings (a note alone is none), 2 a file or an argument is wrong and nothing was started.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use recipe_doctor::{FILE, Finding, Severity};
use recipe_io::bind::Bind;
use recipe_runtime::out::{Printed, print_stderr};
use serde_json::json;

use super::run::parse_time;
use super::{Out, Overrides, check, wrong};

pub(super) const EXAMPLES: &str = "\
Nothing is sent to the controller: no value, no command, no frame. Its state stream is
read; its other TCP ports are connected to and closed at once. Its UDP server is not
tested: that would take a frame. Stop the gateway first: a device has one owner.

Nothing is sent to the field either, so devices that only reply, such as Modbus slaves,
stay silent. --ask sends the requests of the file's exchanges, writes included.

Examples:
  host-sim doctor -c cell.toml --bind rs485-1=serial:/dev/ttyUSB0
  host-sim doctor -c cell.toml --bind line=serial:/dev/ttyUSB0 --ask --for 20s
  host-sim doctor -c cell.toml --bind can=socketcan:can0 --json
  host-sim gateway -v -c cell.toml --bind rs485-1=serial:/dev/ttyUSB0
                                                 the same findings, while the gateway runs

docs/trouble.md lists symptoms, causes and remedies.

Exit codes: 0 nothing found, or notes only; 1 something found; 2 a file or an argument
is invalid and nothing was started.";

/// Arguments of `doctor`.
#[derive(Debug, Args)]
pub(super) struct DoctorArgs {
    /// The gateway file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
    /// Bind a port to a device, as for `gateway`
    #[arg(long, value_name = "NAME=DEVICE")]
    bind: Vec<Bind>,
    /// How long to listen, such as 5s or 1m; longer for devices that send rarely
    #[arg(long = "for", value_name = "TIME", default_value = "6s", value_parser = parse_time)]
    time: Duration,
    /// Send the requests of exchanges, as the gateway does: a device may move
    #[arg(long)]
    ask: bool,
    /// Print the findings as a JSON array
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: DoctorArgs) -> ExitCode {
    let config = match check::load_gateway(&args.config, &args.overrides.set) {
        Ok(config) => config,
        Err(error) => return wrong(error),
    };
    let findings = match recipe_runtime::gateway::listen(*config, args.bind, args.time, args.ask) {
        Ok(findings) => {
            findings.into_iter().map(|finding| with_file(finding, &args.config)).collect::<Vec<_>>()
        }
        Err(error) => {
            print_stderr(&error);
            return ExitCode::from(error.exit_code());
        }
    };
    let mut out = Out::new(io::stdout());
    let printed = if args.json { print_json(&mut out, &findings) } else { print_words(&mut out, &findings) };
    let is_well = findings.iter().all(|finding| finding.severity == Severity::Note);
    out.finish(|end| match (end, printed) {
        (Printed::Whole, Err(error)) => wrong(error),
        _ => ExitCode::from(u8::from(!is_well)),
    })
}

/// With the file's name in the command of the remedy.
fn with_file(mut finding: Finding, file: &Path) -> Finding {
    let (before, after) =
        (format!("host-sim decode {FILE} "), format!("host-sim decode {} ", file.display()));
    finding.remedy = finding.remedy.replace(&before, &after);
    finding
}

fn print_json(out: &mut dyn Write, findings: &[Finding]) -> io::Result<()> {
    writeln!(out, "{}", json!(findings))
}

fn print_words(out: &mut dyn Write, findings: &[Finding]) -> io::Result<()> {
    if findings.is_empty() {
        return writeln!(out, "nothing found");
    }
    for finding in findings {
        writeln!(out, "{}: {}: {}", finding.severity.name(), finding.place, finding.seen)?;
        if !finding.expected.is_empty() {
            writeln!(out, "  expected  {}", finding.expected)?;
        }
        writeln!(out, "  likely    {}", finding.likely)?;
        writeln!(out, "  remedy    {}", finding.remedy)?;
    }
    Ok(())
}
