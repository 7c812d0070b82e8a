//! Exchanges in the configuration: requests, expected replies, and triggers.
//!
//! Plain data: nothing here is checked. Besides its parts, a recipe has a range of the configuration's exchanges; the
//! fields of their frames are in the common list of fields.

use super::{Delimiter, FieldSpec, Span};
use crate::device::{Element, Encoding};
use crate::modbus::rtu::Operation;
use crate::sysvar::{Direction, SysVar};
use crate::time::Duration;
use crate::wire::can::CanId;

/// A request that the gateway sends, with the expected reply; or one that it answers.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Exchange {
    /// The slave's address on Modbus (0: broadcast), or a number of the device. Exchanges of the same peer share its
    /// availability: a peer that does not answer is asked less often.
    pub peer: u8,
    /// The frames.
    pub transaction: Transaction,
    /// When the request is sent.
    pub when: Triggers,
    /// Maximum time from the end of the request to the end of the reply.
    pub timeout: Duration,
    /// Maximum number of immediate repetitions of a periodic request, or of a value that is written until the device
    /// has it, if there is no good reply.
    pub retries: u8,
    /// Maximum number of repetitions of an event: a rising bit, an exchange that follows another, or one sent only at
    /// the start. The device may execute it twice.
    pub event_retries: u8,
    /// Pause on the line after the exchange.
    pub pause: Duration,
    /// How long after an event its request may still be sent. `None` is the timeout of the port, at most
    /// [`MAX_TRIGGER`].
    pub trigger: Option<Duration>,
    /// How long after its request a late reply (after [`Self::timeout`]) may still arrive. Until then, requests to the
    /// peer wait if their replies could be confused with it. `None` is three times the timeout, at least
    /// [`DEFAULT_LATE`].
    pub late: Option<Duration>,
    /// The exchange stops its peer: it is sent first, cancels the peer's events, and is repeated until confirmed.
    pub stop: bool,
    /// The exchange of the recipe, counted from 0, after whose good reply this one is sent.
    pub follow: Option<u8>,
    /// When the values of the reply are overdue. `None` is the timeout of the port; [`Port::NEVER`](super::Port::NEVER)
    /// is never, for a reply that is sent only on events.
    pub overdue: Option<Duration>,
    /// The variables that report the outcome of the exchange's events to the robot.
    pub outcome: OutcomeTo,
    /// A device's frame saying that the request is in progress and the answer follows, as an index into
    /// [`GatewayConfig::frames`](super::GatewayConfig::frames).
    pub pending: Option<u8>,
    /// The sign of a restart of the peer in the reply.
    pub restarted: Option<Restarted>,
}

/// A number in a reply that shows a restart of the peer, if the previous reply had another number there.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Restarted {
    /// The reply's field with the number, counted from 0: values and constants count, padding and texts do not.
    pub field: u8,
    /// The number, before scale and offset.
    pub value: f64,
}

impl Restarted {
    /// The index of the field among those with an element, and its encoding. `None` if it does not have a variable
    /// number.
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

/// The variables that report the outcome of an exchange's events to the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OutcomeTo {
    /// The outcome: [`Outcome`](crate::engine::Outcome) as a number.
    pub to: Option<SysVar>,
    /// The code with which the device refused the newest event, or 0.
    pub code_to: Option<SysVar>,
    /// Number of events that have ended, wrapping.
    pub count_to: Option<SysVar>,
}

impl OutcomeTo {
    /// No variable.
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
    /// The gateway is a Modbus master. The operation's counts match the fields.
    Rtu {
        /// The request.
        operation: Operation,
        /// The fields that are written; empty for a read.
        written: Span,
        /// The fields that the reply carries; empty for a write.
        read: Span,
    },
    /// The gateway is a Modbus slave, and a master may read or write these registers or coils.
    Served {
        /// The operation of a master on the whole block; it may also access a part.
        operation: Operation,
        /// The fields that a master writes; empty if it reads.
        written: Span,
        /// The fields that a master reads.
        read: Span,
    },
    /// Frames of the device's own, as indices into [`GatewayConfig::frames`](super::GatewayConfig::frames).
    Frames {
        /// The request; without one the reply may arrive at any time.
        request: Option<u8>,
        /// The reply; without one the exchange ends with sending.
        reply: Option<u8>,
        /// The device's frame that refuses the request.
        refusal: Option<u8>,
    },
}

