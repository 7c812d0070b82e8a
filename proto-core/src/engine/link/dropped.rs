//! Why a field's value gave no command, for counters and status.

use crate::time::Instant;

/// Why a value gave no command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
#[non_exhaustive]
pub enum DropReason {
    /// The value is in no entry of the field's table.
    Unknown,
    /// The value was the first one after the start, silence, sleep or a lost device: it only set the base.
    Based,
    /// The link to port 2000 was down, or was lost while the command waited.
    NoLink,
    /// The queue of waiting commands was full.
    QueueFull,
    /// It could not be sent within 1 s.
    TooOld,
    /// A command that stops the robot went first.
    Overtaken,
    /// The device is gone, or its frame is overdue.
    DeviceGone,
    /// It was picked before the gateway itself slept.
    Asleep,
    /// It cannot be written in the controller's dialect.
    Unwritable,
}

impl DropReason {
    /// All reasons.
    pub const ALL: [Self; 9] = [
        Self::Unknown,
        Self::Based,
        Self::NoLink,
        Self::QueueFull,
        Self::TooOld,
        Self::Overtaken,
        Self::DeviceGone,
        Self::Asleep,
        Self::Unwritable,
    ];

    /// A short text, such as `no command has this value`.
    pub const fn text(self) -> &'static str {
        match self {
            Self::Unknown => "no command has this value",
            Self::Based => "the first value only sets the base",
            Self::NoLink => "the link to the command port is down",
            Self::QueueFull => "too many commands wait",
            Self::TooOld => "not sent within 1 s",
            Self::Overtaken => "a command that stops the robot went first",
            Self::DeviceGone => "the device is gone or silent",
            Self::Asleep => "picked before the gateway slept",
            Self::Unwritable => "not a command of the controller's dialect",
        }
    }
}

/// The newest value of a port that gave no command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DroppedCommand {
    /// When the reason was known.
    pub at: Instant,
    /// The reason.
    pub why: DropReason,
    /// Index of the input frame; 0 in a stream recipe.
    pub frame: u8,
    /// Index of the field in the frame.
    pub field: u8,
    /// The field's value.
    pub value: i64,
}
