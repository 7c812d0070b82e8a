//! The command line.
//!
//! In: arguments. Out: text and an exit code: 0 for success, 1 if a run failed or its output could not be
//! written, 2 if a file or an argument cannot be used (nothing was started then). A reader that closes the
//! pipe is no failure.

mod check;
mod convert;
mod ctl;
mod doctor;
mod exchange_report;
mod export;
mod extcap;
mod fleet;
mod frame;
mod image;
mod log;
mod new;
mod output;
mod pendant;
mod plan;
mod record;
mod replay;
mod run;
mod scale;
mod soak;
mod text;
mod values;

use std::ffi::OsString;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};
use proto_core::sysvar::Direction;

use convert::codec::{CompiledPart, ExchangePart};
use recipe_config::file;
use recipe_runtime::out::{Out, Printed, print_stderr};

/// The arguments of `host-sim`.
#[derive(Debug, Parser)]
#[command(
    name = "host-sim",
    version,
    about = "A simulated DUCO CORE controller and the recipe gateway, on this host",
    long_about = "A simulated DUCO CORE controller and the recipe gateway, on this host.\n\n\
                  Without a command it runs the demo: a whole cell in one process, no hardware needed.",
    after_help = TOP_EXAMPLES,
    propagate_version = true
)]
pub struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    /// Log more to stderr: -v events, -vv every frame
    #[arg(short, long, action = clap::ArgAction::Count, global = true)]
    verbose: u8,
}

const TOP_EXAMPLES: &str = "\
Examples:
  host-sim                                       the demo
  host-sim new --device robotiq-ft300 -o cell.toml
                                                 a gateway file for a known device
  host-sim check cell.toml                       check the file; see what to set on the pendant
  host-sim controller -c robot.toml --bind rs485=pty:run/rs485
  host-sim pendant --ready run/ready.json set DI[3]=1
                                                 act on the controller while it runs
  host-sim gateway -c cell.toml --bind rs485-1=serial:/dev/ttyUSB0
  host-sim doctor -c cell.toml --bind rs485-1=serial:/dev/ttyUSB0
                                                 why does it not work?
  host-sim ctl --to 192.168.0.20 status          query a running gateway
  host-sim encode cell.toml --part input 1       the frame that switches DO1 on
  host-sim decode cell.toml --part input FF FF 01 EE EE

Exit codes: 0 done, 1 a run failed or its output could not be written, 2 a file or
an argument is invalid and nothing was started.";

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a whole cell in one process: check the six worked examples, or with --console serve it to a browser
    #[command(after_help = DEMO_EXAMPLES)]
    Demo {
        /// Run a cell until Ctrl-C, with the gateway's page at this address and the controller's at the next
        /// port; port 0: any free ports; without an address 127.0.0.1:8480
        #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:8480")]
        console: Option<SocketAddr>,
    },
    /// Run the simulated controller
    #[command(after_help = CONTROLLER_EXAMPLES)]
    Controller(run::ControllerRun),
    /// Run the gateway between field devices and the controller
    #[command(after_help = GATEWAY_EXAMPLES)]
    Gateway(run::GatewayRun),
    /// Listen for a few seconds and report what is wrong with ports, devices, links and the controller's mode
    #[command(after_help = doctor::EXAMPLES)]
    Doctor(doctor::DoctorArgs),
    /// Query and change running gateways, on hosts and boards: state, frames, configuration, firmware
    #[command(after_help = ctl::EXAMPLES)]
    Ctl(ctl::CtlArgs),
    /// Operate a running simulated controller: press buttons, set inputs, inject faults, watch its state
    #[command(after_help = pendant::EXAMPLES)]
    Pendant(pendant::PendantArgs),
    /// List known field devices; print or write a gateway file for one
    #[command(after_help = new::EXAMPLES)]
    New(new::NewArgs),
    /// Check a file; print the bus load, the route of each variable and what to set on the pendant
    #[command(after_help = CHECK_EXAMPLES)]
    Check(check::CheckArgs),
    /// Compile a gateway file to the configuration image that a board reads
    #[command(after_help = IMAGE_EXAMPLES)]
    Image(image::ImageArgs),
    /// Write files for other tools: a CAN database, a Wireshark dissector, a table of variables, a JSON Schema
    #[command(after_help = export::EXAMPLES)]
    Export(export::ExportArgs),
    /// Let Wireshark capture from a running gateway (extcap)
    #[command(after_help = extcap::EXAMPLES)]
    Extcap(extcap::ExtcapArgs),
    /// Run many simulated Sparkplug edge nodes against an MQTT broker, and print what they do
    #[command(after_help = fleet::EXAMPLES)]
    Fleet(fleet::FleetArgs),
    /// Replay a recorded run through the gateway's engine, in virtual time, and compare the outputs
    #[command(after_help = replay::EXAMPLES)]
    Replay(replay::ReplayArgs),
    /// Run cells in virtual time with injected faults, and check everything that the gateway does
    #[command(after_help = soak::EXAMPLES)]
    Soak(soak::SoakArgs),
    /// Encode values as a frame
    #[command(after_help = ENCODE_EXAMPLES)]
    Encode(EncodeArgs),
    /// Decode frames to values
    #[command(after_help = DECODE_EXAMPLES)]
    Decode(DecodeArgs),
    /// Print the completion script for a shell
    #[command(after_help = COMPLETIONS_EXAMPLES)]
    Completions {
        /// The shell
        shell: Shell,
    },
}

