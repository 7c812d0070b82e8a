//! `--capture` and `--record` of `gateway`: what goes over its ports and links, as files.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use recipe_capture::pcapng::Scope;
use recipe_capture::recording::{MIN_FILE, RecordOptions, Recording};
use recipe_capture::{CaptureFile, Decoder, Target, Watch};
use recipe_export::Model;
use recipe_runtime::RunError;

/// Arguments of captures and recordings.
#[derive(Debug, Args)]
pub(super) struct WatchArgs {
    /// Capture the frames of all ports for Wireshark (pcapng) to this file or pipe, or to stdout with -, which moves
    /// the `ready` line to stderr
    #[arg(long, value_name = "FILE")]
    capture: Option<PathBuf>,
    /// Also capture the bytes on the links to the controller
    #[arg(long, requires = "capture")]
    capture_links: bool,
    /// Record the run to this folder (MCAP): decoded frames, and all that `host-sim replay` needs
    #[arg(long, value_name = "FOLDER")]
    record: Option<PathBuf>,
    /// Largest size of all recordings in the folder together; the oldest are removed
    #[arg(long, value_name = "SIZE", default_value = "1GiB", value_parser = parse_size, requires = "record")]
    record_budget: u64,
    /// Largest size of one recording file; at most half of the budget
    #[arg(long, value_name = "SIZE", default_value = "100MiB", value_parser = parse_size, requires = "record")]
    record_file: u64,
}

/// What is being written.
pub(super) struct Watching {
    watch: Watch,
    capture: Option<CaptureFile>,
    recording: Option<Recording>,
}

impl WatchArgs {
    /// The option that asks for something.
    pub(super) fn option(&self) -> Option<&'static str> {
        match (&self.capture, &self.record) {
            (Some(_), _) => Some("--capture"),
            (None, Some(_)) => Some("--record"),
            (None, None) => None,
        }
    }

    /// Whether stdout is for the capture.
    pub(super) fn takes_stdout(&self) -> bool {
        self.capture.as_deref() == Some(Path::new("-"))
    }

    /// What the frames of a file are called, if somebody asks.
    pub(super) fn decoder(&self, file: &Path, overrides: &[String]) -> Result<Arc<Decoder>, RunError> {
        if self.record.is_none() {
            return Ok(Arc::default());
        }
        let model = Model::load(file, overrides).map_err(|error| RunError::new(error.to_string()))?;
        Ok(Arc::new(Decoder::new(&model)))
    }

    /// Begins what was asked for.
    pub(super) fn start(&self, watch: &Watch) -> Result<Watching, RunError> {
        let mut watching = Watching { watch: watch.clone(), capture: None, recording: None };
        if let Some(folder) = &self.record {
            let (budget, file_size) = (self.record_budget, self.record_file);
            if file_size < MIN_FILE || budget < 2 * file_size {
                return Err(RunError::new(format!(
                    "--record-file {file_size} and --record-budget {budget}: a file has {MIN_FILE} bytes at least, \
                     and the budget is twice that of a file at least"
                )));
            }
            let options = RecordOptions { folder: folder.clone(), budget, file: file_size };
            let recording = Recording::start(watch, options);
            let refused = |error| RunError::new(format!("--record {}: {error}", folder.display()));
            watching.recording = Some(recording.map_err(refused)?);
        }
        if let Some(path) = &self.capture {
            let target = if self.takes_stdout() { Target::Stdout } else { Target::Path(path.clone()) };
            let scope = Scope { port: None, links: self.capture_links };
            let refused = |error| RunError::new(format!("--capture {}: {error}", path.display()));
            watching.capture = Some(CaptureFile::start(watch, scope, target).map_err(refused)?);
        }
        Ok(watching)
    }
}

impl Watching {
    /// Writes what is left.
    pub(super) fn finish(self) {
        self.watch.close();
        if let Some(capture) = self.capture {
            capture.finish();
        }
        if let Some(recording) = self.recording {
            recording.finish();
        }
    }
}

/// A size such as `1GiB`, `100MiB` or `4096`.
fn parse_size(text: &str) -> Result<u64, String> {
    let refused = || format!("{text:?} is not a size; write 100MiB, 1GiB or a number of bytes");
    let digits = text.len() - text.trim_start_matches(|c: char| c.is_ascii_digit()).len();
    let (number, unit) = text.split_at(digits);
    let number: u64 = number.parse().map_err(|_| refused())?;
    let unit = match unit {
        "" | "B" => 1,
        "KiB" => 1 << 10,
        "MiB" => 1 << 20,
        "GiB" => 1 << 30,
        "TiB" => 1 << 40,
        _ => return Err(refused()),
    };
    number.checked_mul(unit).ok_or_else(refused)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_binary_units() {
        assert_eq!(parse_size("4096"), Ok(4096));
        assert_eq!(parse_size("100MiB"), Ok(100 << 20));
        assert_eq!(parse_size("2TiB"), Ok(2 << 40));
        for wrong in ["", "MiB", "1GB", "1.5GiB", "-1", "99999999999999TiB"] {
            assert!(parse_size(wrong).is_err(), "{wrong:?}");
        }
    }
}
