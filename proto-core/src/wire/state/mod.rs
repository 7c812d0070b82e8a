//! The 1468-byte state packet of port 2001 (docs/wire/state.md).
//!
//! In: the bytes of one packet, or of a stream of them ([`StateStream`]). Out: a checked view ([`StateView`]) and a
//! plain value ([`StatePacket`]). Does not know time, connections, what to do about a misaligned stream, or system
//! variables; [`crate::sysvar`] reads those from a packet.

mod alignment;
mod packet;
mod places;
mod stream;
mod view;

pub use super::codes::{OperationMode, ProgramState, RobotState, SafetyState, States};
pub use alignment::Misaligned;
pub use packet::{Content, FIELDS, FieldPlace, StatePacket};
pub use stream::{MAX_MISALIGNED, StateStream};
pub use view::{LEN, StateError, StateView};

#[cfg(test)]
mod tests;
