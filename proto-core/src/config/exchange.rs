//! Exchanges as the configuration has them: what is asked, what is expected as the reply, and when.
//!
//! Plain data: nothing here has been checked. A recipe has a range of the configuration's exchanges
//! beside its parts; their frames are ranges of the same list of fields.

use super::{Delimiter, FieldSpec, Span};
use crate::device::{Element, Encoding};
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
    pub transaction: Transaction,
    /// When it is asked.
    pub when: Triggers,
    /// How long the reply may take, from the end of the request to the end of the reply.
    pub timeout: Duration,
    /// How often a request without a good reply is repeated at once: a period, or a value that is written until the
    /// device has it.
    pub retries: u8,
    /// The same for an event: a rise, a step that follows one, or what is only asked at the start. A device may carry
    /// out twice what is repeated.
    pub event_retries: u8,
    /// How long the line rests after it.
    pub pause: Duration,
    /// How long after an event its request may still be sent; `None` is the timeout of the port, at most
    /// [`MAX_TRIGGER`].
    pub trigger: Option<Duration>,
    /// How long after its request a reply may come, which is late after [`Self::timeout`]. Until then nothing is asked
    /// of the peer whose reply could be taken for it. `None` is three times the timeout, at least
    /// [`DEFAULT_LATE`].
    pub late: Option<Duration>,
    /// It stops its peer: it goes first, cancels the peer's events, and is repeated until it is confirmed.
    pub stop: bool,
    /// The exchange of the recipe, counted from 0, after whose good answer this one is sent.
    pub follow: Option<u8>,
    /// When the values of the reply are overdue; `None` is the timeout of the port, [`Port::NEVER`](super::Port::NEVER)
    /// is never, for a reply that comes only when something happens.
    pub overdue: Option<Duration>,
    /// The variables that tell the robot what became of its events.
    pub outcome: OutcomeTo,
    /// The frame of a device's own that says that it is at it and that its answer follows, as an index into
    /// [`GatewayConfig::frames`](super::GatewayConfig::frames).
    pub pending: Option<u8>,
    /// What in its reply tells that the peer has restarted.
    pub restarted: Option<Restarted>,
}

/// A number of a reply that tells that the peer has restarted, when the reply before had another one there.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Restarted {
    /// The field of the reply that has it, counted from 0: values and constants, without padding and texts.
    pub field: u8,
    /// The number, before scale and offset.
    pub value: f64,
}

impl Restarted {
    /// The field in a reply with these fields: its place among those with an element, and its encoding; `None` if it is
    /// none with a number that may vary.
    pub(crate) fn place(&self, fields: &[FieldSpec]) -> Option<(u8, Encoding)> {
        let numbers =
            (0_u8..).zip(fields.iter().filter_map(FieldSpec::element)).filter_map(|(nth, element)| {
                match element {
                    Element::Value { encoding, .. } => Some((nth, Some(encoding))),
                    Element::Fixed { .. } => Some((nth, None)),
                    _ => None,
                }
            });
        let (nth, encoding) = numbers.into_iter().nth(usize::from(self.field))?;
        Some((nth, encoding?))
    }
}

/// The variables that tell the robot what became of an exchange's events.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OutcomeTo {
    /// The outcome: [`Outcome`](crate::engine::Outcome) as a number.
    pub to: Option<SysVar>,
    /// The code with which the device refused the newest event, or 0.
    pub code_to: Option<SysVar>,
    /// The number of events that have ended, wrapping.
    pub count_to: Option<SysVar>,
}

impl OutcomeTo {
    /// Nothing is told.
    pub const NONE: Self = Self { to: None, code_to: None, count_to: None };

    /// The variables that are written.
    pub fn variables(&self) -> impl Iterator<Item = SysVar> + use<> {
        [self.to, self.code_to, self.count_to].into_iter().flatten()
    }
}

/// The frames of an exchange.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Transaction {
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
pub struct Triggers {
    /// With this period.
    pub every: Option<Duration>,
    /// Once at the start of the gateway, and again when the peer has started.
    pub start: bool,
    /// When a value of the request has changed; looked at each cycle of the port.
    pub change: bool,
    /// When this bit goes from 0 to 1; looked at each time that it is read. The rise is an event: it is sent once and in
    /// time, or not at all.
    pub rising: Option<(SysVar, u8)>,
}

