//! `host-sim pendant`: acting on a running controller by hand (docs/control.md).
//!
//! In: a command and the address of a control socket. Out: the answer in words or as JSON, and an exit code: 0
//! done, 1 refused or not within the time, 2 a wrong argument or nobody there.

mod condition;
mod request;
mod show;
mod socket;

use std::io::{self, IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use serde_json::{Value, json};

use super::{Out, Printed, wrong};
use recipe_runtime::out::print_stderr;
pub(super) use request::Act;
use socket::Socket;

pub(super) const EXAMPLES: &str = "\
The control socket is `control` in the controller's `ready` line. In zsh, quote names
with brackets: 'DI[3]=1'.

Examples:
  host-sim controller -c robot.toml --ready run/ready.json &
  export HOST_SIM_CONTROL=127.0.0.1:41000      or --ready run/ready.json each time
  host-sim pendant state
  host-sim pendant set DI[3]=1 DI[4]=0 WordInputReg[2]=17
  host-sim pendant run pick.jspf --speed 30
  host-sim pendant wait program=none DO[1]=1 --timeout 5
  host-sim pendant fault command delay 0.5
  host-sim pendant heal
  host-sim pendant events --follow --kind command,reply

Exit codes: 0 done, 1 the controller refused, or the condition did not hold in
time, 2 an argument is invalid or the controller was not reached.";

/// Arguments of `pendant`.
#[derive(Debug, Args)]
pub(super) struct PendantArgs {
    /// The control socket: HOST:PORT, or a port of this machine [env: HOST_SIM_CONTROL]
    #[arg(long, value_name = "ADDRESS", global = true)]
    to: Option<String>,
    /// Read the address from the controller's ready file
    #[arg(long, value_name = "FILE", conflicts_with = "to", global = true)]
    ready: Option<PathBuf>,
    /// Print the controller's answer as a line of JSON
    #[arg(long, global = true)]
    json: bool,
    #[command(subcommand)]
    act: Act,
}

/// Why it did not work.
#[derive(Debug)]
enum PendantError {
    /// The controller refused.
    Refused(String),
    /// An argument is wrong, or nobody is there.
    Wrong(String),
    /// Nothing more can be printed.
    Printing,
}

impl From<io::Error> for PendantError {
    fn from(_: io::Error) -> Self {
        Self::Printing
    }
}

pub(super) fn run(args: PendantArgs) -> ExitCode {
    let mut out = Out::new(io::stdout());
    let done = args.run(&mut out);
    out.finish(|printed| match (printed, done) {
        (Printed::Whole, Err(PendantError::Refused(message))) => {
            print_stderr(message);
            ExitCode::FAILURE
        }
        (Printed::Whole, Err(PendantError::Wrong(message))) => wrong(message),
        _ => ExitCode::SUCCESS,
    })
}

impl PendantArgs {
    fn run(self, out: &mut dyn Write) -> Result<(), PendantError> {
        // Mistakes in arguments come before those of the connection.
        let request = self.act.request().map_err(PendantError::Wrong)?;
        let address = self.address().map_err(PendantError::Wrong)?;
        let mut socket = Socket::connect(&address).map_err(PendantError::Wrong)?;
        match &self.act {
            Act::State { watch: Some(interval) } => {
                let is_terminal = io::stdout().is_terminal();
                loop {
                    let answer = self.answer(&mut socket, &request)?;
                    if is_terminal && !self.json {
                        // Clears the screen.
                        write!(out, "\x1b[2J\x1b[H")?;
                    }
                    self.show(&answer, out)?;
                    out.flush()?;
                    std::thread::sleep(*interval);
                }
            }
            Act::Events { follow: true, .. } => {
                self.answer(&mut socket, &request)?;
                loop {
                    let line = socket.line().map_err(PendantError::Wrong)?;
                    if self.json {
                        writeln!(out, "{line}")?;
                    } else if let Some(lost) = line.get("lost") {
                        writeln!(out, "{lost} events lost")?;
                    } else {
                        show::event(&line["event"], out)?;
                    }
                    out.flush()?;
                }
            }
            _ => {
                let answer = self.answer(&mut socket, &request)?;
                self.show(&answer, out)
            }
        }
    }

    /// The answer to a request that is executed.
    fn answer(&self, socket: &mut Socket, request: &Value) -> Result<Value, PendantError> {
        let answer = socket.ask(request).map_err(PendantError::Wrong)?;
        match answer["ok"].as_bool() {
            Some(true) => Ok(answer),
            _ => Err(PendantError::Refused(answer["error"].as_str().unwrap_or("refused").to_owned())),
        }
    }

    fn show(&self, answer: &Value, out: &mut dyn Write) -> Result<(), PendantError> {
        if self.json {
            writeln!(out, "{answer}")?;
            return Ok(());
        }
        let result = &answer["result"];
        match &self.act {
            Act::State { .. } => show::state(result, out)?,
            Act::Get { .. } => show::values(result, out)?,
            Act::Counters => show::counters(result, out)?,
            Act::Programs => show::names(result, out)?,
            Act::Events { .. } => show::events(result, out)?,
            Act::Do { .. } if !result.is_null() => writeln!(out, "{result:#}")?,
            _ => writeln!(out, "done at {} s", answer["time_s"])?,
        }
        Ok(())
    }

    fn address(&self) -> Result<String, String> {
        if let Some(file) = &self.ready {
            let refused = |why: String| format!("--ready {}: {why}", file.display());
            let text = std::fs::read_to_string(file).map_err(|error| refused(error.to_string()))?;
            let ready: Value = serde_json::from_str(&text).unwrap_or_default();
            return match ready["control"].as_str() {
                Some(address) => Ok(address.to_owned()),
                None => Err(refused("this is not the ready file of a controller".into())),
            };
        }
        let given = self.to.clone().or_else(|| std::env::var("HOST_SIM_CONTROL").ok());
        let Some(given) = given.filter(|given| !given.is_empty()) else {
            return Err("which controller? give --to ADDRESS or --ready FILE, or set HOST_SIM_CONTROL".into());
        };
        Ok(if given.contains(':') { given } else { format!("127.0.0.1:{given}") })
    }
}

/// A request without arguments.
fn bare(name: &str) -> Value {
    json!({ "do": name })
}
