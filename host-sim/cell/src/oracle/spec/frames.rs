//! Exchanges with a device's own frames (docs/configuration.md section 4, "Exchanges"): the request, its replies, and
//! how received bytes are interpreted.
//!
//! Written from that page, independent of the engine's exchanges.

use proto_core::config::{FrameSpec, GatewayConfig};
use proto_core::wire::can::CanId;

use crate::oracle::device::Look;
use crate::oracle::frame::{Frame, device_frame};
use crate::oracle::varying::look;

/// The frames of an exchange, without its request.
#[derive(Debug, Clone, Default)]
pub(in crate::oracle) struct FramesSpec {
    /// The exchange has a request; without one, the reply is unsolicited.
    pub is_asked: bool,
    /// The request is a remote frame with this id.
    pub remote: Option<CanId>,
    pub reply: Option<Frame>,
    pub refusal: Option<Frame>,
}

impl FramesSpec {
    /// Interprets the bytes received after the request.
    pub(in crate::oracle) fn see(&self, bytes: &[u8]) -> Seen {
        let reply = self.reply.as_ref().map_or(Look::No, |reply| look(reply, bytes));
        let refusal = self.refusal.as_ref().map_or(Look::No, |refusal| look(refusal, bytes));
        Seen::of(reply, Seen::Reply).or(Seen::of(refusal, Seen::Refusal))
    }
}

/// The meaning of bytes while a reply is pending.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::oracle) enum Seen {
    /// Not the beginning of an expected frame.
    No,
    /// Possibly the beginning of an expected frame; and whether all constants so far match.
    Begins {
        is_ours: bool,
    },
    /// The request itself.
    Echo(usize),
    Reply(usize),
    Refusal(usize),
    /// The reply, or the request itself.
    ReplyOrEcho(usize),
    /// A reply to an earlier request of another exchange: its length, and which exchange.
    Late(usize, usize),
    /// A refusal that may belong to one of several requests.
    Ambiguous(usize),
    /// An unsolicited frame: its length, and its index among the input frames of the port.
    Unasked(usize, usize),
    /// A frame of another device.
    Other(usize),
    /// It would be the reply, but its checksum is invalid.
    Wrong(usize),
}

impl Seen {
    pub(in crate::oracle) fn of(look: Look, whole: impl FnOnce(usize) -> Self) -> Self {
        match look {
            Look::No => Self::No,
            Look::Begins { is_ours } => Self::Begins { is_ours },
            Look::Frame(len) => whole(len),
            Look::Other(len) => Self::Other(len),
            Look::Wrong(len) => Self::Wrong(len),
        }
    }

    /// The meaning for an exchange that is not pending.
    pub(in crate::oracle) fn late(self, row: usize) -> Self {
        match self {
            Self::Reply(len) | Self::Refusal(len) => Self::Late(len, row),
            other => other,
        }
    }

    /// Combines the meanings of bytes that may be one of two frames. A complete frame ranks above the beginning of a
    /// frame of ours, that above a complete frame of another device, and that above the beginning of such a frame or an
    /// invalid checksum. Of equal ranks, the first one counts.
    pub(in crate::oracle) fn or(self, other: Self) -> Self {
        let rank = |seen: &Self| match seen {
            Self::No => 0,
            Self::Wrong(_) => 1,
            Self::Begins { is_ours: false } => 2,
            Self::Other(_) => 3,
            Self::Begins { is_ours: true } => 4,
            Self::Echo(_)
            | Self::Reply(_)
            | Self::Refusal(_)
            | Self::ReplyOrEcho(_)
            | Self::Late(..)
            | Self::Ambiguous(_)
            | Self::Unasked(..) => 5,
        };
        if rank(&other) > rank(&self) { other } else { self }
    }
}

/// A frame of an exchange.
pub(in crate::oracle) fn frame_of(config: &GatewayConfig, nth: u8) -> Option<(&FrameSpec, Frame)> {
    let spec = config.frames.get(usize::from(nth))?;
    let fields = spec.fields.of(&config.fields);
    // A remote frame has no fields.
    Some((spec, device_frame(&spec.head, &spec.tail, spec.id, fields)))
}
