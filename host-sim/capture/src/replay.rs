//! Replays a recorded run in virtual time: another engine gets the same inputs, and its outputs are compared byte for
//! byte.
//!
//! In: a recording ([`crate::recording`]), or a plain recording of `proto_core::record`. Out: whether this program's
//! engine makes the same decisions, and the first difference. An engine has to be run from its start: a recording
//! without its first part cannot be replayed, and a recording with a gap only up to the gap.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use proto_core::config::GatewayConfig;
use proto_core::config::image;
use proto_core::engine::{Engine, Input, OUTPUT_BUFFER, Output};
use proto_core::record::{Entry, MAGIC, totals};
use proto_core::time::Instant;

use crate::calls::{self, RecordingEnd, Then};
use crate::recording::{Folder, run_of};

/// Why a recording cannot be replayed at all.
#[derive(Debug)]
#[non_exhaustive]
pub enum ReplayError {
    /// A file cannot be read.
    Io(PathBuf, io::Error),
    /// The folder has no recording.
    Empty(PathBuf),
    /// The file is not a recording, or a recording of another version.
    NotARecording(PathBuf),
    /// The beginning of the run is missing.
    NoStart(PathBuf),
    /// The configuration cannot be run by this program.
    Config(String),
    /// The plain recording cannot be written.
    Plain(io::Error),
}

impl fmt::Display for ReplayError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Io(path, error) => write!(f, "{}: {error}", path.display()),
            Self::Empty(path) => write!(f, "{}: there is no recording in this folder", path.display()),
            Self::NotARecording(path) => write!(f, "{}: not a recording of a gateway", path.display()),
            Self::NoStart(path) => write!(
                f,
                "{}: the run does not begin in this recording; its first part was dropped, and without it no engine \
                 can be run again (a larger --record-budget keeps it longer)",
                path.display()
            ),
            Self::Config(error) => write!(f, "the recorded configuration cannot be run: {error}"),
            Self::Plain(error) => write!(f, "the plain recording: {error}"),
        }
    }
}

impl std::error::Error for ReplayError {}

/// The result of a replay.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// Number of started engines.
    pub starts: u64,
    /// Number of inputs passed to the engines.
    pub inputs: u64,
    /// Number of compared outputs.
    pub outputs: u64,
    /// The first and the last instant.
    pub span: Option<(Instant, Instant)>,
    /// Number of files.
    pub files: usize,
    /// Whether the recording ends within an entry or a chunk, as after a killed process.
    pub is_cut: bool,
    /// Why the replay ended before the recording.
    pub stopped: Option<Stopped>,
}

/// Why a replay ended early.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Stopped {
    /// The engine behaved differently.
    Differs(Box<Difference>),
    /// Calls of the engine are missing.
    Gap {
        /// The last instant before the gap.
        at: Option<Instant>,
        /// Number of missing calls.
        missing: u32,
    },
}

/// The first difference between two engines.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The time of the difference.
    pub at: Instant,
    /// The input, in words.
    pub input: String,
    /// The outputs of the recorded engine.
    pub recorded: Vec<String>,
    /// The outputs of the replayed engine.
    pub replayed: Vec<String>,
}

/// Replays a file, or the newest run of a folder. A file that is part of a run stands for the whole run. With `plain`,
/// the recording is also written there without its container, as `proto_core::record::replay` takes it.
pub fn replay(path: &Path, plain: Option<&mut dyn Write>) -> Result<Report, ReplayError> {
    let io_error = |error| ReplayError::Io(path.to_owned(), error);
    let mut runner = Runner { plain, ..Runner::default() };
    if fs::metadata(path).map_err(io_error)?.is_file() {
        let bytes = first_bytes(path).map_err(io_error)?;
        if bytes == MAGIC {
            let bytes = fs::read(path).map_err(io_error)?;
            runner.write_plain(&MAGIC)?;
            runner.report.files = 1;
            runner.entries(bytes.get(MAGIC.len()..).unwrap_or(&[]))?;
            return runner.finish(path);
        }
    }
    let parts = parts_of(path).map_err(io_error)?;
    if parts.is_empty() {
        return Err(ReplayError::Empty(path.to_owned()));
    }
    runner.write_plain(&MAGIC)?;
    let mut sequence = None;
    for part in &parts {
        runner.report.files += 1;
        if !runner.part(part, &mut sequence)? {
            break;
        }
    }
    runner.finish(path)
}

/// The files of a run.
fn parts_of(path: &Path) -> io::Result<Vec<PathBuf>> {
    if path.is_dir() {
        return Folder::open(path)?.newest_run();
    }
    let (Some(run), Some(parent)) = (run_of(path), path.parent()) else { return Ok(vec![path.to_owned()]) };
    let parent = if parent.as_os_str().is_empty() { Path::new(".") } else { parent };
    let parts = Folder::open(parent)?.parts()?;
    Ok(parts.into_iter().map(|(path, _)| path).filter(|path| run_of(path).as_deref() == Some(&run)).collect())
}

fn first_bytes(path: &Path) -> io::Result<Vec<u8>> {
    use std::io::Read;
    let mut bytes = Vec::new();
    File::open(path)?.take(MAGIC.len() as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}

#[derive(Default)]
struct Runner<'p> {
    engine: Option<Box<Engine>>,
    report: Report,
    plain: Option<&'p mut dyn Write>,
    /// Whether there are calls of an engine whose start is missing.
    has_headless: bool,
}

