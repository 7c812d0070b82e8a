//! Lines for stdout.

use std::io::{self, Write};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, mpsc as blocking};

use tokio::sync::mpsc;

use crate::out::is_broken_pipe;

/// Lines for stdout, written by a thread of its own, because a slow reader must not delay signals. Lines that
/// are not read or cannot be written are lost and counted.
pub(super) struct Stdout {
    waiting: blocking::SyncSender<String>,
    pub(super) failures: mpsc::UnboundedReceiver<StdoutFailure>,
    /// Closed when everything has been written.
    written: blocking::Receiver<()>,
    lost: Arc<AtomicU64>,
}

/// Why a line was not written; reported once until a line is written again.
pub(super) enum StdoutFailure {
    /// The reader has closed stdout.
    Closed,
    /// It was the first line, `ready`.
    NotReady(io::Error),
    /// It was another line; the next may succeed, such as after a full disk.
    Lost(io::Error),
}

impl Stdout {
    pub(super) fn start() -> io::Result<Self> {
        let (waiting, inbox) = blocking::sync_channel::<String>(MAX_LINES);
        let (open, written) = blocking::channel();
        let (report, failures) = mpsc::unbounded_channel();
        let lost = Arc::<AtomicU64>::default();
        let count = Arc::clone(&lost);
        std::thread::Builder::new().name("stdout".to_owned()).spawn(move || {
            let _open: blocking::Sender<()> = open;
            let mut failing = false;
            for (nth, line) in inbox.into_iter().enumerate() {
                let Err(error) = print_line(&line) else {
                    failing = false;
                    continue;
                };
                count.fetch_add(1, Relaxed);
                if !std::mem::replace(&mut failing, true) {
                    let _ = report.send(match nth {
                        _ if is_broken_pipe(&error) => StdoutFailure::Closed,
                        0 => StdoutFailure::NotReady(error),
                        _ => StdoutFailure::Lost(error),
                    });
                }
            }
        })?;
        Ok(Self { waiting, failures, written, lost })
    }

    pub(super) fn print(&mut self, line: String) {
        if self.waiting.try_send(line).is_err() {
            self.lost.fetch_add(1, Relaxed);
        }
    }

    pub(super) fn lost(&self) -> u64 {
        self.lost.load(Relaxed)
    }

    /// Waits until all lines are written, for [`FLUSH_TIMEOUT`] at most.
    pub(super) fn finish(self) {
        drop(self.waiting);
        let _ = self.written.recv_timeout(FLUSH_TIMEOUT);
    }
}

/// Maximum number of lines that wait for the reader of stdout.
const MAX_LINES: usize = 16;
/// How long the end of the program waits for the reader.
const FLUSH_TIMEOUT: std::time::Duration = std::time::Duration::from_millis(500);

fn print_line(line: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}
