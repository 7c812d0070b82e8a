//! Child processes that never outlive a case, nor the tests that started them.

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rustix::process::{Pid, Signal};
use serde_json::Value;

use super::case::{Case, until};

/// Ticks of `/proc/PID/stat` in a second, on every Linux since 2.6.
const USER_HZ: u64 = 100;
/// First argument of this program when it is to become another one that ends with its parent.
const END_WITH: &str = "--end-with";

/// With [`END_WITH`], becomes the program that is named; returns only when it cannot.
pub(crate) fn is_started_to_end_with_us() -> Option<ExitCode> {
    let mut arguments = std::env::args_os().skip(1);
    if arguments.next()? != END_WITH {
        return None;
    }
    let parent: i32 = arguments.next()?.to_str()?.parse().ok()?;
    let program = arguments.next()?;
    let asked = rustix::process::set_parent_process_death_signal(Some(Signal::KILL));
    // The parent may have ended before the question.
    if asked.is_err() || rustix::process::getppid().map(|pid| pid.as_raw_pid()) != Some(parent) {
        return Some(ExitCode::FAILURE);
    }
    let error = Command::new(&program).args(arguments).exec();
    eprintln!("{}: {error}", program.display());
    Some(ExitCode::FAILURE)
}

/// Whether a program of this name can be started.
pub(crate) fn exists(name: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(name).is_file())
}

/// The processes of a case.
#[derive(Debug, Default, Clone)]
pub(crate) struct Running(Arc<Mutex<Vec<Pid>>>);

impl Running {
    /// Ends those that are still there.
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

/// A program that runs until it is dropped; it is asked nothing, it only says things.
#[derive(Debug)]
pub(crate) struct Program {
    child: Child,
    running: Running,
    lines: Arc<Mutex<Vec<String>>>,
    log: PathBuf,
}

impl Program {
    /// Starts it; what it says on stderr goes to a log that is called `name`.
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
        let mut child = command
            .args([END_WITH, &std::process::id().to_string()])
            .arg(program)
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(errors)
            .env("RUST_BACKTRACE", "1")
            .spawn()
            .unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let lines = Arc::<Mutex<Vec<String>>>::default();
        let sink = Arc::clone(&lines);
        std::thread::spawn(move || {
            for line in out.lines().map_while(Result::ok) {
                sink.lock().unwrap().push(line);
            }
        });
        let running = case.running.clone();
        let program = Self { child, running, lines, log };
        program.running.add(program.pid());
        program
    }

    pub(crate) fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// Fails when it has ended by itself.
    #[track_caller]
    pub(crate) fn must_run(&mut self) {
        if let Some(status) = self.child.try_wait().unwrap() {
            panic!("{} has ended: {status}", self.log.display());
        }
    }

    /// Waits until it has ended by itself.
    #[track_caller]
    pub(crate) fn ended(&mut self) -> ExitStatus {
        until("the program's end", || self.child.try_wait().unwrap())
    }

    /// What it says on stdout, by lines.
    pub(crate) fn lines(&self) -> std::sync::MutexGuard<'_, Vec<String>> {
        self.lines.lock().unwrap()
    }

    /// Everything it said on stderr.
    pub(crate) fn errors(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// The processor time that it took so far.
    #[track_caller]
    pub(crate) fn processor_time(&self) -> Duration {
        let path = format!("/proc/{}/stat", self.pid().as_raw_pid());
        let stat = std::fs::read_to_string(path).unwrap();
        // After the name, which may hold blanks: user and system time are the 12th and 13th.
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
        let ticks: u64 = fields[11..13].iter().map(|field| field.parse::<u64>().unwrap()).sum();
        Duration::from_millis(ticks * 1_000 / USER_HZ)
    }

    #[track_caller]
    pub(crate) fn signal(&self, signal: Signal) {
        rustix::process::kill_process(self.pid(), signal).unwrap();
    }

    /// Stops it, and returns once none of its threads runs.
    #[track_caller]
    pub(crate) fn freeze(&self) {
        self.signal(Signal::STOP);
        let tasks = format!("/proc/{}/task", self.pid().as_raw_pid());
        until("all threads are stopped", || {
            let mut tasks = std::fs::read_dir(&tasks).unwrap();
            let is_stopped = |task: std::io::Result<std::fs::DirEntry>| {
                let stat = std::fs::read_to_string(task.unwrap().path().join("stat")).unwrap();
                stat.rsplit_once(") ").is_some_and(|(_, state)| state.starts_with('T'))
            };
            tasks.all(is_stopped).then_some(())
        });
    }

    /// Ends it as a person would; it must end well.
    #[track_caller]
    pub(crate) fn interrupt(&mut self) {
        self.signal(Signal::INT);
        let status = self.ended();
        assert_eq!(status.code(), Some(0), "{} after Ctrl-C: {status}", self.log.display());
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.running.remove(self.pid());
        let _ = self.child.kill();
        let _ = self.child.wait();
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

    /// The newest statistics.
    pub(crate) fn newest(&self) -> Value {
        let lines = self.program.lines();
        lines.iter().rev().find_map(|line| serde_json::from_str(line).ok()).unwrap_or_default()
    }

    /// Statistics that satisfy `found`.
    #[track_caller]
    pub(crate) fn stats(&self, what: &str, found: impl Fn(&Value) -> bool) -> Value {
        let what = format!("{what}; the newest of {}", self.program.log.display());
        until(&what, || Some(self.newest()).filter(&found))
    }

    /// Statistics that were begun after this call.
    #[track_caller]
    pub(crate) fn fresh(&self) -> Value {
        let before = self.program.lines().len();
        // One may have been under way.
        until("statistics", || (self.program.lines().len() >= before + 2).then_some(()));
        self.newest()
    }
}
