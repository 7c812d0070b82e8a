//! The signals that end a program: Ctrl-C (SIGINT), SIGTERM, and SIGHUP when its terminal is closed.

use std::io;

use tokio::signal::unix::{Signal, SignalKind, signal};

/// Handlers for the signals that end a run.
#[derive(Debug)]
pub struct Signals {
    interrupt: Signal,
    terminate: Signal,
    /// `None` if SIGHUP is ignored, as under `nohup`.
    hang_up: Option<Signal>,
}

impl Signals {
    /// Installs the handlers in the current tokio runtime. From now on the signals do not end the process.
    pub fn catch() -> io::Result<Self> {
        Ok(Self {
            // Checked first: a handler replaces the setting.
            hang_up: if ignores_hang_up() { None } else { Some(signal(SignalKind::hangup())?) },
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
        })
    }

    /// Waits for a signal and returns its number. Cancel safe.
    pub async fn next(&mut self) -> i32 {
        let hang_up = async {
            match &mut self.hang_up {
                Some(signal) => signal.recv().await,
                None => std::future::pending().await,
            }
        };
        let kind = tokio::select! {
            _ = self.interrupt.recv() => SignalKind::interrupt(),
            _ = self.terminate.recv() => SignalKind::terminate(),
            _ = hang_up => SignalKind::hangup(),
        };
        kind.as_raw_value()
    }
}

/// Whether this process was started with SIGHUP ignored.
fn ignores_hang_up() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ignored(&status) & 1 << (SignalKind::hangup().as_raw_value() - 1) != 0
}

/// The set of ignored signals in `/proc/PID/status`; signal 1 is bit 0.
fn ignored(status: &str) -> u64 {
    let set = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    set.and_then(|set| u64::from_str_radix(set.trim(), 16).ok()).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ignored_signals_are_read_from_proc() {
        assert_eq!(
            ignored("Name:\thost-sim\nSigIgn:\t0000000000001001\nSigCgt:\t0000000000000002\n"),
            0x1001
        );
        assert_eq!(ignored("Name:\thost-sim\n"), 0);
        // Rust's runtime ignores SIGPIPE.
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        assert_ne!(ignored(&status) & 1 << (libc::SIGPIPE - 1), 0);
    }
}
