//! The log: lines that go to stderr, and the newest of them for a console.
//!
//! Logging a line costs a copy. A thread of its own writes, so a stderr that is not read never blocks a thread that
//! logs. Beyond `MAX_WAITING` bytes lines are lost; the next written line says how many.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The log. Clones share it.
#[derive(Debug, Clone)]
pub struct Log(Arc<LogLines>);

/// When dropped, waits up to half a second until waiting lines are written.
#[derive(Debug)]
pub struct LastWrite(Log);

#[derive(Debug, Default)]
struct LogLines {
    waiting: Mutex<WaitingLines>,
    changed: Condvar,
    newest: Mutex<Newest>,
}

#[derive(Debug, Default)]
struct WaitingLines {
    bytes: Vec<u8>,
    lost: u64,
    /// The thread is writing lines that it has taken.
    writing: bool,
}

impl Log {
    /// A log that is written to `out` by a thread of its own. Without the thread nothing is logged; the program
    /// still works.
    pub fn start(mut out: impl Write + Send + 'static) -> Self {
        let lines = Arc::new(LogLines::default());
        let own = Arc::clone(&lines);
        let _ = std::thread::Builder::new().name("log".to_owned()).spawn(move || {
            loop {
                let bytes = own.take();
                locked(&own.newest).append(&bytes);
                let _ = out.write_all(&bytes);
                let _ = out.flush();
                locked(&own.waiting).writing = false;
                own.changed.notify_all();
            }
        });
        Self(lines)
    }

    /// A guard that waits for the last lines when it is dropped.
    pub fn last_write(&self) -> LastWrite {
        LastWrite(self.clone())
    }

    /// Logs a line that includes its line end.
    pub fn put(&self, line: &[u8]) {
        self.0.put(line);
    }

    /// The newest lines, the oldest first: at most `count`, and at most [`MAX_NEWEST`]. Colours are left out.
    pub fn newest(&self, count: usize) -> Vec<String> {
        // Lines that the thread cannot write, because stderr is not read, are newer.
        let stuck = {
            let waiting = locked(&self.0.waiting);
            let from = waiting.bytes.len().saturating_sub(MAX_STUCK);
            waiting.bytes.get(from..).unwrap_or(&[]).to_vec()
        };
        let mut newest = locked(&self.0.newest).clone();
        newest.append(&stuck);
        let from = newest.lines.len().saturating_sub(count);
        newest.lines.drain(from..).collect()
    }
}

impl Drop for LastWrite {
    fn drop(&mut self) {
        let lines = &*self.0.0;
        let waiting = locked(&lines.waiting);
        let busy = |waiting: &mut WaitingLines| waiting.writing || !waiting.bytes.is_empty();
        drop(lines.changed.wait_timeout_while(waiting, LAST_WRITE, busy));
    }
}

impl LogLines {
    fn put(&self, line: &[u8]) {
        let mut waiting = locked(&self.waiting);
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

    fn take(&self) -> Vec<u8> {
        let none = |waiting: &mut WaitingLines| waiting.bytes.is_empty();
        let waited = self.changed.wait_while(locked(&self.waiting), none);
        let mut waiting = waited.unwrap_or_else(PoisonError::into_inner);
        waiting.writing = true;
        std::mem::take(&mut waiting.bytes)
    }
}

#[derive(Debug, Clone, Default)]
struct Newest {
    lines: VecDeque<String>,
}

impl Newest {
    fn append(&mut self, bytes: &[u8]) {
        for line in String::from_utf8_lossy(bytes).lines() {
            if self.lines.len() >= MAX_NEWEST {
                self.lines.pop_front();
            }
            self.lines.push_back(plain(line));
        }
    }
}

/// A line without colours and other control characters, cut to [`MAX_LINE`].
fn plain(line: &str) -> String {
    let mut text = String::new();
    let mut chars = line.chars();
    while let Some(c) = chars.next() {
        match c {
            // CSI: up to its final character.
            '\u{1B}' => {
                let _ = chars.find(|c| c.is_ascii_alphabetic());
            }
            c if c.is_control() && c != '\t' => {}
            c if text.len() + c.len_utf8() > MAX_LINE => break,
            c => text.push(c),
        }
    }
    text
}

/// No code that holds these locks can panic half way.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Number of newest lines that are kept.
pub const MAX_NEWEST: usize = 256;
/// Bytes of a line that are kept.
const MAX_LINE: usize = 1 << 10;
/// Bytes that wait for the reader of stderr.
const MAX_WAITING: usize = 1 << 20;
/// Bytes of these that are searched for the newest lines.
const MAX_STUCK: usize = 64 << 10;
/// How long the end of the program waits for a reader.
const LAST_WRITE: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;
    use std::io;
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
        log.put(b"first\n");
        assert_eq!(begun.recv().unwrap(), b"first\n");
        // The reader has stopped: lines wait while there is room, the rest is lost.
        for _ in 0..3 << 10 {
            log.put(&[b'x'; 1 << 10]);
        }
        go.send(()).unwrap();
        assert_eq!(begun.recv().unwrap().len(), MAX_WAITING);
        log.put(b"last\n");
        go.send(()).unwrap();
        assert_eq!(begun.recv().unwrap(), b"2048 log lines lost\nlast\n");
        go.send(()).unwrap();
    }

    #[test]
    fn the_end_waits_until_lines_are_written() {
        let (begins, begun) = channel();
        let (go, may) = channel();
        let log = Log::start(Slow(begins, may));
        log.put(b"goodbye\n");
        let reader = std::thread::spawn(move || {
            let said = begun.recv().unwrap();
            go.send(()).unwrap();
            said
        });
        drop(log.last_write());
        assert_eq!(reader.join().unwrap(), b"goodbye\n");
    }

    #[test]
    fn the_newest_lines_are_there_even_if_nobody_reads_them() {
        let (begins, begun) = channel();
        let (go, may) = channel();
        let log = Log::start(Slow(begins, may));
        assert_eq!(log.newest(10), Vec::<String>::new());
        log.put(b"\x1b[2mfirst\x1b[0m\n");
        begun.recv().unwrap();
        // It is being written, and will be for ever.
        for nth in 0..MAX_NEWEST {
            log.put(format!("{nth}\n").as_bytes());
        }
        assert_eq!(log.newest(2), ["254", "255"]);
        let all = log.newest(usize::MAX);
        assert_eq!((all.len(), all[0].as_str()), (MAX_NEWEST, "0"));
        go.send(()).unwrap();
        begun.recv().unwrap();
        assert_eq!(log.newest(usize::MAX), all);
        assert_eq!(log.newest(0), Vec::<String>::new());
    }

    #[test]
    fn a_line_is_plain_text_and_not_endless() {
        assert_eq!(plain("\u{1B}[33m WARN\u{1B}[0m a\tb\u{7}"), " WARN a\tb");
        assert_eq!(plain(&"力".repeat(1_000)).len(), 1_023);
    }
}
