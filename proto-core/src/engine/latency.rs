//! The latencies of a gateway since the start.

use crate::histogram::Histogram;

/// Latencies as the engine sees them: from the call that reported something to the call that handed
/// something over. The driver's own times before and after are not included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Latency {
    /// From the field frame with the oldest waiting value to the request or frame to the controller
    /// in which the value was handed over.
    pub handed_over: Histogram,
    /// From the same instant to the Modbus answer, or to the acknowledgement by the controller's
    /// TCP. There is none on UDP.
    pub arrived: Histogram,
    /// From the instant at which an output frame was due to the one at which it was handed over.
    pub lateness: Histogram,
    /// From a Modbus request to its answer.
    pub modbus: Histogram,
}

impl Latency {
    /// Without samples. All its bytes are 0.
    pub(super) const fn new() -> Self {
        Self {
            handed_over: Histogram::new(),
            arrived: Histogram::new(),
            lateness: Histogram::new(),
            modbus: Histogram::new(),
        }
    }
}
