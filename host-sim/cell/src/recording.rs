//! A recording of all inputs and outputs of the cell's engine, in the format of `proto_core::record`, to be replayed on
//! another machine (docs/cortex-m7.md section 1).

use proto_core::config::GatewayConfig;
use proto_core::engine::{Engine, Input, Output};
use proto_core::record::{Entry, MAGIC, totals};
use proto_core::time::Instant;
use recipe_config::board::encoded;

/// A recording in progress.
#[derive(Debug)]
pub(super) struct Recorder {
    image: Vec<u8>,
    bytes: Vec<u8>,
}

impl Recorder {
    /// A recording of an engine with this configuration.
    pub(super) fn new(config: &GatewayConfig) -> Self {
        let image = encoded(config).expect("there is room for every configuration");
        let mut recorder = Self { image, bytes: MAGIC.to_vec() };
        recorder.start();
        recorder
    }

    /// The engine starts or restarts.
    pub(super) fn start(&mut self) {
        Entry::Start { image: &self.image }.encode(|piece| self.bytes.extend_from_slice(piece));
    }

    pub(super) fn input(&mut self, at: Instant, input: Input<'_>) {
        self.add(&Entry::Input { at, input });
    }

    pub(super) fn output(&mut self, output: Output<'_>) {
        self.add(&Entry::Output(output));
    }

    /// Adds the engine's counters.
    pub(super) fn totals(&mut self, engine: &Engine) {
        self.add(&Entry::Totals(&totals(engine)));
    }

    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    fn add(&mut self, entry: &Entry<'_>) {
        entry.encode(|piece| self.bytes.extend_from_slice(piece));
    }
}

/// The first difference between two recordings as text: the entry, the input before it, and both contents. `None` if
/// the recordings are equal.
pub fn recording_difference(expected: &[u8], found: &[u8]) -> Option<String> {
    if expected == found {
        return None;
    }
    let (Some(mut left), Some(mut right)) = (expected.strip_prefix(&MAGIC), found.strip_prefix(&MAGIC))
    else {
        return Some("one of them is not a recording".to_owned());
    };
    let mut cause = "no input yet".to_owned();
    for nth in 0.. {
        let (one, other) = (Entry::parse(left), Entry::parse(right));
        let same = match (&one, &other) {
            (Some((_, rest)), Some((_, other_rest))) => {
                left[..left.len() - rest.len()] == right[..right.len() - other_rest.len()]
            }
            _ => false,
        };
        match (one, other) {
            (Some((entry, rest)), Some((_, other_rest))) if same => {
                if matches!(entry, Entry::Input { .. }) {
                    cause = format!("{entry:02X?}");
                }
                (left, right) = (rest, other_rest);
            }
            (one, other) => {
                let at = expected.len() - left.len();
                let [one, other] = [one, other].map(|entry| match entry {
                    Some((entry, _)) => format!("{entry:02X?}"),
                    None => "no entry".to_owned(),
                });
                return Some(format!(
                    "entry {nth} at byte {at} differs\n  after     {cause}\n  expected  {one}\n  found     {other}"
                ));
            }
        }
    }
    None
}
