//! `check`: whether a file is valid, how busy its buses are, and what to set on the pendant.

mod bus;
mod delimiters;
mod fill;
mod report;

use std::io::Write;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use proto_core::config::{GatewayConfig, MAX_PORTS};
use proto_core::engine::Engine;
use recipe_config::SimConfig;
use recipe_config::board::Board;
use recipe_config::file::{self, Config, FileError};
use recipe_controller::{BuildError, Controller};

use super::Overrides;
use report::{CheckReport, MessageReport, Refusal};

/// Arguments of `check`.
#[derive(Debug, Args)]
pub(super) struct CheckArgs {
    /// A gateway file or a controller file
    file: PathBuf,
    /// Print the report or the error as JSON (docs/checking.md)
    #[arg(long)]
    json: bool,
    /// Also check that this board can run it: nucleo-h743zi or mps2-an500
    #[arg(long, value_name = "BOARD")]
    board: Option<Board>,
    /// CAN ports of the file that share one bus, such as can-1,can-2; repeatable
    #[arg(long, value_name = "PORT,PORT", value_parser = names)]
    same_bus: Vec<PortNames>,
    /// Also print what the file means now but did not mean in this version
    #[arg(long, value_name = "VERSION")]
    since: Option<Version>,
    #[command(flatten)]
    overrides: Overrides,
}

/// A version whose files are still in use.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Version {
    #[value(name = "0.2", alias = "0.2.0")]
    V0_2,
}

/// Names with commas between them.
#[derive(Debug, Clone)]
struct PortNames(Vec<String>);

fn names(text: &str) -> Result<PortNames, String> {
    let names: Vec<_> = text.split(',').map(|name| name.trim().to_owned()).collect();
    match names.len() {
        0 | 1 => Err("write two ports or more, such as can-1,can-2".into()),
        _ => Ok(PortNames(names)),
    }
}

pub(super) fn run(args: &CheckArgs, out: &mut dyn Write) -> Result<(), Wrong> {
    let print = |out: &mut dyn Write, text: String| {
        write!(out, "{text}").map_err(|error| Wrong::Said(error.to_string()))
    };
    match report(args) {
        Ok(report) if args.json => print(out, json(&report)),
        Ok(report) => print(out, report.show()),
        Err(CheckError::File(error)) if args.json => {
            print(out, json(&Refusal::new(error)))?;
            Err(Wrong::Printed)
        }
        Err(CheckError::File(error)) => Err(Wrong::Said(error.to_string())),
        Err(CheckError::Argument(message)) => Err(Wrong::Said(message)),
    }
}

/// Why the exit code is 2.
pub(super) enum Wrong {
    /// A message for stderr.
    Said(String),
    /// The JSON on stdout says it.
    Printed,
}

enum CheckError {
    File(FileError),
    Argument(String),
}

impl From<FileError> for CheckError {
    fn from(error: FileError) -> Self {
        Self::File(error)
    }
}

fn json(value: &impl serde::Serialize) -> String {
    // Cannot fail: the keys are strings, and nothing else in it can.
    serde_json::to_string_pretty(value).map_or_else(|error| error.to_string(), |text| text + "\n")
}

