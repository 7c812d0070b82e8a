//! The 1468-byte state packet of port 2001 (docs/wire/state.md).
//!
//! In: the bytes of one packet, or of a stream of them ([`StateStream`]). Out: a checked view
//! ([`StateView`]), a plain value ([`StatePacket`]), the output variables of the process image.
//! Refuses to know time, connections and what a misaligned stream is answered with.

mod alignment;
mod codes;
mod copy;
mod packet;
mod places;
mod stream;
mod view;

pub use alignment::Misaligned;
pub use codes::{OperationMode, ProgramState, RobotState, SafetyState, States};
pub use packet::{Content, FIELDS, FieldPlace, StatePacket};
pub use stream::{MAX_MISALIGNED, StateStream};
pub use view::{StateError, StateView};

/// Size of a state packet in bytes.
pub const LEN: usize = places::LEN;

#[cfg(test)]
mod tests;
