//! Timelines of both sides, and the texts.

mod client;
mod server;
mod texts;

use crate::time::Instant;

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}
