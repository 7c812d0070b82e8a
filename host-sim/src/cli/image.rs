//! `image`: the configuration image that a board keeps, from the checked file.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use proto_core::config::image;

use super::{Outcome, Overrides, check};

/// What `image` is told.
#[derive(Debug, Args)]
pub(super) struct ImageArgs {
    /// A gateway's file
    file: PathBuf,
    /// Where the image is written
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
}

pub(super) fn run(args: &ImageArgs, out: &mut dyn Write) -> Outcome {
    let config = check::load_gateway(&args.file, &args.overrides.set).map_err(|error| error.to_string())?;
    let mut bytes = vec![0; image::MAX_IMAGE];
    let len = image::encode(&config, &mut bytes).map_err(|error| error.to_string())?;
    bytes.truncate(len);
    // What a board would refuse is never written.
    image::decode(&bytes).map_err(|error| error.to_string())?;
    let name = args.output.display();
    std::fs::write(&args.output, &bytes).map_err(|error| format!("{name}: {error}"))?;
    writeln!(out, "{name}: {len} bytes, version {}", image::VERSION).map_err(|error| error.to_string())
}
