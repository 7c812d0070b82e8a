//! How long things took since the start: what a user of the gateway waits for.

use crate::histogram::Histogram;

/// Durations as the engine sees them: from the call that told it of something to the call in which it
/// handed something over. What a driver needs before and after is not in them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Latency {
    /// From the oldest value that waited, as a field frame brought it, to the request or frame for the
    /// controller in which it was handed over.
    pub handed_over: Histogram,
    /// From the same instant to the Modbus answer, or to the acknowledgement by the controller's TCP. UDP
    /// has neither.
    pub arrived: Histogram,
    /// From the instant at which an output frame was due to the one in which it was handed over.
    pub lateness: Histogram,
    /// From a Modbus request to its answer.
    pub modbus: Histogram,
}

impl Latency {
    /// Without a sample. All its bytes are 0.
    pub(super) const fn new() -> Self {
        Self {
            handed_over: Histogram::new(),
            arrived: Histogram::new(),
            lateness: Histogram::new(),
            modbus: Histogram::new(),
        }
    }
}
