//! A recorded frame.

use proto_core::engine::{TapDirection, TapPlace, TapVerdict};
use proto_core::wire::can::CanId;

/// A frame, bytes or a datagram at a port or link.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// The port or link.
    pub place: TapPlace,
    /// The direction.
    pub direction: TapDirection,
    /// Whether the frame was accepted.
    pub verdict: TapVerdict,
    /// The id on CAN.
    pub can_id: Option<CanId>,
    /// Length in bytes; more than in `bytes` if these were truncated.
    pub len: usize,
    /// The bytes.
    pub bytes: Box<[u8]>,
}

/// Why a frame was rejected, in words; `None` if it was accepted.
pub fn rejection(frame: &Frame) -> Option<&'static str> {
    match frame.verdict {
        TapVerdict::Rejected(why) => Some(why.text()),
        _ => None,
    }
}
