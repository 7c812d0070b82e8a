//! What happens on the board, for the engine.

use heapless::Vec;
use proto_core::engine::{Input, LinkId, PortId};
use proto_core::time::Instant;

use crate::controller::MAX_ANSWER;
use crate::machine::say;

pub(crate) const PORT: PortId = PortId(0);

/// Where inputs come from: each is an interrupt on a real board.
#[derive(Clone, Copy)]
pub(crate) enum InterruptSource {
    LineReceived,
    LineSent,
    Socket,
}

pub(crate) const SOURCES: [InterruptSource; 3] =
    [InterruptSource::LineReceived, InterruptSource::LineSent, InterruptSource::Socket];

/// Something that happened.
pub(crate) enum BoardEvent {
    LineReceived(&'static [u8]),
    LineSent,
    LinkUp(LinkId),
    LinkSent(LinkId),
    LinkAcked(LinkId),
    LinkReceived(LinkId, Vec<u8, MAX_ANSWER>),
}

impl BoardEvent {
    pub(crate) fn show(&self, now: Instant) {
        if let Self::LineReceived(bytes) = self {
            say!("{:>6} us  from the device {bytes:02X?}", now.as_micros());
        }
    }

    pub(crate) fn input(&self) -> Input<'_> {
        match self {
            Self::LineReceived(bytes) => Input::PortBytes { port: PORT, bytes },
            Self::LineSent => Input::PortSent { port: PORT },
            Self::LinkUp(link) => Input::LinkUp { link: *link },
            Self::LinkSent(link) => Input::LinkSent { link: *link },
            // All of it is acknowledged.
            Self::LinkAcked(link) => Input::LinkAcked { link: *link, left: 0 },
            Self::LinkReceived(link, bytes) => Input::LinkBytes { link: *link, bytes },
        }
    }
}
