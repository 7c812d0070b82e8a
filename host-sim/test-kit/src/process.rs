//! A program that runs until it is dropped, and what it says line by line.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};
use serde_json::Value;

use super::{PATIENCE, until};

/// A running program. It is killed when it is dropped; a test that fails shows what it said on stderr.
#[derive(Debug)]
pub struct Process {
    child: Child,
    out: Said,
    errors: Said,
    /// How many lines [`Self::line`] has returned.
    taken: AtomicUsize,
}

impl Process {
    /// Starts it. Of stdout and stderr, what is piped is read, all the time.
    ///
    /// # Panics
    /// When it cannot be started.
    #[track_caller]
    pub fn start(command: &mut Command) -> Self {
        let mut process = Self::unread(command);
        process.out = Said::of(process.child.stdout.take());
        process.errors = Said::of(process.child.stderr.take());
        process
    }

    /// The same, and nobody reads what it says.
    ///
    /// # Panics
    /// When it cannot be started.
    #[track_caller]
    pub fn unread(command: &mut Command) -> Self {
        let child = command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
        Self { child, out: Said::default(), errors: Said::default(), taken: AtomicUsize::new(0) }
    }

    /// Its number.
    pub fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// What it said on stdout so far, by lines.
    pub fn lines(&self) -> MutexGuard<'_, Vec<String>> {
        self.out.lines()
    }

    /// What it said on stderr so far, by lines.
    pub fn errors(&self) -> MutexGuard<'_, Vec<String>> {
        self.errors.lines()
    }

    /// Everything it said on stderr. Only of a program that has ended or soon will.
    pub fn all_errors(&mut self) -> String {
        self.errors.read_whole();
        self.errors().join("\n")
    }

    /// The next line of stdout.
    ///
    /// # Panics
    /// When none comes.
    #[track_caller]
    pub fn line(&self) -> String {
        let next = self.taken.fetch_add(1, Relaxed);
        until("a line on stdout", || self.lines().get(next).cloned())
    }

    /// The next line is one that has not come yet.
    pub fn skip_lines(&self) {
        self.taken.store(self.lines().len(), Relaxed);
    }

    /// The next statistics that satisfy `found`, each in its turn.
    ///
    /// # Panics
    /// When none come that do.
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

    /// The newest statistics; null when there are none.
    pub fn newest(&self) -> Value {
        self.lines().iter().rev().find_map(|line| serde_json::from_str(line).ok()).unwrap_or_default()
    }

    /// The newest statistics, once they satisfy `found`.
    ///
    /// # Panics
    /// When they never do.
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

    /// Statistics that were begun after this call.
    ///
    /// # Panics
    /// When none come.
    #[track_caller]
    pub fn fresh(&self) -> Value {
        self.skip_lines();
        // One may have been under way.
        self.line();
        serde_json::from_str(&self.line()).unwrap()
    }

    /// Fails when it has ended by itself.
    ///
    /// # Panics
    /// Then.
    #[track_caller]
    pub fn must_run(&mut self) {
        if let Some(status) = self.child.try_wait().unwrap() {
            panic!("it has ended: {status}");
        }
    }

    /// Sends it a signal.
    ///
    /// # Panics
    /// When it has ended and somebody knows.
    #[track_caller]
    pub fn signal(&self, signal: Signal) {
        rustix::process::kill_process(self.pid(), signal).unwrap();
    }

    /// Stops it, and returns once none of its threads runs.
    ///
    /// # Panics
    /// When it does not stop.
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

    /// How it has ended, by itself or because it was told to.
    ///
    /// # Panics
    /// When it has not, in time.
    #[track_caller]
    pub fn ended(&mut self) -> ExitStatus {
        ended(&mut self.child, PATIENCE)
    }

    /// Ends it by this signal; it must end well.
    ///
    /// # Panics
    /// When it does not.
    #[track_caller]
    pub fn end_by(&mut self, signal: Signal) {
        self.signal(signal);
        let status = self.ended();
        assert_eq!(status.code(), Some(0), "after {signal:?}: {status}");
    }

    /// Kills it, as nothing that it could prepare for.
    ///
    /// # Panics
    /// When the system does not.
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
            self.errors.read_whole();
            self.errors().iter().for_each(|line| eprintln!("{}: {line}", self.pid().as_raw_pid()));
        }
    }
}

/// How a child has ended; one that does not is killed.
///
/// # Panics
/// When it does not end within `patience`.
#[track_caller]
pub fn ended(child: &mut Child, patience: Duration) -> ExitStatus {
    let deadline = Instant::now() + patience;
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
struct Said {
    lines: Arc<Mutex<Vec<String>>>,
    reader: Option<std::thread::JoinHandle<()>>,
}

impl Said {
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
    fn read_whole(&mut self) {
        if let Some(reader) = self.reader.take() {
            let _ = reader.join();
        }
    }
}
