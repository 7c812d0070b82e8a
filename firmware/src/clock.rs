//! The clock of the engine.

use proto_core::time::Instant;

/// Time since the start of the board.
pub(crate) fn now() -> Instant {
    Instant::from_micros(embassy_time::Instant::now().as_micros())
}
