//! `host-sim controller` and `host-sim gateway`: options, and the way from a file to a run.

mod cells;

use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;

use super::record::WatchArgs;
use super::{Overrides, check, wrong};
use recipe_config::SimConfig;
use recipe_controller::timeline::Timeline;
use recipe_io::bind::Bind;
use recipe_runtime::console::{self, ConfigFile, ConsoleOptions};
use recipe_runtime::controller::{ControllerOptions, MAX_FACTOR, MIN_FACTOR, Pace};
use recipe_runtime::log::Log;
use recipe_runtime::out::print_stderr;
use recipe_runtime::{EventsFile, PublisherConfig, ReadyFile, RunError, RunOptions, Scheduling};

/// Arguments of `controller` and `gateway`.
#[derive(Debug, Args)]
pub(super) struct RunArgs {
    #[command(flatten)]
    overrides: Overrides,
    /// Bind a port to a device (docs/devices.md); repeatable. Serial: pty:PATH, pty-paced:PATH,
    /// serial:/dev/ttyUSB0, tcp:HOST:PORT, tcp-listen:HOST:PORT. CAN: socketcan:vcan0, slcan-pty:PATH,
    /// slcan-tcp:HOST:PORT[,PATH]; with slcan-pty-unpaced and slcan-tcp-unpaced frames take no time. With
    /// --console, a port may be missing in the file and be added by a later revision
    #[arg(long, value_name = "NAME=DEVICE")]
    bind: Vec<Bind>,
    /// Write the actual addresses to this file (JSON) once everything is listening; removed at the end
    #[arg(long, value_name = "FILE")]
    ready: Option<PathBuf>,
    /// Print counters as a line of JSON at this interval, such as 1s or 200ms; the run ends when stdout is closed
    #[arg(long, value_name = "TIME", value_parser = parse_time)]
    stats: Option<Duration>,
    /// Do not request real-time scheduling (SCHED_FIFO)
    #[arg(long)]
    no_realtime: bool,
    /// Serve the HTTP API (docs/api.md) and its page at this address, such as 127.0.0.1:8480; port 0: any free port
    #[arg(long, value_name = "ADDRESS:PORT")]
    console: Option<SocketAddr>,
    /// File with the key that is needed for changes and from other machines: 32 hexadecimal digits, mode
    /// 0600; `host-sim ctl keygen FILE` makes one
    #[arg(long, value_name = "FILE", requires = "console")]
    console_key: Option<PathBuf>,
    /// Gateway only: keep the last 8 revisions of the configuration in this folder, and run the live one after
    /// a restart, unless the file was changed
    #[arg(long, value_name = "DIR", requires = "console")]
    console_state: Option<PathBuf>,
    /// The --console port of the other program on this machine, controller or gateway: its page becomes a tab
    #[arg(long, value_name = "PORT", requires = "console")]
    console_peer: Option<u16>,
}

/// Arguments of `gateway`.
#[derive(Debug, Args)]
pub(super) struct GatewayRun {
    /// The gateway file. Repeat it to serve several cells in one process, each named after its file without the
    /// extension; then write --bind CELL/NAME=DEVICE and --set CELL/KEY=VALUE
    #[arg(short, long, value_name = "FILE", required = true)]
    config: Vec<PathBuf>,
    /// Number of threads for several cells [default: one per processor]
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,
    #[command(flatten)]
    run: RunArgs,
    #[command(flatten)]
    watch: WatchArgs,
    /// Publish what this gateway knows to an MQTT broker (Sparkplug B), as this file says (docs/fleet.md). The broker
    /// cannot write or command anything
    #[arg(long, value_name = "FILE")]
    sparkplug: Option<PathBuf>,
}

/// Arguments of `controller`.
#[derive(Debug, Args)]
pub(super) struct ControllerRun {
    /// The controller file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    #[command(flatten)]
    run: RunArgs,
    /// How the controller's clock runs: real; factor=N, N times as fast as the machine's, 0.001 to 1000;
    /// stepped, moved only by `pendant advance` and `pendant wait`
    #[arg(long, value_name = "real|stepped|factor=N", default_value = "real", value_parser = parse_pace)]
    time: Pace,
    /// Seed for the phases of the state stream and of the ports' cycles, and for what `garbage` faults send;
    /// without it all phases are 0
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Write each event to this file as a line of JSON; the events file of an earlier run is replaced
    #[arg(long, value_name = "FILE")]
    events: Option<PathBuf>,
    /// Execute the operations in this file, each at its time or on its condition (docs/control.md)
    #[arg(long, value_name = "FILE")]
    timeline: Option<PathBuf>,
}

