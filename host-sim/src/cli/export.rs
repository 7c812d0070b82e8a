//! `export`: what other tools read.
//!
//! In: the name of a form. Out: its text on stdout.

use std::io::Write;

use clap::{Args, Subcommand, ValueEnum};
use recipe_config::FileKind;

use super::Outcome;

/// Arguments of `export`.
#[derive(Debug, Args)]
pub(super) struct ExportArgs {
    #[command(subcommand)]
    form: Form,
}

#[derive(Debug, Subcommand)]
enum Form {
    /// The JSON Schema of a file, for editors and linters
    #[command(after_help = SCHEMA_EXAMPLES)]
    Schema {
        /// The kind of file
        #[arg(default_value = "gateway")]
        kind: Kind,
    },
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Kind {
    Gateway,
    Controller,
}

pub(super) const EXAMPLES: &str = "\
Examples:
  host-sim export schema > gateway.schema.json";

const SCHEMA_EXAMPLES: &str = "\
The schema is of draft 7. It knows keys, types, words and ranges; names of recipes,
owners of variables and sizes of frames are known to `host-sim check` only.

Examples:
  host-sim export schema > gateway.schema.json
  host-sim export schema controller > controller.schema.json

An editor with tombi or taplo takes it from the first line of a file:
  #:schema ./gateway.schema.json";

pub(super) fn run(args: &ExportArgs, out: &mut dyn Write) -> Outcome {
    match args.form {
        Form::Schema { kind } => {
            let kind = match kind {
                Kind::Gateway => FileKind::Gateway,
                Kind::Controller => FileKind::Controller,
            };
            writeln!(out, "{:#}", recipe_config::schema(kind)).map_err(|error| error.to_string())
        }
    }
}
