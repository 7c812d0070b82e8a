//! A capture as a file or on a pipe, written by a thread of its own.
//!
//! In: a subscription. Out: pcapng. A failed write ends the capture, but nothing else: the file then ends with its last
//! whole packet.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use tracing::{info, warn};

use crate::pcapng::{MAGIC, Pcapng, Scope};
use crate::watch::{Interest, Next, Subscription, Watch};

/// The destination of a capture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// Standard output.
    Stdout,
    /// A file, a named pipe or a device. An existing capture is replaced.
    Path(PathBuf),
}

/// A capture that is being written.
#[derive(Debug)]
pub struct CaptureFile {
    ended: Receiver<()>,
}

impl CaptureFile {
    /// Starts a capture of the records of `watch` from now on.
    ///
    /// # Errors
    /// If the file cannot be created, or the path holds something other than a capture.
    pub fn start(watch: &Watch, scope: Scope, target: Target) -> io::Result<Self> {
        let open = match &target {
            Target::Stdout => None,
            Target::Path(path) => Some(check(path)?),
        };
        let subscription = watch.subscribe(Interest { frames: true, passes: false }, ROOM);
        let (end, ended) = channel();
        std::thread::Builder::new().name("capture".to_owned()).spawn(move || {
            // Dropped after the subscription.
            let _end: std::sync::mpsc::Sender<()> = end;
            let subscription = subscription;
            let name = match &target {
                Target::Stdout => "-".to_owned(),
                Target::Path(path) => path.display().to_string(),
            };
            let result = match (target, open) {
                (Target::Path(_), Some(Opened::File(file))) => write_file(file, scope, &subscription),
                // Waits for a reader.
                (Target::Path(path), _) => File::options()
                    .write(true)
                    .open(path)
                    .and_then(|mut pipe| write_all(&mut pipe, scope, &subscription, &mut 0)),
                (Target::Stdout, _) => write_all(&mut io::stdout().lock(), scope, &subscription, &mut 0),
            };
            match result {
                Ok(()) => {}
                Err(error) if error.kind() == io::ErrorKind::BrokenPipe => {
                    info!(capture = %name, "the capture ends: nobody reads it any more");
                }
                Err(error) => warn!(capture = %name, %error, "the capture ends: it cannot be written"),
            }
        })?;
        Ok(Self { ended })
    }

    /// Waits at most 2 s until everything is written: the reader may have stopped. Close the watch before.
    pub fn finish(self) {
        let _ = self.ended.recv_timeout(PATIENCE);
    }
}

enum Opened {
    File(File),
    /// A pipe or a device, which is opened when the capture begins.
    Pipe,
}

/// Checks that nothing is at the path, or a capture that may be replaced.
///
/// # Errors
/// Why nothing may be written there.
pub fn replaceable(path: &Path) -> io::Result<()> {
    let refused = |message: &str| Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
    let found = match fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        found => found?,
    };
    let kind = found.file_type();
    if kind.is_fifo() || kind.is_char_device() {
        return Ok(());
    }
    if !kind.is_file() {
        return refused("not a file; give another name");
    }
    let mut first = Vec::new();
    File::open(path)?.take(MAGIC.len() as u64).read_to_end(&mut first)?;
    if !first.is_empty() && first != MAGIC {
        return refused("this file exists and is no capture; give another name or remove it");
    }
    Ok(())
}

/// Opens a file, if it is new or replaces a capture.
fn check(path: &Path) -> io::Result<Opened> {
    replaceable(path)?;
    if let Ok(found) = fs::metadata(path)
        && !found.is_file()
    {
        return Ok(Opened::Pipe);
    }
    File::create(path).map(Opened::File)
}

fn write_file(mut file: File, scope: Scope, subscription: &Subscription) -> io::Result<()> {
    let mut whole = 0;
    write_all(&mut file, scope, subscription, &mut whole).inspect_err(|_| {
        // Remove a partial packet at the end.
        let _ = file.set_len(whole);
    })
}

/// Writes everything until the watch is closed. `whole` counts the bytes up to the last complete write.
fn write_all(
    out: &mut dyn Write,
    scope: Scope,
    subscription: &Subscription,
    whole: &mut u64,
) -> io::Result<()> {
    let mut capture = Pcapng::new(scope);
    loop {
        let mut blocks = match subscription.next(WAIT) {
            Next::Record(arrived) => capture.blocks(&arrived),
            Next::Nothing => continue,
            Next::End => return Ok(()),
        };
        // All waiting records are written at once.
        while blocks.len() < AT_ONCE
            && let Next::Record(arrived) = subscription.next(Duration::ZERO)
        {
            blocks.extend(capture.blocks(&arrived));
        }
        out.write_all(&blocks)?;
        out.flush()?;
        *whole += blocks.len() as u64;
    }
}

/// Maximum number of records that wait for the disk.
const ROOM: usize = 16_384;
/// Maximum number of bytes written at once.
const AT_ONCE: usize = 256 << 10;
const WAIT: Duration = Duration::from_secs(1);
/// How long the end of a capture waits for the reader.
const PATIENCE: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::SystemTime;

    use proto_core::engine::{PortId, TapDirection, TapPlace, TapVerdict};
    use proto_core::time::Instant;

    use super::*;
    use crate::frame::Frame;
    use crate::record::{Cell, CellPort, Epoch, Record, What};

    fn deliver(watch: &Watch, frames: u64) {
        let port = CellPort { id: PortId(0), name: "line".into(), is_can: false, bit_rate: 0 };
        let epoch = Epoch { at: Instant::from_micros(0), wall: SystemTime::UNIX_EPOCH };
        let cell = Arc::new(Cell { ports: vec![port], links: Vec::new(), decoder: Arc::default(), epoch });
        watch.give(Record { at: Instant::from_micros(0), lost: 0, what: What::Began(cell) });
        for nth in 0..frames {
            let frame = Frame {
                place: TapPlace::Port(PortId(0)),
                direction: TapDirection::In,
                verdict: TapVerdict::Taken,
                can_id: None,
                len: 100,
                bytes: Box::from([7; 100]),
            };
            watch.give(Record { at: Instant::from_micros(nth), lost: 0, what: What::Frame(frame) });
        }
    }

    #[test]
    fn a_capture_is_replaced_and_nothing_else_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.pcapng");
        for _ in 0..2 {
            let watch = Watch::new();
            let capture = CaptureFile::start(&watch, Scope::default(), Target::Path(path.clone())).unwrap();
            deliver(&watch, 10);
            watch.close();
            capture.finish();
            assert_eq!(fs::read(&path).unwrap()[..4], MAGIC);
        }
        let notes = folder.path().join("notes");
        fs::write(&notes, "dear diary").unwrap();
        let error =
            CaptureFile::start(&Watch::new(), Scope::default(), Target::Path(notes.clone())).unwrap_err();
        assert!(error.to_string().contains("is no capture"), "{error}");
        assert_eq!(fs::read_to_string(&notes).unwrap(), "dear diary");
        let folder = Target::Path(folder.path().into());
        assert!(CaptureFile::start(&Watch::new(), Scope::default(), folder).is_err());
    }

    #[test]
    fn a_full_disk_ends_the_capture_and_nothing_else() {
        let watch = Watch::new();
        let full = Target::Path("/dev/full".into());
        let capture = CaptureFile::start(&watch, Scope::default(), full).unwrap();
        deliver(&watch, 10);
        capture.finish();
        // Nothing is recorded without subscribers.
        assert_eq!(watch.wanted(), Interest::default());
        deliver(&watch, 10);
    }
}
