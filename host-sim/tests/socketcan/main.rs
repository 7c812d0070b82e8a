//! CAN interfaces of the kernel: the programs as separate processes on a CAN interface of Linux.
//!
//! `HOST_SIM_VCAN` chooses where:
//!
//! * `HOST_SIM_VCAN=uml cargo test --test socketcan`: on a separate kernel that runs as an ordinary process
//!   (`tests/uml/run`); no privileges are needed.
//! * `HOST_SIM_VCAN=vcan0 cargo test --test socketcan`: on this machine's interface of that name. Tests that
//!   change interfaces need root; without it they are counted as ignored.
//! * Without it every test is counted as ignored.
//!
//! `HOST_SIM_PYTHON` is a Python with python-can. `HOST_SIM_LOAD_SECONDS` is the length of the run under full
//! load (default 2).

mod adapter;
mod examples;
mod faults;
mod load;

use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use libtest_mimic::{Arguments, Failed, Trial};
use recipe_test_kit::Binary;

const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));

/// What a test needs in addition to the interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Needs {
    Nothing,
    /// Permission to make interfaces and take them down.
    Root,
    /// A Python with python-can.
    Python,
    /// Root, and the kernel's driver for adapters on serial lines.
    Slcan,
}

const HOW: &str = "HOST_SIM_VCAN=uml cargo test --test socketcan (Debian: apt-get install user-mode-linux \
                   busybox-static can-utils iproute2 gcc libc6-dev), or HOST_SIM_VCAN=vcan0 on a machine that has one";

fn main() -> ExitCode {
    let mut arguments = Arguments::from_args();
    // The tests share a bus.
    arguments.test_threads = Some(1);
    let chosen = std::env::var("HOST_SIM_VCAN").ok().filter(|chosen| !chosen.is_empty());
    if chosen.as_deref() == Some("uml") && !arguments.list {
        let runner = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/uml/run");
        let mut command = Command::new(&runner);
        command.args(std::env::current_exe()).args(std::env::args_os().skip(1));
        let error = command.env("HOST_SIM_VCAN", "vcan0").exec();
        eprintln!("{}: {error}", runner.display());
        return ExitCode::FAILURE;
    }
    if chosen.is_none() {
        eprintln!("socketcan: skipped, there is no CAN interface; {HOW}");
    }
    let interface = chosen.unwrap_or_default();
    let trials = [examples::trials(&interface), faults::trials(&interface), load::trials(&interface)];
    let trials = trials.into_iter().flatten().map(|(name, needs, test)| {
        let missing = missing(&interface, needs);
        let trial = Trial::test(name, move || {
            test();
            Ok::<(), Failed>(())
        });
        match missing {
            Some(missing) => trial.with_kind(missing).with_ignored_flag(true),
            None => trial,
        }
    });
    libtest_mimic::run(&arguments, trials.collect()).exit_code()
}

/// A test's name, needs and function.
type Test = (&'static str, Needs, Box<dyn FnOnce() + Send>);

/// What a test needs and this machine lacks.
fn missing(interface: &str, needs: Needs) -> Option<&'static str> {
    let root = rustix::process::geteuid().is_root();
    if interface.is_empty() {
        return Some("needs HOST_SIM_VCAN");
    }
    match needs {
        Needs::Python if python().is_none() => Some("needs HOST_SIM_PYTHON"),
        Needs::Root if !root => Some("needs root"),
        Needs::Slcan if !root || !Path::new("/sys/module/slcan").exists() => Some("needs root and slcan.ko"),
        _ => None,
    }
}

/// The Python to run: the configured one, or that of the foreign clients if it exists.
fn python() -> Option<PathBuf> {
    if let Some(python) = std::env::var_os("HOST_SIM_PYTHON") {
        return Some(python.into());
    }
    let usual = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/foreign/venv/bin/python");
    usual.exists().then_some(usual)
}
