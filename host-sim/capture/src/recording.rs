//! Recordings of whole runs: MCAP files in a folder, within a budget.
//!
//! In: a subscription. Out: `RUN.PART.mcap` files. A run is one start of `host-sim gateway`, named after its time. Its
//! parts are files of limited size. Each file has
//!
//! - a channel for the frames of each kind at each port, decoded to JSON with a schema: `/hand/input/502`
//! - a channel for frames that were rejected or that the file does not know: `/hand/rejected`, `/hand/other`
//! - the channel [`ENGINE`] with every call of the engine, from which [`replay`](crate::replay) runs it again.
//!
//! A new configuration of the gateway begins a new part, because the same channel may have other values then. The
//! oldest parts are removed when the folder is full. A killed process loses at most the last second.

mod folder;
mod part;

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant as Deadline};

use proto_core::engine::{TapDirection, TapPlace, TapVerdict};
use proto_core::wire::can::CanId;
use serde_json::{Value, json};
use tracing::{info, warn};

use crate::frame::{Frame, rejection};
use crate::record::{Cell, Record, What};
use crate::watch::{Arrived, Interest, Next, Subscription, Watch};
use part::RecordingPart;

pub(crate) use folder::run_of;
pub use folder::{Folder, run_name};

/// The channel of the engine's calls. Each message is one call, as entries of a recording (docs/cortex-m7.md section
/// 1); `sequence` counts the calls.
pub const ENGINE: &str = "/engine";
/// The encoding of the channel's messages.
pub const ENGINE_ENCODING: &str = "application/x-recipe-gateway-record";

/// Options of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordOptions {
    /// The folder, which is created if it does not exist.
    pub folder: PathBuf,
    /// Maximum number of bytes of all recordings in the folder.
    pub budget: u64,
    /// Maximum number of bytes of a file; at most half of the budget.
    pub file: u64,
}

/// A recording that is being written.
#[derive(Debug)]
pub struct Recording {
    ended: Receiver<()>,
    failures: Arc<AtomicU64>,
}

impl Recording {
    /// Starts to record the records of `watch`. Call it before the gateway starts, so its run can be replayed.
    pub fn start(watch: &Watch, options: RecordOptions) -> io::Result<Self> {
        let folder = Folder::open(&options.folder)?;
        let subscription = watch.subscribe(Interest { frames: true, passes: true }, ROOM);
        let (end, ended) = channel();
        let failures = Arc::<AtomicU64>::default();
        let recorder = Recorder {
            failures: Arc::clone(&failures),
            folder,
            options,
            cell: None,
            run: None,
            part: None,
            parts: 0,
            passes: 0,
            missed: 0,
            is_failing: false,
            retry_at: None,
        };
        let thread = std::thread::Builder::new().name("record".to_owned());
        thread.spawn(move || recorder.run(&subscription, end))?;
        Ok(Self { ended, failures })
    }

    /// Number of failed writes.
    pub fn failures(&self) -> u64 {
        self.failures.load(Relaxed)
    }

    /// Waits until everything is written. Close the watch before.
    pub fn finish(self) {
        let _ = self.ended.recv_timeout(PATIENCE);
    }
}

struct Recorder {
    failures: Arc<AtomicU64>,
    folder: Folder,
    options: RecordOptions,
    cell: Option<Arc<Cell>>,
    run: Option<String>,
    part: Option<RecordingPart>,
    parts: u32,
    /// Number of calls of the engine so far, including lost ones.
    passes: u32,
    /// Number of records missed since the newest call of the engine.
    missed: u64,
    is_failing: bool,
    /// When to retry after a failure.
    retry_at: Option<Deadline>,
}

impl Recorder {
    fn run(mut self, subscription: &Subscription, _end: Sender<()>) {
        let mut flush_at = Deadline::now() + FLUSH_INTERVAL;
        loop {
            let next = subscription.next(flush_at.saturating_duration_since(Deadline::now()));
            let result = match next {
                Next::Record(arrived) => self.take(&arrived),
                Next::Nothing => Ok(()),
                Next::End => break,
            };
            let result = result.and_then(|()| {
                if Deadline::now() < flush_at {
                    return Ok(());
                }
                flush_at = Deadline::now() + FLUSH_INTERVAL;
                self.part.as_mut().map_or(Ok(()), RecordingPart::flush)
            });
            if let Err(error) = result {
                self.failed(&error);
            }
        }
        if let Some(part) = self.part.take()
            && let Err(error) = part.finish()
        {
            self.failed(&error);
        }
    }

