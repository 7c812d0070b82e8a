//! The invariants that are checked, their names in reports, and a violation of one.

use proto_core::time::Instant;

/// The invariants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Invariant {
    /// Each value written is the next one that its owner sent, a safe value, or one that was read back.
    Sent,
    /// No value is written after its time to live.
    InTime,
    /// No value is written before the first valid field frame with it.
    FirstFrame,
    /// Only variables that a port owns are written, whole, on their way up.
    Ownership,
    /// Nothing that was received before a reconnect is written after it.
    NoReplay,
    /// The edges of bits are written in order, or counted.
    Edges,
    /// A waiting value is sent as soon as its link is free.
    Delivered,
    /// Every frame on the wire is applied or counted: all counters agree with the model's.
    Counted,
    /// Every received byte is in a frame, dropped, discarded, or held.
    Bytes,
    /// A command is sent once, in time, or not at all.
    Once,
    /// No value is shown before it was received.
    Known,
    /// No value older than promised is shown.
    Age,
    /// The value shown is the newest one received.
    Shown,
    /// Never faster than the cycle, and each cycle, request and trigger is served or counted.
    Cycle,
    /// One transmission at a time, on a silent line, to a device that is there.
    Line,
    /// The controller receives what the gateway sent.
    Transport,
    /// The controller's inputs are the values written, and nothing else writes them.
    Registers,
    /// No value that the controller applies is older than promised.
    ValueAge,
    /// No command that the controller receives was picked, or last requested, too long ago.
    CommandAge,
    /// No command that was picked before an urgent one arrives after it.
    Overtaken,
    /// The controller understands every command that arrives.
    Understood,
    /// An urgent command arrives soon after a path to the controller works.
    StopArrives,
    /// The safe value of an overdue owner arrives soon after a path to the controller works.
    SafeArrives,
    /// An unreadable value is neither shown nor written back.
    Unreadable,
    /// No value of another field port older than promised is shown.
    OwnAge,
    /// A short stall of the gateway does not make a device overdue.
    FalseTimeout,
    /// Nothing that waited while the gateway slept is applied or commanded.
    FromSleep,
    /// Datagrams are sent only to the controller's client.
    Destination,
    /// The number of outputs for one input is bounded.
    Work,
    /// Every queue is bounded.
    Memory,
    /// What a slave of a line answered is taken, and only that; what reaches the controller was held there.
    Held,
    /// What a slave takes was asked for, and is what the controller had, together and not long ago.
    Carried,
    /// The slaves of a line are asked as often as their periods say, and looked for while they are silent.
    Periods,
    /// A slave that answers soon has the controller's values.
    Updated,
    /// A device executes an event at most once for a rise, in time, with the robot's values since the rise.
    EventsOnce,
    /// A stop comes before every event, and soon.
    StopsFirst,
    /// What a device is sent at its start is executed once for each start.
    StartsOnce,
    /// What the robot is shown of a device was so, not long ago.
    DeviceValues,
    /// A device keeps what the robot has.
    DeviceKeeps,
    /// Nothing panics.
    NoPanic,
}

/// A violated invariant, and a description.
pub(super) type Wrong = (Invariant, String);

impl Invariant {
    /// All of them.
    pub const ALL: [Self; 40] = [
        Self::Sent,
        Self::InTime,
        Self::FirstFrame,
        Self::Ownership,
        Self::NoReplay,
        Self::Edges,
        Self::Delivered,
        Self::Counted,
        Self::Bytes,
        Self::Once,
        Self::Known,
        Self::Age,
        Self::Shown,
        Self::Cycle,
        Self::Line,
        Self::Transport,
        Self::Registers,
        Self::ValueAge,
        Self::CommandAge,
        Self::Overtaken,
        Self::Understood,
        Self::StopArrives,
        Self::SafeArrives,
        Self::Unreadable,
        Self::OwnAge,
        Self::FalseTimeout,
        Self::FromSleep,
        Self::Destination,
        Self::Work,
        Self::Memory,
        Self::Held,
        Self::Carried,
        Self::Periods,
        Self::Updated,
        Self::EventsOnce,
        Self::StopsFirst,
        Self::StartsOnce,
        Self::DeviceValues,
        Self::DeviceKeeps,
        Self::NoPanic,
    ];

    /// A short name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sent => "values-were-sent",
            Self::InTime => "values-in-time",
            Self::FirstFrame => "nothing-before-a-frame",
            Self::Ownership => "ownership",
            Self::NoReplay => "no-replay",
            Self::Edges => "edges-in-order",
            Self::Delivered => "nothing-is-left-waiting",
            Self::Counted => "applied-or-counted",
            Self::Bytes => "bytes-add-up",
            Self::Once => "commands-once",
            Self::Known => "shown-is-known",
            Self::Age => "shown-is-young",
            Self::Shown => "shown-is-newest",
            Self::Cycle => "cycle",
            Self::Line => "one-at-a-time",
            Self::Transport => "received-is-sent",
            Self::Registers => "registers",
            Self::ValueAge => "value-age",
            Self::CommandAge => "command-age",
            Self::Overtaken => "stop-is-last",
            Self::Understood => "commands-understood",
            Self::StopArrives => "stop-arrives",
            Self::SafeArrives => "safe-arrives",
            Self::Unreadable => "unreadable-shown",
            Self::OwnAge => "own-values-age",
            Self::FalseTimeout => "no-false-timeout",
            Self::FromSleep => "nothing-from-sleep",
            Self::Destination => "destination",
            Self::Work => "bounded-work",
            Self::Memory => "bounded-memory",
            Self::Held => "held-by-slave",
            Self::Carried => "slave-is-told-right",
            Self::Periods => "periods-are-kept",
            Self::Updated => "slave-is-told",
            Self::EventsOnce => "events-once",
            Self::StopsFirst => "stops-first",
            Self::StartsOnce => "starts-once",
            Self::DeviceValues => "device-values",
            Self::DeviceKeeps => "device-keeps",
            Self::NoPanic => "no-panic",
        }
    }
}

/// A violated invariant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// The invariant.
    pub invariant: Invariant,
    /// When it was violated.
    pub at: Instant,
    /// A description, with the numbers.
    pub what: String,
}

impl Violation {
    /// A run ended in a panic.
    pub(crate) fn panic(at: Instant) -> Self {
        Self { invariant: Invariant::NoPanic, at, what: "a panic: see its message".to_owned() }
    }
}

impl std::fmt::Display for Violation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.invariant.name(), self.what)
    }
}
