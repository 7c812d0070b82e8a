//! Child processes that outlive neither their case nor the tests.

use std::ffi::OsString;
use std::fs::File;
use std::ops::{Deref, DerefMut};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use recipe_test_kit::{Process, until};
use rustix::process::{Pid, Signal};
use serde_json::Value;

use super::case::Case;

/// Ticks per second in `/proc/PID/stat`, on every Linux since 2.6.
const USER_HZ: u64 = 100;
/// First argument that makes this program run another one, which ends with its parent.
const END_WITH: &str = "--end-with";

/// With [`END_WITH`], executes the named program; returns only if that fails.
pub(crate) fn is_started_to_end_with_us() -> Option<ExitCode> {
    let mut arguments = std::env::args_os().skip(1);
    if arguments.next()? != END_WITH {
        return None;
    }
    let parent: i32 = arguments.next()?.to_str()?.parse().ok()?;
    let program = arguments.next()?;
    let asked = rustix::process::set_parent_process_death_signal(Some(Signal::KILL));
    // The parent may have ended before the signal was set.
    if asked.is_err() || rustix::process::getppid().map(|pid| pid.as_raw_pid()) != Some(parent) {
        return Some(ExitCode::FAILURE);
    }
    let error = Command::new(&program).args(arguments).exec();
    eprintln!("{}: {error}", program.display());
    Some(ExitCode::FAILURE)
}

/// Whether a program of this name exists.
pub(crate) fn exists(name: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(name).is_file())
}

/// The processes of a case.
#[derive(Debug, Default, Clone)]
pub(crate) struct Running(Arc<Mutex<Vec<Pid>>>);

impl Running {
    /// Kills those that still run.
    pub(crate) fn kill(&self) {
        for pid in self.0.lock().unwrap().drain(..) {
            let _ = rustix::process::kill_process(pid, Signal::KILL);
        }
    }

    fn add(&self, pid: Pid) {
        self.0.lock().unwrap().push(pid);
    }

    fn remove(&self, pid: Pid) {
        self.0.lock().unwrap().retain(|&running| running != pid);
    }
}

/// A program of a case, without stdin.
#[derive(Debug)]
pub(crate) struct Program {
    process: Process,
    running: Running,
    log: PathBuf,
}

impl Program {
    /// Starts it, with stderr in the log `name`.
    #[track_caller]
    pub(crate) fn start(case: &Case, name: &str, program: &Path, arguments: &[OsString]) -> Self {
        let log = case.logs.join(format!("{name}.log"));
        let errors = File::options().create(true).append(true).open(&log).unwrap();
        let us = std::env::current_exe().unwrap();
        let mut command = case.namespace.get().map_or_else(
            || Command::new(&us),
            |namespace| {
                let mut command = namespace.inside();
                command.arg(&us);
                command
            },
        );
        command.args([END_WITH, &std::process::id().to_string()]).arg(program).args(arguments);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(errors).env("RUST_BACKTRACE", "1");
        let program = Self { process: Process::start(&mut command), running: case.running.clone(), log };
        program.running.add(program.pid());
        program
    }

    /// All of stderr.
    pub(crate) fn errors(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// The processor time that it took so far.
    #[track_caller]
    pub(crate) fn processor_time(&self) -> Duration {
        let path = format!("/proc/{}/stat", self.pid().as_raw_pid());
        let stat = std::fs::read_to_string(path).unwrap();
        // After the name, which may contain spaces, user and system time are fields 12 and 13.
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
        let ticks: u64 = fields[11..13].iter().map(|field| field.parse::<u64>().unwrap()).sum();
        Duration::from_millis(ticks * 1_000 / USER_HZ)
    }

    /// Ends it by SIGINT; the exit code must be 0.
    #[track_caller]
    pub(crate) fn interrupt(&mut self) {
        self.end_by(Signal::INT);
    }
}

impl Deref for Program {
    type Target = Process;

    fn deref(&self) -> &Process {
        &self.process
    }
}

impl DerefMut for Program {
    fn deref_mut(&mut self) -> &mut Process {
        &mut self.process
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.running.remove(self.pid());
    }
}

/// A running `host-sim`.
#[derive(Debug)]
pub(crate) struct HostSim {
    pub(crate) program: Program,
    pub(crate) ready: Value,
}

impl HostSim {
    /// Starts it and waits until it is ready.
    #[track_caller]
    pub(crate) fn start(case: &Case, what: &str, file: &Path, extra: &[String]) -> Self {
        let mut program = Self::spawn(case, what, file, extra);
        let ready = until(&format!("{what}'s ready line"), || {
            program.must_run();
            program.lines().iter().find_map(|line| Some(line.strip_prefix("ready ")?.to_owned()))
        });
        Self { ready: serde_json::from_str(&ready).unwrap(), program }
    }

    /// Starts it.
    #[track_caller]
    pub(crate) fn spawn(case: &Case, what: &str, file: &Path, extra: &[String]) -> Program {
        let mut arguments: Vec<OsString> = ["-v", what, "--stats", "50ms", "-c"].map(OsString::from).into();
        arguments.push(file.into());
        arguments.extend(extra.iter().map(OsString::from));
        Program::start(case, what, Path::new(env!("CARGO_BIN_EXE_host-sim")), &arguments)
    }
}
