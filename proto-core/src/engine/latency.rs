//! The latencies of a gateway since the start.

use crate::histogram::Histogram;
use crate::time::{Duration, Instant};

/// Since when something has waited: the low half of the instant in microseconds; 0 if nothing waits or the wait is not
/// measured. Waits are shorter than the 71 minutes after which it wraps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Since(u32);

impl Since {
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

    /// Something waits from `now` on, unless something has waited for longer.
    pub(super) fn or_at(&mut self, now: Instant) {
        if !self.is_some() {
            *self = Self::at(now);
        }
    }

    pub(super) fn micros_until(self, now: Instant) -> u32 {
        Self::at(now).0.wrapping_sub(self.0)
    }

    /// Records the end of the wait, if there was one.
    pub(super) fn record(self, now: Instant, histogram: &mut Histogram) {
        if self.is_some() {
            histogram.record_micros(self.micros_until(now));
        }
    }
}

/// Latencies within the engine: from the call that reported something to the call that handed something over. The
/// driver's own times before and after are not included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Latency {
    /// From the field frame with the oldest waiting value to the request or frame to the controller in which the value
    /// was handed over.
    pub handed_over: Histogram,
    /// From the same field frame to the Modbus reply, or to the acknowledgement by the controller's TCP. Not measured
    /// on UDP.
    pub arrived: Histogram,
    /// From the instant at which an output frame was due to the instant at which it was handed over.
    pub lateness: Histogram,
    /// From a Modbus request to its reply.
    pub modbus: Histogram,
}

impl Latency {
    /// Without samples; all bytes are 0.
    pub(super) const fn new() -> Self {
        Self {
            handed_over: Histogram::new(),
            arrived: Histogram::new(),
            lateness: Histogram::new(),
            modbus: Histogram::new(),
        }
    }
}
