//! `export`: what other tools need to read the frames of a file.
//!
//! In: a gateway file or a controller file, or a kind of file. Out: a CAN database, a plugin for Wireshark, a map of
//! the variables; the schema of that kind.

use std::io::Write;
use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use recipe_config::FileKind;
use recipe_export::{Model, dbc, lua, map};
use recipe_runtime::out::print_stderr;

use super::output::OutputFile;
use super::{CliResult, Overrides};

/// Arguments of `export`.
#[derive(Debug, Args)]
pub(super) struct ExportArgs {
    #[command(subcommand)]
    what: ExportCommand,
}

#[derive(Debug, Subcommand)]
enum ExportCommand {
    /// Write a CAN database (DBC) of the file's CAN ports
    #[command(after_help = DBC_EXAMPLES)]
    Dbc(DbcArgs),
    /// Write a Lua dissector for Wireshark and tshark
    #[command(after_help = LUA_EXAMPLES)]
    Lua(FileArgs),
    /// Write a table of all variables: who writes them, in which bytes of which frame
    #[command(after_help = MAP_EXAMPLES)]
    Map(MapArgs),
    /// Write the JSON Schema of a kind of file, for editors and linters
    #[command(after_help = SCHEMA_EXAMPLES)]
    Schema {
        /// The kind of file
        #[arg(default_value = "gateway")]
        kind: ExportKind,
    },
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum ExportKind {
    Gateway,
    Controller,
}

#[derive(Debug, Args)]
struct DbcArgs {
    #[command(flatten)]
    file: FileArgs,
    /// Only the frames of this port [default: all CAN ports]
    #[arg(long, value_name = "NAME")]
    port: Option<String>,
}

#[derive(Debug, Args)]
struct MapArgs {
    #[command(flatten)]
    file: FileArgs,
    /// Format of the table
    #[arg(long, default_value = "markdown")]
    format: MapFormat,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum MapFormat {
    Markdown,
    Csv,
}

/// A file, and where to write what is made of it.
#[derive(Debug, Args)]
struct FileArgs {
    /// A gateway file or a controller file
    file: PathBuf,
    /// Write to this file instead of to stdout
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Replace an existing file; never the input file
    #[arg(long, requires = "output")]
    force: bool,
    #[command(flatten)]
    overrides: Overrides,
}

pub(super) const EXAMPLES: &str = "\
Examples:
  host-sim export dbc cell.toml -o cell.dbc      for cantools, SavvyCAN, BUSMASTER
  host-sim export lua cell.toml -o cell.lua      for Wireshark
  host-sim export map cell.toml                  who writes which variable
  host-sim export schema > gateway.schema.json   for an editor

Names become identifiers of at most 32 characters: thumb-turn is thumb__turn,
RobotState[8] is RobotState_8_. docs/export.md has the rules.";

const DBC_EXAMPLES: &str = "\
Examples:
  host-sim export dbc cell.toml -o cell.dbc
  candump -L can0 | cantools decode cell.dbc
  host-sim export dbc cell.toml --port hand

Signals are the values on the bus, as `decode` shows them; comments say what becomes
of them. If two ports have different frames with one id, choose one with --port.";

const LUA_EXAMPLES: &str = "\
Examples:
  host-sim export lua cell.toml -o cell.lua
  tshark -X lua_script:cell.lua -r cell.pcapng -V
  cp cell.lua ~/.local/lib/wireshark/plugins/

It decodes serial frames in captures of `host-sim gateway --capture`, and CAN frames in
any capture.";

const MAP_EXAMPLES: &str = "\
Examples:
  host-sim export map cell.toml
  host-sim export map cell.toml --format csv -o cell.csv";

const SCHEMA_EXAMPLES: &str = "\
JSON Schema draft 7. It covers keys, types, words and ranges; names of recipes, owners
of variables and sizes of frames are checked by `host-sim check` only.

Examples:
  host-sim export schema > gateway.schema.json
  host-sim export schema controller > controller.schema.json

Editors with tombi or taplo find it by the first line of a file:
  #:schema ./gateway.schema.json";

pub(super) fn run(args: &ExportArgs, out: &mut dyn Write) -> CliResult {
    match &args.what {
        ExportCommand::Dbc(DbcArgs { file, port }) => {
            let made = dbc::dbc(&file.model()?, port.as_deref()).map_err(|error| file.wrong(error))?;
            for note in &made.notes {
                print_stderr(format_args!("{}: {note}", file.file.display()));
            }
            file.write(&made.text, out)
        }
        ExportCommand::Lua(file) => {
            let text = lua::lua(&file.model()?).map_err(|error| file.wrong(error))?;
            file.write(&text, out)
        }
        ExportCommand::Map(MapArgs { file, format }) => {
            let style = match format {
                MapFormat::Markdown => map::Style::Markdown,
                MapFormat::Csv => map::Style::Csv,
            };
            file.write(&map::map(&file.model()?, style), out)
        }
        ExportCommand::Schema { kind } => {
            let kind = match kind {
                ExportKind::Gateway => FileKind::Gateway,
                ExportKind::Controller => FileKind::Controller,
            };
            writeln!(out, "{:#}", recipe_config::schema(kind)).map_err(|error| error.to_string())
        }
    }
}

impl FileArgs {
    fn model(&self) -> Result<Model, String> {
        Model::load(&self.file, &self.overrides.set).map_err(|error| error.to_string())
    }

    fn wrong(&self, error: impl std::fmt::Display) -> String {
        format!("{}: {error}", self.file.display())
    }

    fn write(&self, text: &str, out: &mut dyn Write) -> CliResult {
        let Some(path) = &self.output else {
            return out.write_all(text.as_bytes()).map_err(|error| error.to_string());
        };
        let name = path.display();
        let written = OutputFile { bytes: text.as_bytes(), name: "it", made_from: Some(&self.file) };
        written.put(path, || Ok(self.force), "").map_err(|error| format!("{name}: {error}"))?;
        writeln!(out, "{name}: {} bytes", text.len()).map_err(|error| error.to_string())
    }
}