/// One frame of an exchange.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct FrameSpec {
    /// Its id on a CAN bus; `None` on a line.
    pub id: Option<CanId>,
    /// A remote request on a CAN bus, which has no data.
    pub remote: bool,
    /// Bytes before the fields.
    pub head: Delimiter,
    /// Bytes after the fields.
    pub tail: Delimiter,
    /// The fields.
    pub fields: Span,
}

/// Triggers of an exchange; several may be set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Triggers {
    /// Periodically.
    pub every: Option<Duration>,
    /// Once at the start of the gateway, and again when the peer has started.
    pub start: bool,
    /// When a value of the request changes; checked in each cycle of the port.
    pub change: bool,
    /// When this bit changes from 0 to 1; checked each time it is read. This is an event: it is sent once and in time,
    /// or not at all.
    pub rising: Option<(SysVar, u8)>,
}

impl Triggers {
    /// No trigger, as for an unsolicited frame.
    pub const NEVER: Self = Self { every: None, start: false, change: false, rising: None };

    /// Periodically.
    pub const fn every(period: Duration) -> Self {
        Self { every: Some(period), ..Self::NEVER }
    }

    /// Whether there is no trigger.
    pub fn is_never(&self) -> bool {
        *self == Self::NEVER
    }
}

/// Default timeout of a reply.
pub const DEFAULT_REPLY_TIMEOUT: Duration = Duration::from_millis(100);
/// Minimum of the default time for late replies, which is three timeouts.
pub const DEFAULT_LATE: Duration = Duration::from_secs(1);
/// Maximum of the default time in which an event may be sent.
pub const MAX_TRIGGER: Duration = Duration::from_secs(1);

impl Exchange {
    /// An exchange with the defaults of files: a timeout of 100 ms, one repetition, none of an event, no pause.
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

    /// Sets the repetitions as in a file; by default one for states and none for events.
    pub fn repeated(self, retries: Option<u8>) -> Self {
        let of_event = if self.is_event() || self.is_start_event() { retries } else { None };
        Self { retries: retries.unwrap_or(1), event_retries: of_event.unwrap_or(0), ..self }
    }

    /// How long after its request a late reply may arrive.
    pub fn late(&self) -> Duration {
        self.late.unwrap_or(self.timeout.saturating_mul(3).max(DEFAULT_LATE))
    }

    /// How long after an event its request may be sent, on a port with this timeout.
    pub fn trigger(&self, port_timeout: Duration) -> Duration {
        self.trigger.unwrap_or(port_timeout.min(MAX_TRIGGER))
    }

    /// Whether its start is an event: it is sent only at the start and may have an effect there. A read is repeated
    /// until it is answered.
    pub const fn is_start_event(&self) -> bool {
        let Triggers { every, start, change, rising } = self.when;
        let reads =
            matches!(self.transaction, Transaction::Rtu { operation, .. } if operation.written_len() == 0);
        start && every.is_none() && !change && rising.is_none() && !reads
    }

    /// Whether an event triggers it: a rising bit, unless it stops the peer, or the reply to another exchange.
    pub const fn is_event(&self) -> bool {
        (self.when.rising.is_some() || self.follow.is_some()) && !self.stop
    }

    /// Whether nothing triggers it: its frame is unsolicited, or a master asks.
    pub fn is_never(&self) -> bool {
        self.when.is_never() && self.follow.is_none()
    }

    /// Whether it has a request and a reply.
    pub const fn is_answered(&self) -> bool {
        match self.transaction {
            Transaction::Rtu { .. } => self.peer != crate::modbus::rtu::BROADCAST,
            Transaction::Served { .. } => false,
            Transaction::Frames { request, reply, .. } => request.is_some() && reply.is_some(),
        }
    }

    /// Whether the gateway serves it as a slave.
    pub(crate) const fn is_served(&self) -> bool {
        matches!(self.transaction, Transaction::Served { .. })
    }

    /// The device's own frames of the exchange that are received (input: a reply, a pending answer, a refusal) or sent
    /// (output).
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

    /// The fields that are received with a reply (input) or sent (output); `None` if there is no such frame.
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

    /// The fields of its pending answer and of its refusal, if they have values: these are input frames like a reply.
    /// Those without values are only recognised.
    pub(crate) fn other_answers(&self, frames: &[FrameSpec], pool: &[FieldSpec]) -> [Option<Span>; 2] {
        let span = |nth| {
            let span = frames.get(usize::from(self.frame(Direction::Input, nth)?))?.fields;
            has_values(span.of(pool)).then_some(span)
        };
        [span(1), span(2)]
    }
}

pub(crate) fn has_values(fields: &[FieldSpec]) -> bool {
    fields.iter().any(FieldSpec::has_value)
}