impl Runner<'_> {
    /// Replays one file; false if the replay has stopped.
    fn part(&mut self, path: &Path, sequence: &mut Option<u32>) -> Result<bool, ReplayError> {
        let file = File::open(path).map_err(|error| ReplayError::Io(path.to_owned(), error))?;
        let end = calls::each(file, &mut |number, bytes| {
            let missing = match *sequence {
                Some(last) => number.wrapping_sub(last).wrapping_sub(1),
                None => 0,
            };
            if missing > 0 {
                let at = self.report.span.map(|(_, last)| last);
                self.report.stopped = Some(Stopped::Gap { at, missing });
                return Ok(Then::Stop);
            }
            *sequence = Some(number);
            self.write_plain(bytes)?;
            self.entries(bytes)?;
            Ok(if self.report.stopped.is_some() { Then::Stop } else { Then::GoOn })
        })?;
        self.report.is_cut |= end == RecordingEnd::Cut;
        Ok(end != RecordingEnd::Stopped)
    }

    fn finish(self, path: &Path) -> Result<Report, ReplayError> {
        match self {
            Self { report: Report { starts: 0, .. }, has_headless: true, .. } => {
                Err(ReplayError::NoStart(path.to_owned()))
            }
            Self { report: Report { starts: 0, .. }, .. } => Err(ReplayError::NotARecording(path.to_owned())),
            Self { report, .. } => Ok(report),
        }
    }

    fn write_plain(&mut self, bytes: &[u8]) -> Result<(), ReplayError> {
        self.plain.as_mut().map_or(Ok(()), |plain| plain.write_all(bytes)).map_err(ReplayError::Plain)
    }

    /// Replays entries: a whole recording, or one call of the engine.
    fn entries(&mut self, bytes: &[u8]) -> Result<(), ReplayError> {
        let mut rest = bytes;
        while !rest.is_empty() && self.report.stopped.is_none() {
            let Some((entry, after)) = Entry::parse(rest) else {
                self.report.is_cut = true;
                return Ok(());
            };
            rest = after;
            match entry {
                Entry::Start { image } => self.start(image)?,
                Entry::Input { at, input } => {
                    // A call of an engine whose start is missing.
                    let Some(engine) = &mut self.engine else {
                        self.has_headless = true;
                        continue;
                    };
                    let recorded = outputs(&mut rest);
                    let replayed = pass(engine, at, input);
                    self.report.inputs += 1;
                    self.report.outputs += count(recorded);
                    self.report.span = Some((self.report.span.map_or(at, |(first, _)| first), at));
                    // The recording may end within a call.
                    let is_cut = rest.is_empty() && replayed.starts_with(recorded) && recorded != replayed;
                    self.report.is_cut |= is_cut;
                    if recorded != replayed && !is_cut {
                        self.differs(at, format!("{input:?}"), shown(recorded), shown(&replayed));
                    }
                }
                Entry::Totals(recorded) => {
                    let Some(engine) = &self.engine else {
                        self.has_headless = true;
                        continue;
                    };
                    let at = self.report.span.map_or(Instant::from_micros(0), |(_, last)| last);
                    let replayed = totals(&**engine);
                    if replayed != *recorded {
                        let hex = |bytes: &[u8]| vec![format!("{bytes:02X?}")];
                        self.differs(
                            at,
                            "counters and image at the end".into(),
                            hex(recorded),
                            hex(&replayed),
                        );
                    }
                }
                Entry::MakeSafe => match &mut self.engine {
                    Some(engine) => engine.make_safe(),
                    None => self.has_headless = true,
                },
                // Outputs are consumed together with their call.
                Entry::Output(_) => {}
            }
        }
        Ok(())
    }

    fn start(&mut self, image: &[u8]) -> Result<(), ReplayError> {
        let mut config: Box<GatewayConfig> = Box::default();
        image::decode_into(image, &mut config).map_err(|error| ReplayError::Config(error.to_string()))?;
        let engine = Engine::new(&*config).map_err(|error| ReplayError::Config(error.to_string()))?;
        self.engine = Some(Box::new(engine));
        self.report.starts += 1;
        Ok(())
    }

    fn differs(&mut self, at: Instant, input: String, recorded: Vec<String>, replayed: Vec<String>) {
        let difference = Difference { at, input, recorded, replayed };
        self.report.stopped = Some(Stopped::Differs(Box::new(difference)));
    }
}

/// Removes the outputs at the front of `rest` and returns them.
fn outputs<'a>(rest: &mut &'a [u8]) -> &'a [u8] {
    let all = *rest;
    while let Some((Entry::Output(_), after)) = Entry::parse(rest) {
        *rest = after;
    }
    all.get(..all.len() - rest.len()).unwrap_or(all)
}

/// The outputs of an engine for an input.
fn pass(engine: &mut Engine, at: Instant, input: Input<'_>) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut buf = [0; OUTPUT_BUFFER];
    engine.handle(at, input);
    loop {
        let output = engine.poll_output(at, &mut buf);
        Entry::Output(output).encode(|piece| bytes.extend_from_slice(piece));
        if let Output::Sleep { .. } = output {
            return bytes;
        }
    }
}

fn count(mut outputs: &[u8]) -> u64 {
    let mut count = 0;
    while let Some((_, after)) = Entry::parse(outputs) {
        count += 1;
        outputs = after;
    }
    count
}

fn shown(mut outputs: &[u8]) -> Vec<String> {
    let mut shown = Vec::new();
    while let Some((Entry::Output(output), after)) = Entry::parse(outputs) {
        shown.push(format!("{output:02X?}"));
        outputs = after;
    }
    shown
}
