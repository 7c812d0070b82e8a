//! What tells a program to end: Ctrl-C, SIGTERM, and a terminal that is closed.

use std::io;

use tokio::signal::unix::{Signal, SignalKind, signal};

/// The signals that end a run, caught.
#[derive(Debug)]
pub struct Signals {
    interrupt: Signal,
    terminate: Signal,
    /// `None` under `nohup`, which means it.
    hang_up: Option<Signal>,
}

impl Signals {
    /// Catches them, in the current tokio runtime. From now on they no longer end the process.
    pub fn catch() -> io::Result<Self> {
        Ok(Self {
            // Looked up first: whoever catches a signal no longer ignores it.
            hang_up: if ignores_hang_up() { None } else { Some(signal(SignalKind::hangup())?) },
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
        })
    }

    /// Waits for one of them; returns its number. Cancel safe.
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

/// Whether whoever started this process wanted it to outlive its terminal.
fn ignores_hang_up() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ignored(&status) & 1 << (SignalKind::hangup().as_raw_value() - 1) != 0
}

/// The set of ignored signals in `/proc/PID/status`, the first one in bit 0.
fn ignored(status: &str) -> u64 {
    let set = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    set.and_then(|set| u64::from_str_radix(set.trim(), 16).ok()).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ignored_signals_are_read_as_the_system_shows_them() {
        assert_eq!(
            ignored("Name:\thost-sim\nSigIgn:\t0000000000001001\nSigCgt:\t0000000000000002\n"),
            0x1001
        );
        assert_eq!(ignored("Name:\thost-sim\n"), 0);
        // Rust's own start-up ignores SIGPIPE.
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        assert_ne!(ignored(&status) & 1 << (libc::SIGPIPE - 1), 0);
    }
}
