//! A process that runs until it is dropped, and its output by lines.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};
use serde_json::Value;

use super::{PATIENCE, until};

/// A running process. It is killed when it is dropped; its stderr is shown if the test fails.
#[derive(Debug)]
pub struct Process {
    child: Child,
    out: PipeLines,
    errors: PipeLines,
    /// Number of lines that [`Self::line`] has returned.
    taken: AtomicUsize,
}

impl Process {
    /// Starts the process. Stdout and stderr are read continuously if they are piped.
    ///
    /// # Panics
    /// If it cannot be started.
    #[track_caller]
    pub fn start(command: &mut Command) -> Self {
        let mut process = Self::unread(command);
        process.out = PipeLines::of(process.child.stdout.take());
        process.errors = PipeLines::of(process.child.stderr.take());
        process
    }

    /// As [`Self::start`], without reading the output.
    ///
    /// # Panics
    /// If it cannot be started.
    #[track_caller]
    pub fn unread(command: &mut Command) -> Self {
        let child = command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
        Self { child, out: PipeLines::default(), errors: PipeLines::default(), taken: AtomicUsize::new(0) }
    }

    /// The process id.
    pub fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// The lines of stdout so far.
    pub fn lines(&self) -> MutexGuard<'_, Vec<String>> {
        self.out.lines()
    }

    /// The lines of stderr so far.
    pub fn errors(&self) -> MutexGuard<'_, Vec<String>> {
        self.errors.lines()
    }

    /// All of stderr. Waits until the process has closed it.
    pub fn all_errors(&mut self) -> String {
        self.errors.read_to_end();
        self.errors().join("\n")
    }

    /// The next line of stdout.
    ///
    /// # Panics
    /// If there is none in time.
    #[track_caller]
    pub fn line(&self) -> String {
        let next = self.taken.fetch_add(1, Relaxed);
        until("a line on stdout", || self.lines().get(next).cloned())
    }

    /// Skips the lines so far: [`Self::line`] then returns a later one.
    pub fn skip_lines(&self) {
        self.taken.store(self.lines().len(), Relaxed);
    }

    /// Reads statistics line by line until some satisfy `found`.
    ///
    /// # Panics
    /// If none do in time.
    #[track_caller]
    pub fn next_stats(&self, found: impl Fn(&Value) -> bool) -> Value {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let stats: Value = serde_json::from_str(&self.line()).unwrap();
            if found(&stats) {
                return stats;
            }
            assert!(Instant::now() < deadline, "it never became so: {stats}");
        }
    }

    /// The newest statistics; null if there are none.
    pub fn newest(&self) -> Value {
        self.lines().iter().rev().find_map(|line| serde_json::from_str(line).ok()).unwrap_or_default()
    }

    /// The newest statistics, once they satisfy `found`.
    ///
    /// # Panics
    /// If they do not in time.
    #[track_caller]
    pub fn stats(&self, what: &str, found: impl Fn(&Value) -> bool) -> Value {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let newest = self.newest();
            if found(&newest) {
                return newest;
            }
            assert!(Instant::now() < deadline, "not within {PATIENCE:?}: {what}; the newest: {newest}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Statistics that were collected after this call.
    ///
    /// # Panics
    /// If there are none in time.
    #[track_caller]
    pub fn fresh(&self) -> Value {
        self.skip_lines();
        // The next line may have been collected before this call.
        self.line();
        serde_json::from_str(&self.line()).unwrap()
    }

    /// Whether it has ended.
    ///
    /// # Panics
    /// If the system cannot tell.
    pub fn has_ended(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Checks that it is still running.
    ///
    /// # Panics
    /// If it has ended.
    #[track_caller]
    pub fn must_run(&mut self) {
        if let Some(status) = self.child.try_wait().unwrap() {
            panic!("it has ended: {status}");
        }
    }

    /// Sends it a signal.
    ///
    /// # Panics
    /// If it has ended and was waited for.
    #[track_caller]
    pub fn signal(&self, signal: Signal) {
        rustix::process::kill_process(self.pid(), signal).unwrap();
    }

    /// Suspends it with SIGSTOP; returns when all of its threads are stopped.
    ///
    /// # Panics
    /// If it does not stop.
    #[track_caller]
    pub fn freeze(&self) {
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

    /// Waits until it ends; returns its exit status.
    ///
    /// # Panics
    /// If it does not end in time.
    #[track_caller]
    pub fn ended(&mut self) -> ExitStatus {
        ended(&mut self.child, PATIENCE)
    }

    /// Ends it with this signal.
    ///
    /// # Panics
    /// If the exit code is not 0.
    #[track_caller]
    pub fn end_by(&mut self, signal: Signal) {
        self.signal(signal);
        let status = self.ended();
        assert_eq!(status.code(), Some(0), "after {signal:?}: {status}");
    }

    /// Kills it with SIGKILL.
    ///
    /// # Panics
    /// If the system refuses.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            self.errors.read_to_end();
            self.errors().iter().for_each(|line| eprintln!("{}: {line}", self.pid().as_raw_pid()));
        }
    }
}

/// Waits until a child ends; returns its exit status. A child that does not end is killed.
///
/// # Panics
/// If it does not end within `timeout`.
#[track_caller]
pub fn ended(child: &mut Child, timeout: Duration) -> ExitStatus {
    let deadline = Instant::now() + timeout;
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status;
        }
        if Instant::now() > deadline {
            let _ = child.kill();
            panic!("it does not end");
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// The lines of a pipe, read by a thread.
#[derive(Debug, Default)]
struct PipeLines {
    lines: Arc<Mutex<Vec<String>>>,
    reader: Option<std::thread::JoinHandle<()>>,
}

impl PipeLines {
    fn of(pipe: Option<impl Read + Send + 'static>) -> Self {
        let lines = Arc::<Mutex<Vec<String>>>::default();
        let sink = Arc::clone(&lines);
        let reader = pipe.map(|pipe| {
            std::thread::spawn(move || {
                for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                    sink.lock().unwrap().push(line);
                }
            })
        });
        Self { lines, reader }
    }

    fn lines(&self) -> MutexGuard<'_, Vec<String>> {
        self.lines.lock().unwrap()
    }

    /// Waits until the pipe is closed.
    fn read_to_end(&mut self) {
        if let Some(reader) = self.reader.take() {
            let _ = reader.join();
        }
    }
}