const DEMO_EXAMPLES: &str = "\
Examples:
  host-sim demo              the six worked examples: PASS or FAIL for each
  host-sim demo --console    a running cell to watch and change in a browser

Exit code 0 only if all examples pass. Ctrl-C stops it and removes its temporary
files.";

const CONTROLLER_EXAMPLES: &str = "\
Examples:
  host-sim controller -c robot.toml
  host-sim controller -c robot.toml --bind rs485=pty:run/rs485 --bind can=slcan-tcp:127.0.0.1:3333
  host-sim controller -c robot.toml --set listen.modbus=1502 --ready run/ready.json --stats 1s
  host-sim controller -c robot.toml --time stepped --seed 1 --events events.jsonl
  host-sim controller -c robot.toml --time factor=20 --timeline steps.toml

Once everything is listening, a line `ready {json}` on stdout gives the actual addresses.";

const GATEWAY_EXAMPLES: &str = "\
Examples:
  host-sim gateway -c cell.toml --bind rs485-1=serial:/dev/ttyUSB0
  host-sim gateway -c cell.toml --bind rs485-1=pty:run/rs485-1 --set controller.address=127.0.0.1
  host-sim gateway -c cell.toml --set port.rs485-1.baud=9600 --stats 1s
  host-sim gateway -v -c cell.toml --bind rs485-1=serial:/dev/ttyUSB0
                                                 -v logs in words what is wrong, and when it is over
  host-sim gateway -c cell.toml --bind hand=socketcan:can0 --capture - | wireshark -k -i -
  host-sim gateway -c cell.toml --bind hand=socketcan:can0 --record run --record-budget 10GiB
  host-sim gateway -c cell.toml --console 127.0.0.1:8480 --console-key console.key \\
      --console-state revisions
      and then: curl http://127.0.0.1:8480/api/v1/status
  host-sim gateway -c cell.toml --bind hand=socketcan:can0 --sparkplug sparkplug.toml
  host-sim gateway -c left.toml -c right.toml --bind left/hand=socketcan:can0 \\
      --bind right/hand=socketcan:can1           several cells: docs/several-cells.md
  host-sim gateway -c new.toml --bind force=serial:/dev/ttyUSB0 --console 127.0.0.1:8480 \\
      --console-key console.key                  new.toml has no ports: add them in the browser

Captures and recordings never delay the gateway: what cannot be written is lost and
counted. docs/capture.md describes their contents.";

const CHECK_EXAMPLES: &str = "\
Examples:
  host-sim check cell.toml
  host-sim check cell.toml --set port.rs485-1.baud=9600
  host-sim check cell.toml --same-bus can-1,can-2
  host-sim check cell.toml --since 0.2           with changes in meaning since 0.2
  host-sim check cell.toml --json

