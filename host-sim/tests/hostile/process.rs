//! A `host-sim` process, and what the system says of it.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use recipe_test_kit::{Binary, HostSim};

/// What a process holds.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Usage {
    /// Resident memory.
    pub(crate) rss_kib: u64,
    pub(crate) descriptors: usize,
    pub(crate) threads: u64,
}

/// `host-sim KIND -c FILE` with statistics, ready to be given more.
pub(crate) fn host_sim(kind: &str, file: &str) -> Command {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hostile");
    let mut command = Binary(env!("CARGO_BIN_EXE_host-sim")).command();
    command.args([kind, "--stats", "20ms", "-c"]).arg(here.join(file));
    // What attacks make it say is not for a person.
    command.stderr(Stdio::null());
    command
}

#[track_caller]
pub(crate) fn usage(process: &HostSim) -> Usage {
    let place = PathBuf::from(format!("/proc/{}", process.pid().as_raw_pid()));
    let status = std::fs::read_to_string(place.join("status")).unwrap();
    let number = |key: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(key)).unwrap();
        line.split_whitespace().next().unwrap().parse().unwrap()
    };
    let descriptors = std::fs::read_dir(place.join("fd")).unwrap().count();
    Usage { rss_kib: number("VmRSS:"), descriptors, threads: number("Threads:") }
}
