//! Logging to stderr: stdout is for results.
//!
//! A separate thread writes, so that a reader that stops reading never blocks the caller. Beyond
//! [`MAX_WAITING`] bytes lines are lost, and the next one that is not says how many.

use std::io::{self, IsTerminal, Write, stderr};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tracing_subscriber::EnvFilter;

/// Logs warnings; with `-v` events, with `-vv` every frame. `RUST_LOG` overrides this.
pub(super) fn start(verbose: u8) -> Log {
    let level = match verbose {
        0 => "warn",
        1 => "info",
        _ => "trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let log = Log::start(stderr());
    let lines = Arc::clone(&log.lines);
    let format = tracing_subscriber::fmt().with_env_filter(filter);
    let format = format.with_writer(move || LogLine(Arc::clone(&lines)));
    // Fails only if logging is set up already.
    let _ = format.with_ansi(stderr().is_terminal()).try_init();
    log
}

/// The log. When it is dropped, waiting lines are written if that takes less than [`LAST_WRITE`].
#[derive(Debug)]
pub(super) struct Log {
    lines: Arc<Lines>,
}

#[derive(Debug, Default)]
struct Lines {
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Waiting {
    bytes: Vec<u8>,
    lost: u64,
    /// The thread is writing lines that it has taken.
    writing: bool,
}

impl Log {
    fn start(mut out: impl Write + Send + 'static) -> Self {
        let lines = Arc::new(Lines::default());
        let own = Arc::clone(&lines);
        // Without the thread nothing is logged; the program still works.
        let _ = std::thread::Builder::new().name("log".to_owned()).spawn(move || {
            loop {
                let bytes = own.take();
                let _ = out.write_all(&bytes);
                let _ = out.flush();
                own.lock().writing = false;
                own.changed.notify_all();
            }
        });
        Self { lines }
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        let waiting = self.lines.lock();
        let busy = |waiting: &mut Waiting| waiting.writing || !waiting.bytes.is_empty();
        drop(self.lines.changed.wait_timeout_while(waiting, LAST_WRITE, busy));
    }
}

impl Lines {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn put(&self, line: &[u8]) {
        let mut waiting = self.lock();
        if waiting.bytes.len() + line.len() > MAX_WAITING {
            waiting.lost += 1;
            return;
        }
        let lost = std::mem::take(&mut waiting.lost);
        if lost > 0 {
            waiting.bytes.extend_from_slice(format!("{lost} log lines lost\n").as_bytes());
        }
        waiting.bytes.extend_from_slice(line);
        self.changed.notify_all();
    }

    /// Waits for lines and takes them.
    fn take(&self) -> Vec<u8> {
        let none = |waiting: &mut Waiting| waiting.bytes.is_empty();
        let waited = self.changed.wait_while(self.lock(), none);
        let mut waiting = waited.unwrap_or_else(PoisonError::into_inner);
        waiting.writing = true;
        std::mem::take(&mut waiting.bytes)
    }
}

/// Writer of one line.
struct LogLine(Arc<Lines>);

impl Write for LogLine {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.put(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

const MAX_WAITING: usize = 1 << 20;
/// How long the end of the program waits for a reader.
const LAST_WRITE: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{Receiver, Sender, channel};

    /// Reports what it is to write, and waits for permission to write it.
    struct Slow(Sender<Vec<u8>>, Receiver<()>);

    impl Write for Slow {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.send(bytes.to_vec()).map_err(io::Error::other)?;
            self.1.recv().map_err(io::Error::other)?;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_reader_that_stops_loses_lines_and_blocks_nothing() {
        let (begins, begun) = channel();
        let (go, may) = channel();
        let log = Log::start(Slow(begins, may));
        log.lines.put(b"first\n");
        assert_eq!(begun.recv().unwrap(), b"first\n");
        // The reader has stopped: lines wait while there is room, the rest is lost.
        for _ in 0..3 << 10 {
            log.lines.put(&[b'x'; 1 << 10]);
        }
        go.send(()).unwrap();
        assert_eq!(begun.recv().unwrap().len(), MAX_WAITING);
        log.lines.put(b"last\n");
        go.send(()).unwrap();
        assert_eq!(begun.recv().unwrap(), b"2048 log lines lost\nlast\n");
        go.send(()).unwrap();
    }

    #[test]
    fn the_end_waits_until_lines_are_written() {
        let (begins, begun) = channel();
        let (go, may) = channel();
        let log = Log::start(Slow(begins, may));
        log.lines.put(b"goodbye\n");
        let reader = std::thread::spawn(move || {
            let said = begun.recv().unwrap();
            go.send(()).unwrap();
            said
        });
        drop(log);
        assert_eq!(reader.join().unwrap(), b"goodbye\n");
    }
}
