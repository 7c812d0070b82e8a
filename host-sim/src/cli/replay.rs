//! `replay`: a recorded run of the gateway again, in virtual time.
//!
//! In: a recording of `gateway --record`. Out: whether this program's engine decides the same, byte for byte.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use recipe_capture::replay::{Report, Stopped, replay};
use recipe_runtime::out::{Out, Printed};

use super::wrong;

/// Arguments of `replay`.
#[derive(Debug, Args)]
pub(super) struct ReplayArgs {
    /// A folder of recordings, of which the newest run is taken; any file of a run; or a plain recording
    recording: PathBuf,
    /// Also write a plain recording to this new file, for `proto_core::record` and a board's replay
    #[arg(long, value_name = "FILE")]
    plain: Option<PathBuf>,
}

pub(super) const EXAMPLES: &str = "\
Examples:
  host-sim gateway -c cell.toml --bind rs485-1=serial:/dev/ttyUSB0 --record run
  host-sim replay run                            the newest run in the folder
  host-sim replay run/20261122-204500-123.0001.mcap
  host-sim replay run --plain cell.rgr

The recording includes the configuration. This program's engine gets every recorded
input at its time, and its outputs are compared with the recorded ones.

Exit codes: 0 the same to the end; 1 something differs, or the recording has a gap;
2 it cannot be replayed.";

pub(super) fn run<W: Write>(args: &ReplayArgs, mut out: Out<W>) -> ExitCode {
    let plain = args.plain.as_ref().map(|path| {
        File::create_new(path).map(BufWriter::new).map_err(|error| format!("{}: {error}", path.display()))
    });
    let mut plain = match plain.transpose() {
        Ok(plain) => plain,
        Err(message) => return wrong(message),
    };
    let replayed = replay(&args.recording, plain.as_mut().map(|plain| plain as &mut dyn Write));
    if let Some(Err(error)) = plain.map(|mut plain| plain.flush()) {
        return wrong(format!("--plain: {error}"));
    }
    match replayed {
        Err(error) => wrong(error),
        Ok(report) => {
            let _ = out.write_all(show(&report).as_bytes());
            let code = if report.stopped.is_some() { ExitCode::FAILURE } else { ExitCode::SUCCESS };
            out.finish(|_: Printed| code)
        }
    }
}

fn show(report: &Report) -> String {
    let Report { starts, inputs, outputs, span, files, is_cut, stopped } = report;
    let seconds = span.map_or(0.0, |(first, last)| last.saturating_since(first).as_micros() as f64 / 1e6);
    let of = |count: u64, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
    let mut text = format!(
        "{}, {}, {} in {seconds:.3} s of the gateway's time, from {}\n",
        of(*starts, "start"),
        of(*inputs, "input"),
        of(*outputs, "output"),
        of(*files as u64, "file"),
    );
    if *is_cut {
        text += "a file ends within its last second, as that of a killed process does\n";
    }
    let first = span.map(|(first, _)| first).unwrap_or(proto_core::time::Instant::from_micros(0));
    let behind = |at: proto_core::time::Instant| {
        format!("{:.6} s behind the first input", at.saturating_since(first).as_micros() as f64 / 1e6)
    };
    match stopped {
        None => text += "the same to the end\n",
        Some(Stopped::Gap { at, missing }) => {
            let at = at.map_or("at the beginning".to_owned(), behind);
            text += &format!(
                "the same up to a gap, {at}: {} of the engine missing in the recording\n",
                of(u64::from(*missing), "call")
            );
        }
        Some(Stopped::Differs(difference)) => {
            text += &format!("differs, {}\n  for {}\n", behind(difference.at), difference.input);
            for (who, outputs) in [("recorded", &difference.recorded), ("replayed", &difference.replayed)] {
                for output in outputs {
                    text += &format!("  {who}: {output}\n");
                }
            }
        }
    }
    text
}
