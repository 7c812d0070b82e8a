//! `new`: complete gateway files for known field devices.
//!
//! In: the name of a device, or none. Out: its file, or the list of all devices. The files are those of
//! `host-sim/templates`, which are in the program.

mod templates;

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use clap::Args;

use super::CliResult;
use recipe_io::files::Beside;
use templates::{ALL, Template};

/// Arguments of `new`.
#[derive(Debug, Args)]
pub(super) struct NewArgs {
    /// The device, such as robotiq-ft300; without it, list all devices
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Write the gateway file here instead of to stdout; never replaces a file
    #[arg(short, long, value_name = "FILE", requires = "device")]
    output: Option<PathBuf>,
}

pub(super) const EXAMPLES: &str = "\
Examples:
  host-sim new                                   all devices
  host-sim new --device robotiq-ft300            its gateway file, on stdout
  host-sim new --device robotiq-ft300 -o cell.toml

The file says how to wire and set the device and where its protocol is published, and
shows example frames byte by byte. Set `controller.address` in it.";

pub(super) fn run(args: &NewArgs, out: &mut dyn Write) -> CliResult {
    let Some(name) = &args.device else { return list(out) };
    let template = ALL.iter().find(|template| template.name == name).ok_or_else(|| unknown(name))?;
    let Some(path) = &args.output else {
        return out.write_all(template.text.as_bytes()).map_err(|error| error.to_string());
    };
    let file = path.display();
    write_new(path, template.text).map_err(|error| format!("{file}: {error}"))?;
    writeln!(out, "{file}: {}", template.title()).map_err(|error| error.to_string())?;
    writeln!(out, "set controller.address in it, then: host-sim check {file}")
        .map_err(|error| error.to_string())
}

fn list(out: &mut dyn Write) -> CliResult {
    let width = ALL.iter().map(|template| template.name.len()).max().unwrap_or(0);
    for template in ALL {
        writeln!(out, "{:width$}  {}", template.name, template.title()).map_err(|error| error.to_string())?;
    }
    Ok(())
}

/// Writes the file unless something has that name already.
fn write_new(path: &Path, text: &str) -> io::Result<()> {
    Beside::file(path, text.as_bytes())?.0.put_new(path).map_err(|error| match error.kind() {
        io::ErrorKind::AlreadyExists => io::Error::new(error.kind(), "this exists; give another name"),
        _ => error,
    })
}

fn unknown(name: &str) -> String {
    match &nearest(name)[..] {
        [] => format!("there is no device {name:?}; `host-sim new` lists all"),
        near => {
            format!("there is no device {name:?}; near it: {}; `host-sim new` lists all", near.join(", "))
        }
    }
}

/// Names of devices that contain `name` or are described with it; if there is none, those with the fewest
/// characters to change.
fn nearest(name: &str) -> Vec<&'static str> {
    let wanted = name.to_lowercase();
    let contains = |template: &&Template| {
        template.name.contains(&wanted) || template.title().to_lowercase().contains(&wanted)
    };
    let found: Vec<_> = ALL.iter().filter(contains).map(|template| template.name).collect();
    if !found.is_empty() && !wanted.is_empty() {
        return found;
    }
    let distances = ALL.iter().map(|template| (strsim::levenshtein(&wanted, template.name), template.name));
    let best = distances.clone().map(|(distance, _)| distance).min().unwrap_or(usize::MAX);
    if best > wanted.len() / 2 {
        return Vec::new();
    }
    distances.filter(|(distance, _)| *distance == best).map(|(_, name)| name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_names_are_those_that_contain_it_or_else_the_closest() {
        assert_eq!(nearest("robotic-ft300"), ["robotiq-ft300"]);
        assert!(nearest("Robotiq").contains(&"robotiq-ft300"));
        assert!(nearest("force").contains(&"bota-rokubi"), "found by its description");
        assert!(nearest("zzzzzzzzzzzz").is_empty());
        assert!(nearest("").is_empty());
    }
}
