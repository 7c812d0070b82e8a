//! The latencies of a gateway since the start.

use crate::histogram::Histogram;
use crate::time::{Duration, Instant};

/// Since when something waits: the low half of the instant in microseconds, and 0 if nothing waits
/// or that is not measured. Waits are shorter than the 71 minutes after which it wraps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Since(u32);

impl Since {
    /// Nothing waits.
    pub(super) const NONE: Self = Self(0);

    pub(super) const fn at(at: Instant) -> Self {
        Self(at.as_micros() as u32)
    }

    /// Whether something waits.
    pub(super) fn is_some(self) -> bool {
        self != Self::NONE
    }

    #[must_use]
    pub(super) const fn earlier_by(self, span: Duration) -> Self {
        Self(self.0.wrapping_sub(span.as_micros() as u32))
    }

    /// Something else waits from now on; what waits already is older.
    pub(super) fn or_at(&mut self, now: Instant) {
        if !self.is_some() {
            *self = Self::at(now);
        }
    }

    /// The time until `now` in microseconds.
    pub(super) fn micros_until(self, now: Instant) -> u32 {
        Self::at(now).0.wrapping_sub(self.0)
    }

    /// The wait is over: records it, if there was one.
    pub(super) fn record(self, now: Instant, histogram: &mut Histogram) {
        if self.is_some() {
            histogram.record_micros(self.micros_until(now));
        }
    }
}

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
