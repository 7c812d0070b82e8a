//! Exchanges of a device's own frames (docs/configuration.md section 4, "Exchanges"): the request, what
//! answers it, and which bytes are which.
//!
//! Written from that page, independent of the engine's exchanges.

use proto_core::config::{FrameSpec, GatewayConfig};
use proto_core::wire::can::CanId;

use crate::oracle::device::Look;
use crate::oracle::frame::{Frame, device_frame};
use crate::oracle::varying::look;

/// The frames of one exchange, apart from its request.
#[derive(Debug, Clone, Default)]
pub(in crate::oracle) struct FramesSpec {
    /// Without a request the reply comes unasked.
    pub is_asked: bool,
    /// The request is a remote frame with this id.
    pub remote: Option<CanId>,
    pub reply: Option<Frame>,
    pub refusal: Option<Frame>,
}

impl FramesSpec {
    /// What the bytes that came are, if they follow the request.
    pub(in crate::oracle) fn see(&self, bytes: &[u8]) -> Seen {
        let reply = self.reply.as_ref().map_or(Look::No, |reply| look(reply, bytes));
        let refusal = self.refusal.as_ref().map_or(Look::No, |refusal| look(refusal, bytes));
        Seen::of(reply, Seen::Reply).or(Seen::of(refusal, Seen::Refusal))
    }
}

/// What bytes are while a reply is pending.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::oracle) enum Seen {
    /// Not the beginning of what is expected.
    No,
    /// Perhaps its beginning; whether all constants so far are its own.
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
    /// A refusal of one of several requests.
    Ambiguous(usize),
    /// A frame that comes unasked: its length, and which input frame of the port it is.
    Unasked(usize, usize),
    /// A frame of another device.
    Other(usize),
    /// It would be the reply, but its checksum is wrong.
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

    /// The same of an exchange that is not pending.
    pub(in crate::oracle) fn late(self, row: usize) -> Self {
        match self {
            Self::Reply(len) | Self::Refusal(len) => Self::Late(len, row),
            other => other,
        }
    }

    /// What bytes are that may be one of two frames: a frame is more than the beginning of one of ours, that
    /// is more than one of others, and that is more than the beginning of one of others or a wrong
    /// checksum. Of equals, the first.
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
    // A remote frame has none.
    Some((spec, device_frame(&spec.head, &spec.tail, spec.id, fields)))
}
