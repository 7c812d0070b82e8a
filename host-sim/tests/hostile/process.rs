//! A `host-sim` process, and what the system says of it.

use std::io::{BufRead, BufReader, Read};
use std::net::SocketAddr;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// How long anything that must happen may take.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

/// A running process that is killed when a test fails.
pub(crate) struct Process {
    child: Child,
    lines: Receiver<String>,
    ready: Value,
}

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
    let mut command = Command::new(env!("CARGO_BIN_EXE_host-sim"));
    command.args([kind, "--stats", "20ms", "-c"]).arg(here(file));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    command
}

fn here(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hostile").join(file)
}

impl Process {
    #[track_caller]
    pub(crate) fn start(command: &mut Command) -> Self {
        let mut child = command.spawn().unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in out.lines() {
                let Ok(line) = line else { return };
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let mut process = Self { child, lines, ready: Value::Null };
        let line = process.line();
        let json = line.strip_prefix("ready ").unwrap_or_else(|| panic!("not ready: {line}"));
        process.ready = serde_json::from_str(json).unwrap();
        process
    }

    /// The same, of a process whose output nobody reads; `file` is its ready file.
    #[track_caller]
    pub(crate) fn unread(command: &mut Command, file: &Path) -> Self {
        let child = command.spawn().unwrap();
        let mut process = Self { child, lines: channel().1, ready: Value::Null };
        let end = Instant::now() + PATIENCE;
        while process.ready.is_null() {
            assert!(Instant::now() < end, "not ready");
            let text = std::fs::read_to_string(file).unwrap_or_default();
            process.ready = serde_json::from_str(&text).unwrap_or_default();
            std::thread::sleep(Duration::from_millis(1));
        }
        process
    }

    /// The address of a server or port.
    #[track_caller]
    pub(crate) fn at(&self, name: &str) -> SocketAddr {
        let place = self.ready.pointer(&format!("/{name}")).and_then(Value::as_str);
        place.unwrap_or_else(|| panic!("{name} is nowhere: {}", self.ready)).parse().unwrap()
    }

    #[track_caller]
    fn line(&self) -> String {
        self.lines.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no line in time"))
    }

    /// A line of statistics that was made after this was asked for.
    #[track_caller]
    pub(crate) fn stats(&self) -> Value {
        loop {
            match self.lines.try_recv() {
                Ok(_) => {}
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => panic!("the process has ended"),
            }
        }
        // One may have been on its way.
        self.line();
        serde_json::from_str(&self.line()).unwrap()
    }

    /// The first line of statistics that is as wanted.
    #[track_caller]
    pub(crate) fn stats_when(&self, wanted: impl Fn(&Value) -> bool) -> Value {
        let end = Instant::now() + PATIENCE;
        loop {
            let stats: Value = serde_json::from_str(&self.line()).unwrap();
            if wanted(&stats) {
                return stats;
            }
            assert!(Instant::now() < end, "it never became so: {stats}");
        }
    }

    #[track_caller]
    pub(crate) fn usage(&self) -> Usage {
        let place = PathBuf::from(format!("/proc/{}", self.child.id()));
        let status = std::fs::read_to_string(place.join("status")).unwrap();
        let number = |key: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(key)).unwrap();
            line.split_whitespace().next().unwrap().parse().unwrap()
        };
        let descriptors = std::fs::read_dir(place.join("fd")).unwrap().count();
        Usage { rss_kib: number("VmRSS:"), descriptors, threads: number("Threads:") }
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Ends it as a person would, in bounded time.
    #[track_caller]
    pub(crate) fn end(mut self) {
        self.signal(Signal::TERM);
        let status = self.ended();
        assert_eq!((status.code(), status.signal()), (Some(0), None));
    }

    #[track_caller]
    pub(crate) fn ended(&mut self) -> std::process::ExitStatus {
        let end = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(Instant::now() < end, "it does not end");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// What it wrote on stderr, if that was piped. For a process that has ended.
    pub(crate) fn said(&mut self) -> String {
        let mut said = String::new();
        if let Some(mut stderr) = self.child.stderr.take() {
            stderr.read_to_string(&mut said).unwrap();
        }
        said
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
