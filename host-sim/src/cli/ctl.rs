//! `host-sim ctl`: asks and changes running gateways, on hosts and on boards (docs/ctl.md).
//!
//! In: an address or an inventory, a key file, a command. Out: text, JSON or files, and an exit code: 0 done, 1 refused
//! or not reached, 2 a file or an argument is wrong, 3 a gateway says that something is wrong.

mod act;
mod help;
mod updating;
mod work;

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use recipe_ctl::{Address, Client, Failure, Member, Stop, TableView, Verdict, key_file};
use recipe_runtime::Signals;
use recipe_runtime::out::print_stderr;

use super::output::OutputFile;
use super::run::parse_time;
use super::{Out, Printed, wrong};
use act::Act;
pub(super) use help::EXAMPLES;
use work::CtlWork;

/// Arguments of `ctl`.
#[derive(Debug, Args)]
pub(super) struct CtlArgs {
    /// The gateway, ADDRESS or ADDRESS:PORT; port 80 by default, 8480 on this machine [env: HOST_SIM_GATEWAY]
    #[arg(long, value_name = "ADDRESS", global = true)]
    to: Option<Address>,
    /// The gateway's own address, if --to is a forwarded port
    #[arg(long, value_name = "ADDRESS", global = true)]
    host: Option<Address>,
    /// File with its key, mode 0600; not needed to read on this machine [env: HOST_SIM_GATEWAY_KEY]
    #[arg(long, value_name = "FILE", global = true)]
    key: Option<PathBuf>,
    /// Instead of --to and --key: all gateways in this file
    #[arg(long, value_name = "FILE", conflicts_with_all = ["to", "key"], global = true)]
    inventory: Option<PathBuf>,
    /// Only this gateway of the inventory; repeatable
    #[arg(long, value_name = "NAME", requires = "inventory", global = true)]
    only: Vec<String>,
    /// Time limit for a request with its answer
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = parse_time, global = true)]
    timeout: Duration,
    /// Print JSON, one document per line
    #[arg(long, global = true)]
    json: bool,
    #[command(subcommand)]
    act: Act,
}

pub(super) fn run(args: CtlArgs) -> ExitCode {
    // Colours are taken out where nobody sees them, or if NO_COLOR says so.
    let mut out = Out::new(anstream::stdout());
    let done = args.run(&mut out);
    out.finish(|printed| match (printed, done) {
        (Printed::Whole, Err(Failure::Refused(message))) => {
            print_stderr(message);
            ExitCode::FAILURE
        }
        (Printed::Whole, Err(Failure::Wrong(message))) => wrong(message),
        (_, Ok(Verdict::Trouble)) => ExitCode::from(3),
        _ => ExitCode::SUCCESS,
    })
}

impl CtlArgs {
    fn run(&self, out: &mut dyn Write) -> Result<Verdict, Failure> {
        let run = RequestOptions { json: self.json, view: view(), timeout: self.timeout };
        // Mistakes in files and arguments come before those of the connection.
        let work = match self.act.prepare(self.inventory.is_some())? {
            CtlWork::Alone(alone) => return alone(run, out),
            CtlWork::Through(through) => {
                let (members, stop) = (self.members()?, Stop::new());
                end_on_signals(&stop, Some(updating::ENDING))?;
                return through(&members, &stop, run, out);
            }
            work => work,
        };
        let rollout = self.act.rollout();
        let stop = Stop::new();
        match (self.whom()?, work) {
            (Whom::One(_), _) if rollout.is_some() => {
                Err(Failure::wrong("--batch and --stop-on-failure are for an inventory of several gateways"))
            }
            (Whom::One(make), work) => {
                // A plain question ends at once, as any program does.
                if matches!(work, CtlWork::Follow(_)) {
                    end_on_signals(&stop, None)?;
                }
                work::at_one(work, &make(stop)?, run, out)
            }
            (Whom::Many(members), CtlWork::Query(ask, many)) => {
                end_on_signals(&stop, None)?;
                work::at_many((&ask, many), &members, rollout, &stop, run, out)
            }
            (Whom::Many(members), _) => Err(Failure::wrong(format!(
                "this command is for one gateway, and the inventory has {}; choose one with --only NAME",
                members.len()
            ))),
        }
    }

