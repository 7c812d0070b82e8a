//! CAN interfaces of the kernel, and the can-utils on them.

use std::process::{Command, Stdio};

use super::{Process, until};

/// Runs a tool until it ends and returns its stdout.
///
/// # Panics
/// If the tool cannot be run or fails.
#[track_caller]
pub fn tool(command: &str) -> String {
    let mut words = command.split_whitespace();
    let name = words.next().unwrap();
    let output = Command::new(name).args(words).stdin(Stdio::null()).output();
    let output = output.unwrap_or_else(|error| panic!("{name}: {error}; Debian: can-utils, iproute2"));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command}: {}: {errors}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// Sends a frame such as `001#0102`.
///
/// # Panics
/// If it cannot be sent.
#[track_caller]
pub fn cansend(interface: &str, frame: &str) {
    tool(&format!("cansend {interface} {frame}"));
}

/// A running `candump -L`.
#[derive(Debug)]
pub struct Candump(Process);

impl Candump {
    /// Starts `candump` and waits until it receives frames.
    ///
    /// # Panics
    /// If it does not start.
    #[track_caller]
    pub fn start(interface: &str) -> Self {
        let mut command = Command::new("stdbuf");
        command.args(["-oL", "candump", "-L", interface]).stdin(Stdio::null()).stdout(Stdio::piped());
        let dump = Self(Process::start(&mut command));
        until("candump listens", || {
            cansend(interface, MARK);
            dump.0.lines().iter().any(|line| line.ends_with(MARK)).then_some(())
        });
        dump
    }

    /// The whole log so far, as candump wrote it.
    pub fn log(&self) -> Vec<String> {
        let lines = self.0.lines();
        lines.iter().filter(|line| line.starts_with('(') && !line.ends_with(MARK)).cloned().collect()
    }

    /// The frames so far, such as `001#0102`.
    pub fn frames(&self) -> Vec<String> {
        self.log().iter().filter_map(|line| line.split_whitespace().nth(2)).map(str::to_owned).collect()
    }

    /// Waits until the frame has been on the bus.
    ///
    /// # Panics
    /// If it does not appear in time.
    #[track_caller]
    pub fn wait_for(&self, frame: &str) {
        until(frame, || self.frames().iter().any(|seen| seen == frame).then_some(()));
    }
}

/// A virtual interface that exists for one test.
#[derive(Debug)]
pub struct Vcan(pub &'static str);

impl Vcan {
    /// Creates the interface and brings it up.
    ///
    /// # Panics
    /// If that fails, for example without the required privileges.
    #[track_caller]
    pub fn new(name: &'static str) -> Self {
        let _ = Command::new("ip").args(["link", "del", name]).stderr(Stdio::null()).status();
        tool(&format!("ip link add {name} type vcan"));
        tool(&format!("ip link set {name} up"));
        Self(name)
    }
}

impl Drop for Vcan {
    fn drop(&mut self) {
        let _ = Command::new("ip").args(["link", "del", self.0]).stderr(Stdio::null()).status();
    }
}

/// A frame that no recipe has.
const MARK: &str = "7FE#";
