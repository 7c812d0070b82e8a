//! Exchanges as the configuration has them: what is asked, what is expected as the reply, and when.
//!
//! Plain data: nothing here has been checked. A recipe has a range of the configuration's exchanges
//! beside its parts; their frames are ranges of the same list of fields.

use super::walk::Frames;
use super::{ConfigView, Delimiter, Recipe, Span};
use crate::modbus::rtu::Operation;
use crate::sysvar::{Direction, SysVar};
use crate::time::Duration;
use crate::wire::can::CanId;

/// A request that the gateway sends and the reply that it expects; or one that it answers.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Exchange {
    /// The slave's address on Modbus (0: all of them), or a number of the device. The exchanges of one
    /// peer share what is known of it: one that does not answer is asked less often.
    pub peer: u8,
    /// The frames.
    pub talk: Talk,
    /// When it is asked.
    pub when: AskWhen,
    /// How long the reply may take, from the end of the request to the end of the reply.
    pub timeout: Duration,
    /// How often a request without a good reply is repeated at once.
    pub retries: u8,
    /// How long the line rests after it.
    pub pause: Duration,
}

/// The frames of an exchange.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Talk {
    /// The gateway is master of a Modbus RTU line. The operation's counts are those of the fields.
    Rtu {
        /// What is asked.
        operation: Operation,
        /// The fields that are written; empty for a read.
        written: Span,
        /// The fields that the reply carries; empty for a write.
        read: Span,
    },
    /// The gateway is the slave, and these are registers or coils that a master may read or write.
    Served {
        /// What a master may ask: all of it, or a part.
        operation: Operation,
        /// The fields that a master writes; empty where it reads.
        written: Span,
        /// The fields that a master reads.
        read: Span,
    },
    /// Frames of the device's own, as indices into
    /// [`GatewayConfig::frames`](super::GatewayConfig::frames).
    Frames {
        /// What is sent; without one the reply may come at any time.
        request: Option<u8>,
        /// What answers it; without one, sending it is all.
        reply: Option<u8>,
        /// What the device sends if it refuses the request.
        refusal: Option<u8>,
    },
}

/// One frame of an exchange.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct FrameSpec {
    /// Its id on a CAN bus; `None` on a line.
    pub id: Option<CanId>,
    /// It is a remote request on a CAN bus, which has no data.
    pub remote: bool,
    /// Bytes before the fields.
    pub head: Delimiter,
    /// Bytes after the fields.
    pub tail: Delimiter,
    /// The fields.
    pub fields: Span,
}

/// When an exchange is asked; several may be set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct AskWhen {
    /// With this period.
    pub every: Option<Duration>,
    /// Once at the start, and each time that the peer has come back.
    pub start: bool,
    /// When a value of the request has changed; looked at each cycle of the port.
    pub change: bool,
    /// When this bit goes from 0 to 1; looked at each cycle of the port.
    pub rising: Option<(SysVar, u8)>,
}

impl AskWhen {
    /// Never by itself: as for a frame that comes unasked.
    pub const NEVER: Self = Self { every: None, start: false, change: false, rising: None };

    /// With this period.
    pub const fn every(period: Duration) -> Self {
        Self { every: Some(period), ..Self::NEVER }
    }

    /// Whether it is ever asked.
    pub fn is_never(&self) -> bool {
        *self == Self::NEVER
    }
}

/// How long a reply may take by default.
pub const DEFAULT_REPLY_TIMEOUT: Duration = Duration::from_millis(100);

impl Exchange {
    /// An exchange with the defaults of a file: a timeout of 100 ms, one repetition, no pause.
    pub const fn new(peer: u8, talk: Talk, when: AskWhen) -> Self {
        Self { peer, talk, when, timeout: DEFAULT_REPLY_TIMEOUT, retries: 1, pause: Duration::ZERO }
    }

    /// Whether a master asks, and the gateway answers.
    pub(crate) const fn is_served(&self) -> bool {
        matches!(self.talk, Talk::Served { .. })
    }

    /// Its frames of a device's own that come from the device (input), a reply before a refusal, or go
    /// to it (output).
    pub(crate) fn frames(&self, part: Direction) -> impl Iterator<Item = u8> + use<> {
        let frames = match (self.talk, part) {
            (Talk::Frames { reply, refusal, .. }, Direction::Input) => [reply, refusal],
            (Talk::Frames { request, .. }, Direction::Output) => [request, None],
            _ => [None, None],
        };
        frames.into_iter().flatten()
    }

    /// The fields that come from the device (input) or go to it (output); `None` if it has no such
    /// frame. A refusal only tells that the device refuses.
    pub(crate) fn fields(&self, frames: &[FrameSpec], part: Direction) -> Option<Span> {
        let span = match (self.talk, part) {
            (Talk::Rtu { read, .. }, Direction::Input) => read,
            (Talk::Rtu { written, .. }, Direction::Output) => written,
            (Talk::Served { written, .. }, Direction::Input) => written,
            (Talk::Served { read, .. }, Direction::Output) => read,
            (Talk::Frames { reply: nth, .. }, Direction::Input)
            | (Talk::Frames { request: nth, .. }, Direction::Output) => {
                return Some(frames.get(usize::from(nth?))?.fields);
            }
        };
        (span.len > 0).then_some(span)
    }
}

impl<'c> ConfigView<'c> {
    /// The exchanges of a recipe.
    pub fn exchanges_of(self, recipe: &Recipe) -> &'c [Exchange] {
        recipe.exchanges.of(self.exchanges)
    }

    /// The ranges of the fields of one part of `recipe`, with the frame's number: 0 in a stream, else
    /// that of the CAN frame, and behind these the frames of the exchanges, counted on.
    pub(crate) fn frames_of(self, recipe: &'c Recipe, part: Direction) -> Frames<'c> {
        let exchanges = self.exchanges_of(recipe).iter();
        Frames { parts: recipe.part_frames(part), exchanges, frames: self.frames, part, count: 0 }
    }

    /// Whether frames come from the device (input), or go to it (output).
    pub(crate) fn has_frames(self, recipe: &'c Recipe, part: Direction) -> bool {
        self.frames_of(recipe, part).next().is_some()
    }
}
