//! What the tests of host-sim's crates share: programs that run, waiting, files.
//!
//! Every helper panics when what a test needs does not happen. Nothing here knows a recipe, a
//! controller or an engine, so every crate can use it.

pub mod can;
mod host_sim;
mod process;
pub mod toml;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

pub use host_sim::{Binary, HostSim, SERVERS, free_servers};
pub use process::{Process, ended};

/// Longest wait for anything, far above what a busy machine needs.
pub const PATIENCE: Duration = Duration::from_secs(20);

/// Looks again and again until there is something.
///
/// # Panics
/// When there is nothing for [`PATIENCE`].
#[track_caller]
pub fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "not within {PATIENCE:?}: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// The top folder of the repository.
pub fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// An example file, such as `rs485-system.toml`.
pub fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs").join(name)
}

/// All example files, sorted.
///
/// # Panics
/// When their folder cannot be read.
pub fn examples() -> Vec<PathBuf> {
    let mut files: Vec<_> =
        std::fs::read_dir(example("")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

/// The names of what is in a folder, sorted.
///
/// # Panics
/// When it cannot be read.
#[track_caller]
pub fn names(folder: &Path) -> Vec<String> {
    let names = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}
