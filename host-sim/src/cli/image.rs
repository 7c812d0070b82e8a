//! `image`: writes the configuration image for a board from a checked file.

use std::fs;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use proto_core::config::image;
use recipe_config::board::{Board, image_of};

use super::output::OutputFile;
use super::{CliResult, Overrides, check};

/// Arguments of `image`.
#[derive(Debug, Args)]
pub(super) struct ImageArgs {
    /// A gateway file
    file: PathBuf,
    /// The image to write; an older image is replaced
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Replace even a file that is not an image; never the input file
    #[arg(long)]
    force: bool,
    /// Refuse what this board cannot run: nucleo-h743zi or mps2-an500
    #[arg(long, value_name = "BOARD")]
    board: Option<Board>,
    #[command(flatten)]
    overrides: Overrides,
}

pub(super) fn run(args: &ImageArgs, out: &mut dyn Write) -> CliResult {
    let config = check::load_gateway(&args.file, &args.overrides.set).map_err(|error| error.to_string())?;
    check::check_board(&args.file, &args.overrides.set, &config, args.board)
        .map_err(|error| error.to_string())?;
    let bytes = image_of(&config)?;
    let name = args.output.display();
    write(args, &bytes).map_err(|error| format!("{name}: {error}"))?;
    writeln!(out, "{name}: {} bytes, version {}", bytes.len(), image::VERSION)
        .map_err(|error| error.to_string())
}

/// Writes the image unless that would replace another file.
fn write(args: &ImageArgs, bytes: &[u8]) -> io::Result<()> {
    let image = OutputFile { bytes, name: "the image", made_from: Some(&args.file) };
    let may_be_replaced = || Ok(args.force || is_image(&args.output)?);
    image.put(&args.output, may_be_replaced, " and is not an image")
}

/// Whether a file begins like an image of any version, or is empty, as `mktemp` makes it.
fn is_image(path: &Path) -> io::Result<bool> {
    let mut begins = Vec::new();
    fs::File::open(path)?.take(image::MAGIC.len() as u64).read_to_end(&mut begins)?;
    Ok(begins.is_empty() || begins == image::MAGIC)
}
