//! Replays a recording's inputs on another engine, and records its outputs.

use core::fmt;

use super::{Entry, MAGIC, totals};
use crate::config::GatewayConfig;
use crate::config::image::{self, ImageError};
use crate::engine::{BuildError, Engine, Input, OUTPUT_BUFFER, Output};
use crate::time::Instant;

/// Why a recording cannot be replayed.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum ReplayError {
    /// It does not begin with [`MAGIC`].
    NotARecording,
    /// The bytes at `at` are not an entry: the recording is cut or changed.
    Entry {
        /// Offset of its first byte.
        at: usize,
    },
    /// An input comes before the first engine started.
    NoStart,
    /// The configuration image is refused.
    Image(ImageError),
    /// This engine cannot run the configuration.
    Build(BuildError),
}

impl fmt::Display for ReplayError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotARecording => f.write_str("not a recording"),
            Self::Entry { at } => write!(f, "the recording is damaged at byte {at}"),
            Self::NoStart => f.write_str("the recording does not begin with a configuration"),
            Self::Image(error) => error.fmt(f),
            Self::Build(error) => error.fmt(f),
        }
    }
}

impl core::error::Error for ReplayError {}

/// Number of inputs and outputs of a replay.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Replayed {
    /// Inputs passed to the engine.
    pub inputs: usize,
    /// Outputs that it returned.
    pub outputs: usize,
}

/// Passes the inputs of `recording` to `engine`, at their instants, and writes a new recording: the same inputs, with
/// this engine's outputs and totals. It equals `recording` if both engines behave the same.
///
/// `config` is working memory; boards do not have enough stack for it.
///
/// # Errors
/// [`ReplayError`]; what was written until then comes from this engine.
pub fn replay<
    const PORTS: usize,
    const UPLINKS: usize,
    const FIELDS: usize,
    const TAP: usize,
    const EXCHANGES: usize,
>(
    recording: &[u8],
    engine: &mut Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>,
    config: &mut GatewayConfig,
    mut write: impl FnMut(&[u8]),
) -> Result<Replayed, ReplayError> {
    let mut rest = recording.strip_prefix(&MAGIC).ok_or(ReplayError::NotARecording)?;
    write(&MAGIC);
    let mut replayed = Replayed::default();
    let mut has_started = false;
    while !rest.is_empty() {
        let damaged = ReplayError::Entry { at: recording.len().saturating_sub(rest.len()) };
        let (entry, after) = Entry::parse(rest).ok_or(damaged)?;
        rest = after;
        match entry {
            Entry::Start { image } => {
                entry.encode(&mut write);
                image::decode_into(image, config).map_err(ReplayError::Image)?;
                engine.configure(&*config).map_err(ReplayError::Build)?;
                has_started = true;
            }
            _ if !has_started => return Err(ReplayError::NoStart),
            Entry::Input { at, input } => {
                entry.encode(&mut write);
                replayed.inputs = replayed.inputs.saturating_add(1);
                let outputs = pass(engine, at, input, &mut write);
                replayed.outputs = replayed.outputs.saturating_add(outputs);
            }
            Entry::Output(_) => {}
            Entry::MakeSafe => {
                entry.encode(&mut write);
                engine.make_safe();
            }
            Entry::Totals(_) => Entry::Totals(&totals(engine)).encode(&mut write),
        }
    }
    Ok(replayed)
}

fn pass<
    const PORTS: usize,
    const UPLINKS: usize,
    const FIELDS: usize,
    const TAP: usize,
    const EXCHANGES: usize,
>(
    engine: &mut Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>,
    at: Instant,
    input: Input<'_>,
    mut write: impl FnMut(&[u8]),
) -> usize {
    let mut buf = [0; OUTPUT_BUFFER];
    let mut outputs = 0_usize;
    engine.handle(at, input);
    loop {
        let output = engine.poll_output(at, &mut buf);
        Entry::Output(output).encode(&mut write);
        outputs = outputs.saturating_add(1);
        if let Output::Sleep { .. } = output {
            return outputs;
        }
    }
}
