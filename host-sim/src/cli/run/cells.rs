//! `host-sim gateway` with several files: which option is for which cell (docs/several-cells.md).

use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::thread::available_parallelism;

use super::RunArgs;
use crate::cli::check;
use recipe_capture::Watch;
use recipe_io::bind::Bind;
use recipe_runtime::cells::Cell;
use recipe_runtime::console::{ConfigFile, ConsoleOptions};
use recipe_runtime::log::Log;
use recipe_runtime::{RunError, RunOptions};

/// The number of threads: one for each processor, if it is not said.
pub(super) fn threads(asked: Option<NonZeroUsize>) -> NonZeroUsize {
    asked.or_else(|| available_parallelism().ok()).unwrap_or(NonZeroUsize::MIN)
}

/// Reads the files, and gives each cell what is meant for it. Also returns the options of the whole run.
pub(super) fn prepare(
    files: &[PathBuf],
    run: RunArgs,
    log: Log,
) -> Result<(Vec<Cell>, RunOptions), RunError> {
    let overrides = run.overrides.set.clone();
    // Even if a file is wrong, a ready file of a killed run is removed.
    let options = run.options(log);
    let names = CellNames::of(files)?;
    let overrides = names.shares(overrides.iter().map(|text| names.split("--set", text)))?;
    let mut read = Vec::with_capacity(files.len());
    for ((path, name), overrides) in files.iter().zip(&names.0).zip(overrides) {
        let config = check::load_gateway(path, &overrides)
            .map_err(|error| RunError::new(format!("{name}: {error}")))?;
        read.push((config, ConfigFile::read(path, overrides)?));
    }
    let options = options?;
    let binds = names.shares(options.binds.iter().map(|bind| {
        let (nth, text) = names.split("--bind", &bind.to_string())?;
        let port = text.split('=').next().unwrap_or_default().to_owned();
        Ok((nth, Bind { port, ..bind.clone() }))
    }))?;
    let mut cells = Vec::with_capacity(files.len());
    for (nth, ((config, file), binds)) in read.into_iter().zip(binds).enumerate() {
        let name = names.0[nth].clone();
        let console = options.console.as_ref().map(|console| console_of(console, nth, &name)).transpose()?;
        let options = RunOptions { binds, console, watch: Watch::new(), ..options.clone() };
        cells.push(Cell { name, config, file, options });
    }
    Ok((cells, RunOptions { binds: Vec::new(), console: None, ..options }))
}

/// The names of all cells.
struct CellNames(Vec<String>);

impl CellNames {
    fn of(files: &[PathBuf]) -> Result<Self, RunError> {
        let mut names: Vec<String> = Vec::with_capacity(files.len());
        for path in files {
            let Some(name) = path.file_stem() else {
                return Err(RunError::new(format!("-c {}: not the name of a file", path.display())));
            };
            let name = name.to_string_lossy().into_owned();
            if names.contains(&name) {
                return Err(RunError::new(format!(
                    "-c {}: another cell is called {name} too; a cell is called like its file, so give it another name",
                    path.display()
                )));
            }
            names.push(name);
        }
        Ok(Self(names))
    }

    /// The number of the cell that an option is for, and the option without the name.
    fn split(&self, option: &str, text: &str) -> Result<(usize, String), RunError> {
        let key = text.split('=').next().unwrap_or(text);
        let Some((cell, _)) = key.split_once('/') else {
            let first = self.0.first().map_or("", |name| name);
            return Err(RunError::new(format!(
                "{option} {text}: for which cell? Write the cell before it, such as {first}/{text}; there are {}",
                self.0.join(", ")
            )));
        };
        match self.0.iter().position(|name| name == cell) {
            Some(nth) => Ok((nth, text[cell.len() + 1..].to_owned())),
            None => Err(RunError::new(format!(
                "{option} {text}: there is no cell {cell}; there are {}",
                self.0.join(", ")
            ))),
        }
    }

    /// What each cell has of them.
    fn shares<T>(
        &self,
        all: impl Iterator<Item = Result<(usize, T), RunError>>,
    ) -> Result<Vec<Vec<T>>, RunError> {
        let mut shares: Vec<Vec<T>> = self.0.iter().map(|_| Vec::new()).collect();
        for one in all {
            let (nth, one) = one?;
            shares[nth].push(one);
        }
        Ok(shares)
    }
}

/// The console of a cell: the first one's is at the port that was asked for, the others' are at the next ones.
fn console_of(console: &ConsoleOptions, nth: usize, name: &str) -> Result<ConsoleOptions, RunError> {
    let ConsoleOptions { address, state, .. } = console;
    if console.peer.is_some() {
        return Err(RunError::new("--console-peer is for one cell; run a gateway of its own for it"));
    }
    let port = match address.port() {
        0 => Some(0),
        first => u16::try_from(nth).ok().and_then(|nth| first.checked_add(nth)),
    };
    let Some(port) = port else {
        return Err(RunError::new(format!(
            "--console {address}: there are not as many ports behind it as cells"
        )));
    };
    let state = state.as_ref().map(|folder| folder.join(name));
    Ok(ConsoleOptions { address: SocketAddr::new(address.ip(), port), state, ..console.clone() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(files: &[&str]) -> Result<CellNames, String> {
        let files: Vec<_> = files.iter().map(PathBuf::from).collect();
        CellNames::of(&files).map_err(|error| error.to_string())
    }

    #[test]
    fn an_option_is_for_the_cell_before_it() {
        let names = names(&["cells/left.toml", "right.toml"]).unwrap();
        let split = |text: &str| names.split("--set", text).map_err(|error| error.to_string());
        assert_eq!(split("left/port.a.baud=9600"), Ok((0, "port.a.baud=9600".into())));
        assert_eq!(split("right/a/b=pty:run/x"), Ok((1, "a/b=pty:run/x".into())), "a port may be called a/b");
        assert_eq!(
            split("a=pty:run/x"),
            Err("--set a=pty:run/x: for which cell? Write the cell before it, such as left/a=pty:run/x; there are \
                 left, right"
                .into())
        );
        assert_eq!(split("up/a=1"), Err("--set up/a=1: there is no cell up; there are left, right".into()));
    }

    #[test]
    fn cells_have_names_of_their_own() {
        assert!(
            names(&["a/cell.toml", "b/cell.toml"]).err().unwrap().contains("another cell is called cell too")
        );
        assert!(names(&["a.toml", ".."]).err().unwrap().contains("not the name of a file"));
    }

    #[test]
    fn consoles_have_one_port_after_the_other() {
        let console = ConsoleOptions {
            address: "127.0.0.1:65534".parse().unwrap(),
            key: None,
            state: Some("state".into()),
            peer: None,
        };
        let of = |nth| console_of(&console, nth, "right");
        let second = of(1).unwrap();
        assert_eq!((second.address.port(), second.state), (65535, Some("state/right".into())));
        assert!(of(2).unwrap_err().to_string().contains("not as many ports behind it"));
        let any = ConsoleOptions { address: "127.0.0.1:0".parse().unwrap(), ..console.clone() };
        assert_eq!(console_of(&any, 70_000, "right").unwrap().address.port(), 0);
        let peer = ConsoleOptions { peer: Some(1), ..console.clone() };
        console_of(&peer, 0, "left").unwrap_err();
    }
}