    /// Handles a failed write. Lost calls show as a gap in the numbers of the calls.
    fn failed(&mut self, error: &io::Error) {
        self.failures.fetch_add(1, Relaxed);
        self.part = None;
        self.retry_at = Some(Deadline::now() + RETRY_INTERVAL);
        if !std::mem::replace(&mut self.is_failing, true) {
            let folder = self.options.folder.display();
            warn!(%folder, %error, "cannot record; trying again every {} s", RETRY_INTERVAL.as_secs());
        }
    }

    fn take(&mut self, Arrived { record, missed }: &Arrived) -> io::Result<()> {
        self.missed += missed;
        let Record { at, lost, what } = &**record;
        if let What::Began(cell) = what {
            self.run.get_or_insert_with(|| run_name(cell.epoch.wall));
            self.cell = Some(Arc::clone(cell));
            // A channel has only one schema in a file.
            return self.part.take().map_or(Ok(()), RecordingPart::finish);
        }
        let sequence = match what {
            What::Pass(_) => {
                let gap = u64::from(*lost) + std::mem::take(&mut self.missed);
                self.passes =
                    self.passes.wrapping_add(u32::try_from(gap).unwrap_or(u32::MAX)).wrapping_add(1);
                self.passes
            }
            _ => 0,
        };
        let Some(cell) = self.cell.clone() else { return Ok(()) };
        if !self.has_part()? {
            return Ok(());
        }
        let Some(part) = &mut self.part else { return Ok(()) };
        let time = cell.epoch.unix_nanos(*at);
        match what {
            What::Pass(bytes) => part.engine(time, sequence, bytes)?,
            What::Frame(frame) => write_frame(part, &cell, time, frame)?,
            What::Began(_) => {}
        }
        if part.len() >= self.options.file.saturating_sub(MARGIN)
            && let Some(part) = self.part.take()
        {
            part.finish()?;
        }
        Ok(())
    }

    /// Begins the next file if there is none; false until a failure may be retried.
    fn has_part(&mut self) -> io::Result<bool> {
        if self.part.is_some() {
            return Ok(true);
        }
        if self.retry_at.is_some_and(|at| Deadline::now() < at) {
            return Ok(false);
        }
        let Some(run) = self.run.clone() else { return Ok(false) };
        self.folder.make_room(self.options.budget.saturating_sub(self.options.file))?;
        let path = self.folder.part(&run, self.parts + 1);
        self.part = Some(RecordingPart::create(&path, &run, self.parts + 1)?);
        self.parts += 1;
        self.retry_at = None;
        if std::mem::take(&mut self.is_failing) {
            info!(file = %path.display(), "recording again");
        }
        Ok(true)
    }
}

fn write_frame(part: &mut RecordingPart, cell: &Cell, time: u64, frame: &Frame) -> io::Result<()> {
    // The calls of the engine include the traffic of links.
    let TapPlace::Port(port) = frame.place else { return Ok(()) };
    let Some(port) = cell.port(port) else { return Ok(()) };
    if frame.verdict == TapVerdict::Taken
        && let Some((topic, values)) = cell.decoder.decode(&port.name, frame)
    {
        return part.message(&topic.name, &topic.title, &topic.schema, time, &values);
    }
    let why = rejection(frame);
    let kind = if why.is_some() { "rejected" } else { "other" };
    let name = format!("/{}/{kind}", recipe_export::names::mangle(&port.name));
    let mut values = json!({
        "direction": if frame.direction == TapDirection::In { "in" } else { "out" },
        "len": frame.len,
        "bytes": hex(&frame.bytes),
    });
    if let Some(why) = why {
        values["why"] = why.into();
    }
    match frame.can_id {
        None => {}
        Some(CanId::Standard(id)) => values["id"] = id.into(),
        Some(CanId::Extended(id)) => values["id"] = id.into(),
    }
    part.message(&name, "frame", &frame_schema(), time, &values)
}

/// The schema of frames without values.
fn frame_schema() -> Value {
    json!({ "type": "object", "title": "frame", "properties": {
        "direction": { "type": "string", "enum": ["in", "out"] },
        "len": { "type": "integer" },
        "bytes": { "type": "string", "description": "hexadecimal" },
        "why": { "type": "string", "description": "why it was rejected" },
        "id": { "type": "integer", "description": "on CAN" },
    } })
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

/// Maximum number of records that wait for the disk.
const ROOM: usize = 32_768;
/// The longest time that a killed process loses.
const FLUSH_INTERVAL: Duration = Duration::from_secs(1);
const RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// Maximum size of the end of a file: its last chunk, indexes and summary.
const MARGIN: u64 = 2 * part::CHUNK + (64 << 10);
/// Minimum size of a file with room for content.
pub const MIN_FILE: u64 = 4 * MARGIN;
/// How long the end of the program waits for the disk.
const PATIENCE: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests;
