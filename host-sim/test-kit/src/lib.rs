//! Helpers that the tests of host-sim's crates share: processes, waiting, files, configurations, sources.
//!
//! A helper panics if what the test needs does not happen. None of them depends on the simulated controller, on cells
//! or on the runtime, so that every crate can use them.

pub mod can;
pub mod chip;
mod host_sim;
pub mod http;
pub mod latency;
mod process;
pub mod qemu;
pub mod source;
pub mod toml;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

pub use host_sim::{Binary, HostSim, SERVERS, command, free_servers};
pub use process::{Process, ended};

/// The timeout of every wait, far longer than a busy machine needs.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// Calls `look` repeatedly until it returns something.
///
/// # Panics
/// If it returns nothing for [`PATIENCE`].
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

/// Calls `count` repeatedly until it returns `wanted` or more. There is no limit for the whole time while the count
/// grows, because an emulator can be slow on a busy machine.
///
/// # Panics
/// If the count has not grown for [`PATIENCE`].
#[track_caller]
pub fn until_grown(what: &str, wanted: u64, mut count: impl FnMut() -> u64) {
    let mut reached = None;
    while reached < Some(wanted) {
        let more = until(&format!("{wanted} {what}; {}", reached.unwrap_or(0)), || {
            let newest = Some(count());
            (newest > reached).then_some(newest)
        });
        reached = more;
    }
}

/// The root folder of the repository.
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
/// If their folder cannot be read.
pub fn examples() -> Vec<PathBuf> {
    let mut files: Vec<_> =
        std::fs::read_dir(example("")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

/// The names of a folder's entries, sorted.
///
/// # Panics
/// If it cannot be read.
#[track_caller]
pub fn names(folder: &Path) -> Vec<String> {
    let names = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}
