//! `image`: writes the configuration image for a board from a checked file.

use std::fs;
use std::io::{self, Read, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};

use clap::Args;
use proto_core::config::image;

use super::{Outcome, Overrides, check};
use recipe_device::files::{Beside, Identity};

/// Arguments of `image`.
#[derive(Debug, Args)]
pub(super) struct ImageArgs {
    /// A gateway file
    file: PathBuf,
    /// Where to write the image; an older image is replaced
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Replace a file even if it is no image; never the input file
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    overrides: Overrides,
}

pub(super) fn run(args: &ImageArgs, out: &mut dyn Write) -> Outcome {
    let config = check::load_gateway(&args.file, &args.overrides.set).map_err(|error| error.to_string())?;
    let mut bytes = vec![0; image::MAX_IMAGE];
    let len = image::encode(&*config, &mut bytes).map_err(|error| error.to_string())?;
    bytes.truncate(len);
    // An image that a board would refuse is never written.
    image::decode(&bytes).map_err(|error| error.to_string())?;
    let name = args.output.display();
    write(args, &bytes).map_err(|error| format!("{name}: {error}"))?;
    writeln!(out, "{name}: {len} bytes, version {}", image::VERSION).map_err(|error| error.to_string())
}

/// Writes the image unless that would replace another file.
fn write(args: &ImageArgs, bytes: &[u8]) -> io::Result<()> {
    let refused = |message: &str| Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
    let found = match fs::metadata(&args.output) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            if args.output.is_symlink() {
                return refused("a link to a file that does not exist; give another name");
            }
            return Beside::file(&args.output, bytes)?.0.put_new(&args.output);
        }
        found => found?,
    };
    let kind = found.file_type();
    if kind.is_char_device() || kind.is_fifo() {
        // A pipe or a device: nothing is replaced.
        return fs::File::options().write(true).open(&args.output)?.write_all(bytes);
    }
    if kind.is_dir() {
        return refused("a folder; give the name of a file in it");
    }
    if !kind.is_file() {
        return refused("not a regular file; give another name");
    }
    if Identity::of(&found) == Identity::of(&fs::metadata(&args.file)?) {
        return refused("this is the file that the image is made from; give another name");
    }
    if !args.force && !is_image(&args.output)? {
        return refused("this file exists and is not an image; give another name or --force");
    }
    // Replace the target of a symbolic link, not the link.
    let place = fs::canonicalize(&args.output)?;
    Beside::file(&place, bytes)?.0.replace(&place)
}

/// Whether a file begins like an image of any version, or is empty, as `mktemp` makes it.
fn is_image(path: &Path) -> io::Result<bool> {
    let mut begins = Vec::new();
    fs::File::open(path)?.take(image::MAGIC.len() as u64).read_to_end(&mut begins)?;
    Ok(begins.is_empty() || begins == image::MAGIC)
}