impl GatewayRun {
    pub(super) fn gateway(self, log: Log) -> ExitCode {
        let Self { config, threads, run, watch, sparkplug } = self;
        let path = match <[PathBuf; 1]>::try_from(config) {
            Ok([path]) => path,
            Err(files) => {
                if let Some(option) = watch.option().or(sparkplug.map(|_| "--sparkplug")) {
                    return wrong(format_args!("{option} is for one cell; run a gateway of its own for it"));
                }
                return match cells::prepare(&files, run, log) {
                    Ok((cells, options)) => {
                        finished(recipe_runtime::cells::run(cells, cells::threads(threads), &options))
                    }
                    Err(error) => finished(Err(error)),
                };
            }
        };
        if threads.is_some() {
            return wrong("--threads is for several cells; give -c FILE for each of them");
        }
        let overrides = run.overrides.set.clone();
        let loaded = check::load_gateway(&path, &overrides);
        let sparkplug = match sparkplug.as_deref().map(PublisherConfig::load).transpose() {
            Ok(sparkplug) => sparkplug,
            Err(error) => return wrong(error),
        };
        // Even if the file is wrong, a ready file of a killed run is removed.
        match (run.options(log), loaded) {
            (Ok(options), Ok(config)) => {
                if watch.takes_stdout() && options.stats.is_some() {
                    return wrong(
                        "--stats is for stdout, and so is --capture -; give the capture a file or a pipe",
                    );
                }
                let decoder = match watch.decoder(&path, &overrides) {
                    Ok(decoder) => decoder,
                    Err(error) => return finished(Err(error)),
                };
                let options =
                    RunOptions { stdout_is_taken: watch.takes_stdout(), decoder, sparkplug, ..options };
                let watching = match watch.start(&options.watch) {
                    Ok(watching) => watching,
                    Err(error) => return finished(Err(error)),
                };
                let result = match &options.console {
                    Some(console) => ConfigFile::read(&path, overrides)
                        .and_then(|file| recipe_runtime::console::run_gateway(file, console, &options)),
                    None => recipe_runtime::gateway::run(*config, options),
                };
                watching.finish();
                finished(result)
            }
            (_, Err(error)) => wrong(error),
            (Err(error), _) => finished(Err(error)),
        }
    }
}

impl RunArgs {
    fn options(self, log: Log) -> Result<RunOptions, RunError> {
        let ready = self.ready.map(ReadyFile::at).transpose()?;
        let scheduling = if self.no_realtime { Scheduling::Ordinary } else { Scheduling::FifoIfAllowed };
        let key = self.console_key.as_deref().map(console::read_key).transpose()?;
        let (state, peer) = (self.console_state, self.console_peer);
        let console = self.console.map(|address| ConsoleOptions { address, key, state, peer });
        let (binds, stats) = (self.bind, self.stats);
        Ok(RunOptions { binds, ready, stats, scheduling, console, log: Some(log), ..RunOptions::default() })
    }
}

impl ControllerRun {
    pub(super) fn controller(self, log: Log) -> ExitCode {
        let loaded = check::load_controller(&self.config, &self.run.overrides.set);
        let loaded = loaded.map_err(|error| error.to_string()).and_then(|config| {
            let timeline = self.timeline.as_deref().map(|path| read_timeline(path, &config)).transpose()?;
            Ok((config, timeline))
        });
        match (self.options(log), loaded) {
            (Ok(options), Ok((config, timeline))) => {
                finished(recipe_runtime::controller::run(config, ControllerOptions { timeline, ..options }))
            }
            (_, Err(error)) => wrong(error),
            (Err(error), _) => finished(Err(error)),
        }
    }

    fn options(self, log: Log) -> Result<ControllerOptions, RunError> {
        let Self { run, time: pace, seed, events, .. } = self;
        if run.console_state.is_some() {
            return Err(RunError::new("--console-state: a simulated controller keeps no revisions"));
        }
        let events = events.map(EventsFile::at).transpose()?;
        Ok(ControllerOptions { run: run.options(log)?, pace, seed, events, timeline: None })
    }
}

fn read_timeline(path: &Path, config: &SimConfig) -> Result<Timeline, String> {
    let name = path.display().to_string();
    let text = std::fs::read_to_string(path).map_err(|error| format!("{name}: cannot be read: {error}"))?;
    Timeline::parse(&name, &text, config).map_err(|error| error.to_string())
}

fn finished(result: Result<(), RunError>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            print_stderr(&error);
            ExitCode::from(error.exit_code())
        }
    }
}

/// A time such as `1s`, `200ms` or `2m`.
pub(super) fn parse_time(text: &str) -> Result<Duration, String> {
    let refused = || format!("{text:?} is not a time; write 1s, 200ms or 2m");
    let digits = text.len() - text.trim_start_matches(|c: char| c.is_ascii_digit() || c == '.').len();
    let (number, unit) = text.split_at(digits);
    let number: f64 = number.parse().map_err(|_| refused())?;
    let seconds = match unit {
        "ms" => number / 1e3,
        "s" => number,
        "m" => number * 60.0,
        _ => return Err(refused()),
    };
    match Duration::try_from_secs_f64(seconds) {
        Ok(time) if time >= Duration::from_millis(1) => Ok(time),
        _ => Err(refused()),
    }
}

/// How a clock runs.
fn parse_pace(text: &str) -> Result<Pace, String> {
    match (text, text.strip_prefix("factor=")) {
        ("real", _) => Ok(Pace::Real),
        ("stepped", _) => Ok(Pace::Stepped),
        (_, Some(factor)) => match factor.parse() {
            Ok(factor) if (MIN_FACTOR..=MAX_FACTOR).contains(&factor) => Ok(Pace::Factor(factor)),
            _ => Err(format!("factor: {factor} is not within {MIN_FACTOR} to {MAX_FACTOR}")),
        },
        _ => Err(format!("{text:?} is not real, stepped or factor=N")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_need_a_unit() {
        assert_eq!(parse_time("200ms"), Ok(Duration::from_millis(200)));
        assert_eq!(parse_time("1.5s"), Ok(Duration::from_millis(1500)));
        assert_eq!(parse_time("2m"), Ok(Duration::from_secs(120)));
        for wrong in ["", "1", "s", "1h", "0s", "-1s", "1e9s"] {
            assert!(parse_time(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn a_clock_is_real_stepped_or_has_a_factor() {
        assert_eq!(parse_pace("stepped"), Ok(Pace::Stepped));
        assert_eq!(parse_pace("factor=0.5"), Ok(Pace::Factor(0.5)));
        for wrong in ["", "Real", "20", "factor=", "factor=0", "factor=-1", "factor=nan", "factor=1e9"] {
            assert!(parse_pace(wrong).is_err(), "{wrong:?}");
        }
    }
}