    /// The gateways of the inventory that are meant.
    fn members(&self) -> Result<Vec<Member>, Failure> {
        if self.host.is_some() {
            return Err(Failure::wrong(
                "--host is for --to; in an inventory write host = \"ADDRESS\" below the gateway's address",
            ));
        }
        self.inventory.as_deref().map_or(Ok(Vec::new()), |path| recipe_ctl::members(path, &self.only))
    }

    /// The gateway or gateways that are meant.
    fn whom(&self) -> Result<Whom, Failure> {
        let timeout = self.timeout;
        if self.inventory.is_some() {
            let mut members = self.members()?;
            return Ok(match (members.len(), members.pop()) {
                (1, Some(member)) => Whom::One(Box::new(move |stop| member.client(timeout, stop))),
                (_, last) => {
                    members.extend(last);
                    Whom::Many(members)
                }
            });
        }
        let named = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        let address = match (&self.to, named("HOST_SIM_GATEWAY")) {
            (Some(address), _) => address.clone(),
            (None, Some(text)) => {
                text.parse().map_err(|why: String| Failure::wrong(format!("HOST_SIM_GATEWAY: {why}")))?
            }
            (None, None) => {
                return Err(Failure::wrong(
                    "which gateway? give --to ADDRESS or --inventory FILE, or set HOST_SIM_GATEWAY",
                ));
            }
        };
        let key = self.key.clone().or_else(|| named("HOST_SIM_GATEWAY_KEY").map(PathBuf::from));
        let key = match self.act.makes_key() {
            // Its own is made, or was left by an attempt before.
            true => None,
            false => key.as_deref().map(key_file::read).transpose()?,
        };
        let host = self.host.clone();
        Ok(Whom::One(Box::new(move |stop| Ok(Client::new(address, key, timeout, stop)?.known_as(host)))))
    }
}

/// What is asked.
enum Whom {
    One(Box<dyn FnOnce(Stop) -> Result<Client, Failure>>),
    Many(Vec<Member>),
}

/// How a command prints, and how long a request may take.
#[derive(Debug, Clone, Copy)]
struct RequestOptions {
    json: bool,
    view: TableView,
    timeout: Duration,
}

/// The terminal that stdout is.
fn view() -> TableView {
    let is_terminal = io::stdout().is_terminal();
    let size = is_terminal.then(|| rustix::termios::tcgetwinsize(io::stdout()).ok()).flatten();
    let width = size.map(|size| usize::from(size.ws_col)).filter(|width| *width > 0);
    TableView { width, is_terminal }
}

/// From now on a signal requests the end of the command and prints this text; a second one ends it at once.
fn end_on_signals(stop: &Stop, words: Option<&'static str>) -> Result<(), Failure> {
    let refused = |error: io::Error| Failure::refused(format!("signals: {error}"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(refused)?;
    let mut signals = {
        let _inside = runtime.enter();
        Signals::catch().map_err(refused)?
    };
    let stop = stop.clone();
    let thread = std::thread::Builder::new().name("signals".to_owned());
    let watching = move || {
        runtime.block_on(signals.next());
        stop.ask();
        words.into_iter().for_each(print_stderr);
        let number = runtime.block_on(signals.next());
        std::process::exit(128 + number);
    };
    thread.spawn(watching).map(|_| ()).map_err(refused)
}

/// Writes an output file.
fn write(path: &Path, bytes: &[u8], force: bool) -> Result<(), Failure> {
    let written = OutputFile { bytes, name: "it", made_from: None };
    written
        .put(path, || Ok(force), "")
        .map_err(|error| Failure::wrong(format!("{}: {error}", path.display())))
}
