//! The invariants, their names in reports, and violations.

use proto_core::time::Instant;

/// The invariants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Invariant {
    /// Each written value is the next one that its owner sent, a safe value, or a value that was read back.
    Sent,
    /// No value is written after its time to live.
    InTime,
    /// No value is written before the first valid field frame that contains it.
    FirstFrame,
    /// Only variables that a port owns are written, completely, on their route.
    Ownership,
    /// Nothing received before a reconnect is written after it.
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
    /// No shown value is older than promised.
    Age,
    /// The value shown is the newest one received.
    Shown,
    /// A port never sends faster than its cycle, and each cycle, request and trigger is served or counted.
    Cycle,
    /// A port sends one transmission at a time, on a silent line, to a device that is present.
    Line,
    /// The controller receives what the gateway sent.
    Transport,
    /// The controller's inputs are the values written, and nothing else writes them.
    Registers,
    /// No value that the controller applies is older than promised.
    ValueAge,
    /// No command reaches the controller too long after it was selected or last requested.
    CommandAge,
    /// No command that was selected before an urgent one arrives after it.
    Overtaken,
    /// The controller understands every command that arrives.
    Understood,
    /// An urgent command arrives soon after a path to the controller works.
    StopArrives,
    /// The safe value of an overdue owner arrives soon after a path to the controller works.
    SafeArrives,
    /// An unreadable value is neither shown nor written back.
    Unreadable,
    /// No shown value of another field port is older than promised.
    OwnAge,
    /// A short stall of the gateway does not make a device overdue.
    FalseTimeout,
    /// Nothing that waited while the gateway slept is applied or selects a command.
    FromSleep,
    /// Datagrams are sent only to the controller's client.
    Destination,
    /// The number of outputs for one input is bounded.
    Work,
    /// Every queue is bounded.
    Memory,
    /// Exactly the replies of a slave on a line are accepted, and a value that reaches the controller was held by the
    /// slave.
    Held,
    /// What a slave accepts was requested, and consists of values that the controller had at the same time, not long
    /// ago.
    Carried,
    /// The slaves of a line are polled as often as their periods say, and probed while they are silent.
    Periods,
    /// A slave that replies promptly has the controller's values.
    Updated,
    /// A device executes an event at most once per rise, in time, with values that the robot had since the rise.
    EventsOnce,
    /// A stop is sent soon, and before every event.
    StopsFirst,
    /// The start exchanges of a device are executed once per start.
    StartsOnce,
    /// A value of a device that the robot is shown was held by the device not long ago.
    DeviceValues,
    /// A device keeps the value that the robot has.
    DeviceKeeps,
    /// Nothing panics.
    NoPanic,
}

/// A violated invariant, and a description.
pub(super) type Wrong = (Invariant, String);

impl Invariant {
    /// All invariants.
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
    /// A description with the values involved.
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
