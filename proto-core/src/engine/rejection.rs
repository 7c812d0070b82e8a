//! Why input on a port or link was rejected, for counters, tap and status.

use crate::sysvar::SysVar;
use crate::time::{Duration, Instant};
use crate::wire::can::CanId;

/// Why a frame, packet or reply was rejected as a whole, or a field of a device frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
#[non_exhaustive]
pub enum Rejection {
    /// Bytes in which no frame begins, or whose frame has a wrong tail (D19).
    NoFrame,
    /// A partial frame that silence ended (D19).
    Partial,
    /// A value that is not finite (D22).
    NotFinite,
    /// A value that does not fit the variable it is bound to (D22).
    OutOfRange,
    /// A CAN id that the recipe does not have (D17).
    ForeignId,
    /// A frame of another length than the recipe's (D17).
    WrongLength,
    /// A remote frame (D17).
    Remote,
    /// A wrong checksum.
    Checksum,
    /// A field that is not a number, such as a letter among digits.
    Unreadable,
    /// A frame of another device: a constant differs.
    OtherDevice,
    /// The recipe has no input part.
    NoInput,
    /// It waited while the gateway itself slept.
    Asleep,
    /// It violates the link's protocol.
    Malformed,
    /// Invalid escape bytes.
    Escape,
    /// The device refuses the request.
    Refused,
    /// The same alive counter as in the previous frame.
    Repeated,
    /// A reply that arrived too late, or that may answer any of several requests.
    Late,
}

impl Rejection {
    /// All reasons.
    pub const ALL: [Self; 17] = [
        Self::NoFrame,
        Self::Partial,
        Self::NotFinite,
        Self::OutOfRange,
        Self::ForeignId,
        Self::WrongLength,
        Self::Remote,
        Self::Checksum,
        Self::Unreadable,
        Self::OtherDevice,
        Self::NoInput,
        Self::Asleep,
        Self::Malformed,
        Self::Escape,
        Self::Refused,
        Self::Repeated,
        Self::Late,
    ];

    /// A short text, such as `no frame found`.
    pub const fn text(self) -> &'static str {
        match self {
            Self::NoFrame => "no frame found",
            Self::Partial => "a partial frame, ended by silence",
            Self::NotFinite => "a value is not finite",
            Self::OutOfRange => "a value does not fit its variable",
            Self::ForeignId => "a CAN id that the recipe does not have",
            Self::WrongLength => "a frame of another length",
            Self::Remote => "a remote frame",
            Self::Checksum => "a wrong checksum",
            Self::Unreadable => "a field is not a number",
            Self::OtherDevice => "a frame of another device",
            Self::NoInput => "the recipe has no input part",
            Self::Asleep => "waited while the gateway slept",
            Self::Malformed => "a violation of the protocol",
            Self::Escape => "wrong escape bytes",
            Self::Refused => "the device refuses the request",
            Self::Repeated => "the counter of the frame before",
            Self::Late => "a reply that came too late",
        }
    }
}

/// A rejected field of a device frame; the rest of the frame may have been accepted.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct RejectedField {
    /// Index of the frame among the recipe's input frames; those of exchanges follow those of the input part.
    pub frame: u8,
    /// Index of the field in the frame, in wire order; checksums do not count.
    pub field: u8,
    /// The variable that the value is for; for a text, the first one.
    pub var: Option<SysVar>,
    /// The number in the frame, before scale and offset; `None` if it could not be read, and for a text.
    pub value: Option<f64>,
    /// The lowest and the highest number that is taken, in the same unit; `None` if the field cannot have other ones,
    /// or if the numbers are not one range.
    pub allowed: Option<(f64, f64)>,
}

/// A rejected field, as the engine keeps it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FieldRejection {
    pub value: f64,
    /// Index among the bindings of all ports.
    pub binding: u16,
    pub why: Rejection,
}

/// Number of bytes kept of a rejected frame.
pub const KEPT_BYTES: usize = 32;

/// The newest rejection of a port, with the first [`KEPT_BYTES`] rejected bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LastRejection {
    /// When the input was rejected; for bytes without a frame, when the first arrived.
    pub at: Instant,
    /// The reason.
    pub why: Rejection,
    /// The frame's id on a CAN bus.
    pub can_id: Option<CanId>,
    /// Length of the rejected frame or bytes, even if fewer are kept. For [`Rejection::NoFrame`] it is the number of
    /// bytes that belong to no frame, and the kept bytes are those of the chunks that contain them.
    pub len: usize,
    /// The rejected field, if it was one of a device frame.
    pub(super) field: Option<FieldRejection>,
    /// When its newest bytes arrived.
    newest_at: Instant,
    kept: u8,
    bytes: [u8; KEPT_BYTES],
}

impl LastRejection {
    pub(super) fn new(at: Instant, why: Rejection, can_id: Option<CanId>, bytes: &[u8]) -> Self {
        let mut rejection = Self {
            at,
            why,
            can_id,
            len: bytes.len(),
            field: None,
            newest_at: at,
            kept: 0,
            bytes: [0; KEPT_BYTES],
        };
        for (kept, &byte) in rejection.bytes.iter_mut().zip(bytes) {
            *kept = byte;
        }
        rejection.kept = bytes.len().min(KEPT_BYTES) as u8;
        rejection
    }

    /// `skipped` bytes in a chunk of `bytes` belong to no frame.
    pub(super) fn no_frame(at: Instant, skipped: usize, bytes: &[u8]) -> Self {
        Self { len: skipped, ..Self::new(at, Rejection::NoFrame, None, bytes) }
    }

    /// Whether bytes without a frame at `now` belong to this rejection, because there was no silence between them.
    pub(super) fn goes_on(&self, now: Instant, idle_gap: Duration) -> bool {
        self.why == Rejection::NoFrame && now.saturating_since(self.newest_at) <= idle_gap
    }

    /// Adds `skipped` further bytes, in a chunk of `bytes`.
    pub(super) fn append(&mut self, now: Instant, skipped: usize, bytes: &[u8]) {
        let free = self.bytes.iter_mut().skip(usize::from(self.kept));
        let added = free.zip(bytes).map(|(kept, &byte)| *kept = byte).count();
        self.kept = self.kept.saturating_add(added as u8);
        self.len = self.len.saturating_add(skipped);
        self.newest_at = now;
    }

    /// The first rejected bytes.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..usize::from(self.kept)).unwrap_or(&[])
    }
}
