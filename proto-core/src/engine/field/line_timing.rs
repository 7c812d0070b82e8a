//! When a half-duplex line is free, and when silence ends a frame.
//!
//! In: a port's settings, and when bytes arrived. Out: instants. Does not know what the bytes are.

use crate::config::Rs485;
use crate::time::{Duration, Instant};

#[derive(Debug, Clone, Copy)]
pub(crate) struct LineTiming {
    pub idle_gap: Duration,
    pub turnaround: Duration,
    /// After this long without a byte, a reply is complete.
    silence: Duration,
    /// When the newest bytes arrived.
    pub heard: Instant,
}

impl LineTiming {
    pub(crate) fn new(settings: &Rs485) -> Self {
        let characters = settings.characters_and_a_half(3);
        let (idle_gap, turnaround) = (settings.idle_gap.max(characters), settings.turnaround);
        Self { idle_gap, turnaround, silence: turnaround.max(characters), heard: Instant::ZERO }
    }

    /// For a bus that arbitrates by itself.
    pub(crate) const fn none() -> Self {
        let (idle_gap, turnaround) = (Duration::MAX, Duration::ZERO);
        Self { idle_gap, turnaround, silence: Duration::ZERO, heard: Instant::ZERO }
    }

    /// When the line is free for the gateway.
    pub(crate) fn quiet_at(&self) -> Instant {
        self.heard + self.turnaround
    }

    /// When silence ends the partial frame, if there is one.
    pub(crate) fn partial_until(&self, has_begun: bool) -> Instant {
        if has_begun { self.heard + self.idle_gap } else { Instant::NEVER }
    }

    /// When the line has been silent for so long that a reply is complete.
    pub(crate) fn silent_at(&self) -> Instant {
        self.heard + self.silence
    }
}
