//! Captures and recordings of what goes over the gateway's ports and links.
//!
//! In: records of frames and of the engine's passes, which the gateway runtime gives to a [`Watch`]. Out: captures
//! for Wireshark ([`pcapng`]), recordings of a whole run ([`recording`]), and the run again in virtual time
//! ([`replay`]). Nothing here runs on the gateway's thread, and nothing delays it.

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