impl Triggers {
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
/// How long a reply may be late by default, if three timeouts are shorter.
pub const DEFAULT_LATE: Duration = Duration::from_secs(1);
/// The longest time in which an event may be sent.
pub const MAX_TRIGGER: Duration = Duration::from_secs(1);

impl Exchange {
    /// An exchange with the defaults of a file: a timeout of 100 ms, one repetition but none of an event, no pause.
    pub const fn new(peer: u8, transaction: Transaction, when: Triggers) -> Self {
        Self {
            peer,
            transaction,
            when,
            timeout: DEFAULT_REPLY_TIMEOUT,
            retries: 1,
            event_retries: 0,
            pause: Duration::ZERO,
            trigger: None,
            late: None,
            stop: false,
            follow: None,
            overdue: None,
            outcome: OutcomeTo::NONE,
            pending: None,
            restarted: None,
        }
    }

    /// The same exchange with the repetitions that a file has for it: without any, one of a state and none of an event.
    pub fn repeated(self, retries: Option<u8>) -> Self {
        let of_event = if self.is_event() || self.is_start_event() { retries } else { None };
        Self { retries: retries.unwrap_or(1), event_retries: of_event.unwrap_or(0), ..self }
    }

    /// How long after its request a reply may come.
    pub fn late(&self) -> Duration {
        self.late.unwrap_or(self.timeout.saturating_mul(3).max(DEFAULT_LATE))
    }

    /// How long after an event its request may be sent, on a port with this timeout.
    pub fn trigger(&self, port_timeout: Duration) -> Duration {
        self.trigger.unwrap_or(port_timeout.min(MAX_TRIGGER))
    }

    /// Whether its start is an event: it is asked at the start and for no other reason, and may do something there. What
    /// is only read is read again until it is answered.
    pub const fn is_start_event(&self) -> bool {
        let Triggers { every, start, change, rising } = self.when;
        let reads =
            matches!(self.transaction, Transaction::Rtu { operation, .. } if operation.written_len() == 0);
        start && every.is_none() && !change && rising.is_none() && !reads
    }

    /// Whether an event asks it: a rise that does not stop the peer, or the answer to another one.
    pub const fn is_event(&self) -> bool {
        (self.when.rising.is_some() || self.follow.is_some()) && !self.stop
    }

    /// Whether nothing ever asks it: its frame comes unasked, or a master asks.
    pub fn is_never(&self) -> bool {
        self.when.is_never() && self.follow.is_none()
    }

    /// Whether it is asked and has a reply.
    pub const fn is_answered(&self) -> bool {
        match self.transaction {
            Transaction::Rtu { .. } => self.peer != crate::modbus::rtu::BROADCAST,
            Transaction::Served { .. } => false,
            Transaction::Frames { request, reply, .. } => request.is_some() && reply.is_some(),
        }
    }

    /// Whether a master asks, and the gateway answers.
    pub(crate) const fn is_served(&self) -> bool {
        matches!(self.transaction, Transaction::Served { .. })
    }

    /// Its frames of a device's own that come from the device (input): a reply, a pending answer, a refusal; or that go
    /// to it (output).
    pub(crate) fn frames(&self, part: Direction) -> impl Iterator<Item = u8> + use<'_> {
        (0..3).filter_map(move |nth| self.frame(part, nth))
    }

    fn frame(&self, part: Direction, nth: u8) -> Option<u8> {
        let Transaction::Frames { request, reply, refusal } = self.transaction else { return None };
        match (part, nth) {
            (Direction::Input, 0) => reply,
            (Direction::Input, 1) => self.pending,
            (Direction::Input, 2) => refusal,
            (Direction::Output, 0) => request,
            _ => None,
        }
    }

    /// The fields that come from the device (input) with a reply, or go to it (output); `None` if it has no such frame.
    pub(crate) fn fields(&self, frames: &[FrameSpec], part: Direction) -> Option<Span> {
        let span = match (self.transaction, part) {
            (Transaction::Rtu { read, .. }, Direction::Input) => read,
            (Transaction::Rtu { written, .. }, Direction::Output) => written,
            (Transaction::Served { written, .. }, Direction::Input) => written,
            (Transaction::Served { read, .. }, Direction::Output) => read,
            (Transaction::Frames { reply: nth, .. }, Direction::Input)
            | (Transaction::Frames { request: nth, .. }, Direction::Output) => {
                return Some(frames.get(usize::from(nth?))?.fields);
            }
        };
        (span.len > 0).then_some(span)
    }

    /// The fields of its pending answer and of its refusal, where they have values: these are input frames like a reply.
    /// The others only tell what they are.
    pub(crate) fn other_answers(&self, frames: &[FrameSpec], pool: &[FieldSpec]) -> [Option<Span>; 2] {
        let span = |nth| {
            let span = frames.get(usize::from(self.frame(Direction::Input, nth)?))?.fields;
            has_values(span.of(pool)).then_some(span)
        };
        [span(1), span(2)]
    }
}

/// Whether a frame from a device has values.
pub(crate) fn has_values(fields: &[FieldSpec]) -> bool {
    fields.iter().any(FieldSpec::has_value)
}