fn report(args: &CheckArgs) -> Result<CheckReport, CheckError> {
    let (path, overrides) = (&args.file, &args.overrides.set);
    let name = path.display().to_string();
    let config = file::load(path, overrides)?;
    let recipes = file::load_recipes(path, overrides)?;
    let (mut report, mut placed) = match &config {
        Config::Gateway(config) => {
            check_room(path, overrides, config)?;
            check_board(path, overrides, config, args.board)?;
            let frames = file::load_frames(path, overrides)?;
            let shared: Vec<_> = args.same_bus.iter().map(|names| names.0.clone()).collect();
            let (buses, troubles) = bus::loads(config, &recipes, &shared).map_err(CheckError::Argument)?;
            let mut report = fill::gateway(name, config, &recipes, &frames);
            report.buses = buses;
            report.changes = args.since.map(|Version::V0_2| {
                let changes = recipe_config::changes_since_0_2(config, &frames);
                messages(path, overrides, &changes)
            });
            let mut placed = fill::warnings(config);
            placed.extend(recipe_config::negative_numbers(&frames));
            placed.extend(recipe_config::orders_before_values(&frames));
            placed.extend(
                troubles
                    .into_iter()
                    .map(|(port, said)| (vec!["port".to_owned(), port, "bus".to_owned()], said)),
            );
            (report, placed)
        }
        Config::Controller(_) if !args.same_bus.is_empty() => {
            return Err(CheckError::Argument("--same-bus is for gateway files".into()));
        }
        Config::Controller(_) if args.since.is_some() => {
            return Err(CheckError::Argument(
                "--since is for gateway files; of others nothing has changed".into(),
            ));
        }
        Config::Controller(_) if args.board.is_some() => {
            return Err(CheckError::Argument("--board is for gateway files".into()));
        }
        Config::Controller(config) => {
            check_build(path, overrides, config)?;
            let report = fill::controller(name, config);
            let placed = fill::controller_warnings(&report);
            (report, placed)
        }
    };
    for recipe in &recipes {
        for (part, said) in delimiters::dangers(recipe) {
            placed.push((["recipe", recipe.name(), part].map(str::to_owned).to_vec(), said));
        }
    }
    report.warnings = messages(path, overrides, &placed);
    Ok(report)
}

/// Sentences with the places of their keys.
fn messages(path: &Path, overrides: &[String], placed: &[fill::Placed]) -> Vec<MessageReport> {
    let message = |(key, said): &fill::Placed| {
        let key: Vec<&str> = key.iter().map(String::as_str).collect();
        MessageReport::from(file::error_at(path, overrides, &key, said))
    };
    placed.iter().map(message).collect()
}

/// Loads a controller file and checks that its programs compile and its values fit.
pub(super) fn load_controller(path: &Path, overrides: &[String]) -> Result<SimConfig, FileError> {
    let config = file::load_controller(path, overrides)?;
    check_build(path, overrides, &config)?;
    Ok(config)
}

/// Loads a gateway file and checks that this host's engine has room for it.
pub(super) fn load_gateway(path: &Path, overrides: &[String]) -> Result<Box<GatewayConfig>, FileError> {
    let config = file::load_gateway(path, overrides)?;
    check_room(path, overrides, &config)?;
    Ok(config)
}

/// Checks what only the engine can refuse.
fn check_room(path: &Path, overrides: &[String], config: &GatewayConfig) -> Result<(), FileError> {
    match Engine::<MAX_PORTS>::new(config) {
        Ok(_) => Ok(()),
        Err(error) => Err(file::error_at(path, overrides, &["port"], error)),
    }
}

/// Checks what only this board can refuse.
pub(super) fn check_board(
    path: &Path,
    overrides: &[String],
    config: &GatewayConfig,
    board: Option<Board>,
) -> Result<(), FileError> {
    let Some(Err(unfit)) = board.map(|board| board.check(config)) else { return Ok(()) };
    let key: Vec<&str> = unfit.key.iter().map(String::as_str).collect();
    Err(file::error_at(path, overrides, &key, unfit.message))
}

/// Checks what only the controller can refuse.
fn check_build(path: &Path, overrides: &[String], config: &SimConfig) -> Result<(), FileError> {
    let Err(error) = Controller::new(config) else { return Ok(()) };
    let at = |key: &[&str], message: &dyn std::fmt::Display| file::error_at(path, overrides, key, message);
    Err(match &error {
        BuildError::Program { program, error } => at(&["program", program, "script"], error),
        BuildError::Initial { target, reason } => at(&["initial", &target.to_string()], reason),
        BuildError::Function { reason, .. } => at(&["functions"], reason),
        BuildError::Port { port, error } => at(&["port", port, "recipe"], error),
        BuildError::SecondUdpServer { port } => at(&["port", port], &error),
        BuildError::Dialect(_) => at(&["robot", "dialect"], &error),
        _ => at(&["robot"], &error),
    })
}
