//! A `host-sim` process, and its use of resources.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use recipe_test_kit::{Binary, HostSim};

/// Resources that a process holds.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Usage {
    /// Resident memory.
    pub(crate) rss_kib: u64,
    pub(crate) descriptors: usize,
    pub(crate) threads: u64,
}

/// A command for `host-sim KIND -c FILE` with statistics, to which arguments can be added.
pub(crate) fn host_sim(kind: &str, file: &str) -> Command {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hostile");
    let mut command = Binary(env!("CARGO_BIN_EXE_host-sim")).command();
    command.args([kind, "--stats", "20ms", "-c"]).arg(here.join(file));
    // Attacks fill the log.
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
