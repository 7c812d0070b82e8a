//! Why does it not work? Each fault of a cell, in real processes: the log of a gateway with `-v` and
//! `host-sim doctor` name its cause.

mod can;
mod line;
mod links;
mod quiet;
mod robot;

use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::Output;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use recipe_test_kit::{Binary, HostSim, PATIENCE, until};
use serde_json::Value;

const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));
/// How often a device sends.
const PERIOD: Duration = Duration::from_millis(20);

/// A device at the other end of a line, until it is dropped.
struct Feeder {
    ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Feeder {
    /// It opens the line as soon as it is there, and sends this every [`PERIOD`].
    fn start(line: &Path, bytes: &[u8]) -> Self {
        let (ends, line, bytes) = (Arc::<AtomicBool>::default(), line.to_owned(), bytes.to_vec());
        let own = Arc::clone(&ends);
        let thread = std::thread::spawn(move || {
            let mut device = None;
            while !own.load(Relaxed) {
                if device.is_none() {
                    device = File::options().read(true).write(true).open(&line).ok();
                }
                // Another gateway makes a new line in its place.
                if device.as_mut().is_some_and(|device: &mut File| device.write_all(&bytes).is_err()) {
                    device = None;
                }
                std::thread::sleep(PERIOD);
            }
        });
        Self { ends, thread: Some(thread) }
    }
}

impl Drop for Feeder {
    fn drop(&mut self) {
        self.ends.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Waits until the log of a gateway has a line with all these words.
#[track_caller]
fn logs(gateway: &HostSim, words: &[&str]) {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let log = gateway.errors().clone();
        if log.iter().any(|line| words.iter().all(|word| line.contains(word))) {
            return;
        }
        assert!(Instant::now() < deadline, "{words:?} not in {log:#?}");
        std::thread::sleep(PERIOD);
    }
}

/// Runs `host-sim doctor` with these arguments; returns its findings, and that its exit code fits them.
#[track_caller]
fn doctor(file: &Path, arguments: &[String]) -> Vec<Value> {
    let mut command = BINARY.command();
    command.args(["doctor", "--json", "--for", "5s", "-c"]).arg(file).args(arguments);
    let output: Output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let findings: Vec<Value> = serde_json::from_str(&said)
        .unwrap_or_else(|error| panic!("{error}: {said}{}", String::from_utf8_lossy(&output.stderr)));
    let is_well = findings.iter().all(|finding| finding["severity"] == "note");
    assert_eq!(output.status.code(), Some(i32::from(!is_well)), "{said}");
    findings
}

/// One of the findings has this cause and these words.
#[track_caller]
fn finds(findings: &[Value], cause: &str, words: &[&str]) {
    let finding = findings.iter().find(|finding| finding["cause"] == cause);
    let text = finding.unwrap_or_else(|| panic!("no {cause} in {findings:#?}"))["text"].as_str().unwrap();
    for word in words {
        assert!(text.contains(word), "{word:?} is not in {text}");
    }
}

/// Waits until a file is there.
fn appears(path: &Path) {
    until("the line", || path.exists().then_some(()));
}
