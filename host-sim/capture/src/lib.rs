//! Captures and recordings of the traffic on the gateway's ports and links.
//!
//! In: records of frames and of the engine's passes, which the gateway runtime delivers to a [`Watch`]. Out: captures
//! for Wireshark ([`pcapng`]), recordings of a whole run ([`recording`]), and replays of a run in virtual time
//! ([`replay`]). Nothing here runs on the gateway's thread or delays it.

#![forbid(unsafe_code)]

mod calls;
mod capture_file;
mod decode;
mod frame;
pub mod pcapng;
mod record;
pub mod recording;
pub mod replay;
#[cfg(test)]
mod test_run;
mod watch;

pub use capture_file::{CaptureFile, Target, replaceable};
pub use decode::{Decoder, Topic};
pub use frame::{Frame, rejection};
pub use record::{Cell, CellPort, Epoch, Record, What};
pub use watch::{Arrived, Interest, Next, Subscription, Watch};