If the file is invalid: exit code 2 and one message with file, line, column and key.
With --json it goes to stdout: {\"ok\": false, \"errors\": [...]}.";

const IMAGE_EXAMPLES: &str = "\
Examples:
  host-sim image cell.toml -o cell.img
  host-sim image cell.toml --set controller.address=10.0.2.2 -o cell.img";

const ENCODE_EXAMPLES: &str = "\
Values are decimal, 0x1F or 0.5. Exchange frames made only of constants take none.
Otherwise, without values, lines as `decode` prints them are read from stdin.

Examples:
  host-sim encode cell.toml --part input 1
      FF FF 01 EE EE
  host-sim encode can.toml --part output --id 2 0.46744487 0.4099705
      002#EF54EF3EA7E7D13E
  host-sim decode can.toml --part output --log bus.log |
      host-sim encode can.toml --part output
  host-sim encode line.toml --exchange 2 --part request";

const COMPLETIONS_EXAMPLES: &str = "\
Examples:
  host-sim completions bash > ~/.local/share/bash-completion/completions/host-sim
  host-sim completions zsh > ~/.zfunc/_host-sim
  host-sim completions fish > ~/.config/fish/completions/host-sim.fish";

const DECODE_EXAMPLES: &str = "\
Frames are hex bytes (FF FF 01 EE EE, FFFF01EEEE); for a CAN recipe, what
candump prints:
  (1436509052.249713) can0 123#AABB
    can0  123   [2]  AA BB
Without frames, --log or stdin is read. Input that is not a frame of the recipe is
counted on stderr.

Examples:
  host-sim decode cell.toml --part input FF FF 01 EE EE
  candump -L can0 | host-sim decode can.toml --part output
  host-sim decode line.toml --exchange 2 --part reply 09 04 02 03 E8 58 4F";

/// `--set`, for commands that read a file.
#[derive(Debug, Args)]
struct Overrides {
    /// Override a key of the file, such as port.rs485-1.baud=9600; repeatable
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// A recipe's part in a file.
#[derive(Debug, Args)]
struct Which {
    /// A gateway file or a controller file
    file: PathBuf,
    /// The recipe's name; optional if there is only one
    #[arg(long, value_name = "NAME")]
    recipe: Option<String>,
    /// The part: input (user to robot), output (robot to user), or a frame of an exchange; optional if there is
    /// only one
    #[arg(long)]
    part: Option<PartName>,
    /// The number of the exchange or block in the recipe, from 1; optional if there is only one
    #[arg(long, value_name = "N")]
    exchange: Option<usize>,
    #[command(flatten)]
    overrides: Overrides,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Shell {
    Bash,
    Zsh,
    Fish,
}

impl From<Shell> for clap_complete::Shell {
    fn from(shell: Shell) -> Self {
        match shell {
            Shell::Bash => Self::Bash,
            Shell::Zsh => Self::Zsh,
            Shell::Fish => Self::Fish,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum PartName {
    Input,
    Output,
    Request,
    Reply,
    Pending,
    Refusal,
}

/// A part of a recipe, or of one of its exchanges.
enum Chosen {
    Part(Direction),
    Exchange(ExchangePart),
}

impl From<PartName> for Chosen {
    fn from(part: PartName) -> Self {
        match part {
            PartName::Input => Self::Part(Direction::Input),
            PartName::Output => Self::Part(Direction::Output),
            PartName::Request => Self::Exchange(ExchangePart::Request),
            PartName::Reply => Self::Exchange(ExchangePart::Reply),
            PartName::Pending => Self::Exchange(ExchangePart::Pending),
            PartName::Refusal => Self::Exchange(ExchangePart::Refusal),
        }
    }
}

#[derive(Debug, Args)]
struct EncodeArgs {
    #[command(flatten)]
    which: Which,
    /// The CAN id of the frame, such as 2 or 0x501; optional if there is only one
    #[arg(long, value_name = "ID", value_parser = convert::parse_id)]
    id: Option<u32>,
    /// Values in field order, or NAME=VALUE
    #[arg(allow_negative_numbers = true)]
    values: Vec<String>,
}

#[derive(Debug, Args)]
struct DecodeArgs {
    #[command(flatten)]
    which: Which,
    /// Read frames from this file, such as a candump log
    #[arg(long, value_name = "FILE", conflicts_with = "frames")]
    log: Option<PathBuf>,
    /// Frames in hexadecimal, such as FFFF01EEEE
    frames: Vec<String>,
}

/// Runs the command.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse_from(arguments()) {
        Ok(cli) => cli,
        Err(error) => return not_run(&error),
    };
    let log = log::start(cli.verbose);
    let _last_write = log.last_write();
    let mut out = Out::new(io::stdout());
    let done = match cli.command.unwrap_or(Command::Demo { console: None }) {
        Command::Demo { console: None } => return crate::demo::run(),
        Command::Demo { console: Some(address) } => return crate::demo::run_living(address),
        Command::Controller(run) => return run.controller(log),
        Command::Gateway(run) => return run.gateway(log),
        Command::Doctor(args) => return doctor::run(args),
        Command::Pendant(args) => return pendant::run(args),
        Command::Ctl(args) => return ctl::run(args),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            let shell = clap_complete::Shell::from(shell);
            clap_complete::generate(shell, &mut Cli::command(), "host-sim", &mut script);
            let _ = out.write_all(&script);
            Ok(())
        }
        Command::Soak(args) => {
            let code = soak::run(&args, &mut out);
            return out.finish(|_| code);
        }
        Command::Extcap(args) => return extcap::run(&args, out),
        Command::Fleet(args) => return fleet::run(&args, out),
        Command::Replay(args) => return replay::run(&args, out),
        Command::New(args) => new::run(&args, &mut out),
        Command::Check(args) => match check::run(&args, &mut out) {
            Err(check::Wrong::Printed) => return out.finish(|_| ExitCode::from(2)),
            Err(check::Wrong::Said(message)) => Err(message),
            Ok(()) => Ok(()),
        },
        Command::Export(args) => export::run(&args, &mut out),
        Command::Image(args) => image::run(&args, &mut out),
        Command::Encode(args) => encode(&args, &mut out),
        Command::Decode(args) => decode(&args, &mut out),
    };
    out.finish(|printed| match (printed, done) {
        (Printed::Whole, Err(message)) => wrong(message),
        _ => ExitCode::SUCCESS,
    })
}

/// The arguments; Wireshark starts the program under another name, without the word `extcap`.
fn arguments() -> Vec<OsString> {
    let mut arguments: Vec<_> = std::env::args_os().collect();
    let name = arguments.first().and_then(|program| Path::new(program).file_stem());
    if name.is_some_and(|name| name == extcap::PROGRAM) {
        arguments.insert(1, "extcap".into());
    }
    arguments
}

/// Prints help, the version, or an error in the arguments.
fn not_run(error: &clap::Error) -> ExitCode {
    if error.use_stderr() {
        let _ = error.print();
        return ExitCode::from(2);
    }
    let mut out = Out::new(anstream::stdout());
    let _ = write!(out, "{}", error.render().ansi());
    out.finish(|_| ExitCode::SUCCESS)
}

/// The error is a message for the user, with exit code 2.
type CliResult = Result<(), String>;

fn wrong(message: impl std::fmt::Display) -> ExitCode {
    print_stderr(message);
    ExitCode::from(2)
}

fn encode(args: &EncodeArgs, out: &mut dyn Write) -> CliResult {
    let part = args.which.part()?;
    if args.values.is_empty() && !(args.which.is_of_exchange() && part.is_constant()) {
        convert::encode_lines(&part, args.id, io::stdin().lock(), out)
    } else {
        convert::encode_values(&part, args.id, &args.values, out)
    }
}

fn decode(args: &DecodeArgs, out: &mut dyn Write) -> CliResult {
    let part = args.which.part()?;
    let mut notes = io::stderr().lock();
    if !args.frames.is_empty() {
        return convert::decode_lines(&part, args.frames.join(" ").as_bytes(), out, &mut notes);
    }
    match &args.log {
        Some(path) => {
            let file = std::fs::File::open(path).map_err(|error| format!("{}: {error}", path.display()))?;
            convert::decode_lines(&part, io::BufReader::new(file), out, &mut notes)
        }
        None => convert::decode_lines(&part, io::stdin().lock(), out, &mut notes),
    }
}

impl Which {
    /// Whether a frame of an exchange was asked for.
    fn is_of_exchange(&self) -> bool {
        let is_exchange = matches!(self.part.map(Chosen::from), Some(Chosen::Exchange(_)));
        is_exchange || self.exchange.is_some()
    }

    fn part(&self) -> Result<CompiledPart, String> {
        let recipes =
            file::load_recipes(&self.file, &self.overrides.set).map_err(|error| error.to_string())?;
        let recipe = self.recipe.as_deref();
        let part = match (self.part.map(Chosen::from), self.exchange) {
            (Some(Chosen::Part(_)), Some(_)) => {
                Err("an exchange has no input and output; choose one with --part: request, reply, pending, refusal"
                    .into())
            }
            (Some(Chosen::Part(part)), None) => CompiledPart::choose(&recipes, recipe, Some(part)),
            (None, None) => CompiledPart::choose(&recipes, recipe, None),
            (Some(Chosen::Exchange(part)), number) => {
                CompiledPart::choose_exchange(&recipes, recipe, number, Some(part))
            }
            (None, number) => CompiledPart::choose_exchange(&recipes, recipe, number, None),
        };
        let mut part = part.map_err(|message: String| format!("{}: {message}", self.file.display()))?;
        part.bind(&file::load_frames(&self.file, &self.overrides.set).map_err(|error| error.to_string())?);
        Ok(part)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
