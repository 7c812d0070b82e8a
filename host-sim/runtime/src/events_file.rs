//! `--events FILE`: every event of the controller as a line of JSON.
//!
//! A thread of its own writes, because a slow disk must not delay the controller. Lines beyond [`MAX_WAITING`] are
//! lost; the next written line says how many. An existing file is replaced only if it is an events file.

use std::cell::Cell;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use serde_json::Value;
use tracing::warn;

use super::RunError;

/// The path of an events file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventsFile {
    path: PathBuf,
}

impl EventsFile {
    /// The file at `path`, which is not written yet.
    ///
    /// # Errors
    /// If another kind of file is there.
    pub fn at(path: PathBuf) -> Result<Self, RunError> {
        let file = Self { path };
        file.check()?;
        Ok(file)
    }

    fn check(&self) -> Result<(), RunError> {
        if self.path.as_os_str() == "-" {
            return Err(self.refused("stdout is for `ready` and the counters; give the name of a file"));
        }
        match fs::symlink_metadata(&self.path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
            Err(error) => Err(self.refused(error)),
            Ok(found) if found.is_dir() => Err(self.refused("a folder; give the name of a file in it")),
            Ok(found) if !found.is_file() => Err(self.refused("not a regular file; give another name")),
            Ok(_) => {
                match self.begins_with_event() {
                    Ok(true) => Ok(()),
                    Ok(false) => Err(self
                        .refused("this file exists and has no events in it; give another name or remove it")),
                    Err(error) => Err(self.refused(error)),
                }
            }
        }
    }

    /// Whether the existing file is empty or begins with an event.
    fn begins_with_event(&self) -> io::Result<bool> {
        let mut first = Vec::new();
        BufReader::new(File::open(&self.path)?.take(MAX_LINE)).read_until(b'\n', &mut first)?;
        let is_event = |line: Value| ["n", "time_s", "event"].iter().all(|key| line.get(key).is_some());
        Ok(first.is_empty() || serde_json::from_slice(&first).is_ok_and(is_event))
    }

    /// Creates the file, or empties it, and starts to write.
    pub(super) fn create(&self) -> Result<EventsWriter, RunError> {
        self.check()?;
        let mut file = File::create(&self.path).map_err(|error| self.refused(error))?;
        let (lines, inbox) = sync_channel::<String>(MAX_WAITING);
        let path = self.path.display().to_string();
        let thread = std::thread::Builder::new().name("events".to_owned()).spawn(move || {
            let mut is_failing = false;
            for first in &inbox {
                // All waiting lines are written at once.
                let mut text = first;
                for more in inbox.try_iter() {
                    text.push_str(&more);
                }
                match file.write_all(text.as_bytes()) {
                    Ok(()) => is_failing = false,
                    Err(error) if !std::mem::replace(&mut is_failing, true) => {
                        warn!(file = %path, %error, "cannot write events");
                    }
                    Err(_) => {}
                }
            }
        });
        let thread = thread.map_err(|error| self.refused(error))?;
        Ok(EventsWriter { lines: Some(lines), lost: Cell::new(0), thread: Some(thread) })
    }

    fn refused(&self, why: impl std::fmt::Display) -> RunError {
        RunError::new(format!("--events {}: {why}", self.path.display()))
    }
}

/// Writes events. Dropping it writes everything that waits.
#[derive(Debug)]
pub(super) struct EventsWriter {
    lines: Option<SyncSender<String>>,
    lost: Cell<u64>,
    thread: Option<JoinHandle<()>>,
}

impl EventsWriter {
    pub(super) fn write(&self, line: &str) {
        let Some(lines) = &self.lines else { return };
        let text = match self.lost.get() {
            0 => format!("{line}\n"),
            lost => format!("{{\"lost\":{lost}}}\n{line}\n"),
        };
        let lost = if lines.try_send(text).is_ok() { 0 } else { self.lost.get() + 1 };
        self.lost.set(lost);
    }
}

impl Drop for EventsWriter {
    fn drop(&mut self) {
        self.lines = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Maximum number of lines that wait for the disk.
const MAX_WAITING: usize = 65_536;
/// Maximum length of an event's line in bytes; an event holds a command or a script at most.
const MAX_LINE: u64 = 2 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    const EVENT: &str = "{\"n\":1,\"time_s\":0.0,\"event\":\"started\"}\n";

    #[test]
    fn only_an_events_file_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events.jsonl");
        for replaced in ["", EVENT, &EVENT.repeat(3)] {
            fs::write(&path, replaced).unwrap();
            let writer = EventsFile::at(path.clone()).unwrap().create().unwrap();
            writer.write("{}");
            drop(writer);
            assert_eq!(fs::read_to_string(&path).unwrap(), "{}\n");
        }
        for kept in ["notes\n", "{}\n", "[1]\n", "\n", "{\"n\":1,\"event\":\"x\"}\n", "{\"n\":"] {
            fs::write(&path, kept).unwrap();
            let message = EventsFile::at(path.clone()).unwrap_err().to_string();
            assert!(
                message.starts_with(&format!("--events {}: this file exists", path.display())),
                "{message}"
            );
            assert_eq!(fs::read_to_string(&path).unwrap(), kept);
        }
        for (wrong, why) in [("-", "stdout is for"), ("/dev/null", "not a regular file"), ("/", "a folder")] {
            let message = EventsFile::at(wrong.into()).unwrap_err().to_string();
            assert!(message.contains(why), "{message}");
        }
        EventsFile::at(folder.path().join("new/events")).unwrap().create().unwrap_err();
    }

    #[test]
    fn what_waits_at_the_end_is_written_and_what_is_lost_is_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events.jsonl");
        let writer = EventsFile::at(path.clone()).unwrap().create().unwrap();
        const LINES: usize = 300_000;
        for nth in 0..LINES {
            writer.write(&nth.to_string());
        }
        drop(writer);
        let text = fs::read_to_string(&path).unwrap();
        let (mut seen, mut lost) = (0, 0);
        for line in text.lines() {
            match line.strip_prefix("{\"lost\":") {
                Some(count) => lost += count.strip_suffix('}').unwrap().parse::<usize>().unwrap(),
                None => {
                    assert_eq!(line, (seen + lost).to_string());
                    seen += 1;
                }
            }
        }
        assert!(seen + lost <= LINES && seen >= MAX_WAITING.min(LINES), "{seen} {lost}");
    }
}
