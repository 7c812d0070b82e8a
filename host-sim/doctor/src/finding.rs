//! One finding and its texts.

use std::fmt;

use serde::ser::{Serialize, SerializeMap, Serializer};

/// Stands for the gateway's file in the commands of a remedy: only the caller of the doctor knows the file's name.
pub const FILE: &str = "FILE";

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Something could not be observed; nothing may be wrong.
    Note,
    /// It may be intended, such as a device that has not sent yet.
    Warning,
    /// It cannot work this way.
    Fault,
}

impl Severity {
    /// One word: `note`, `warning` or `fault`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Note => "note",
            Self::Warning => "warning",
            Self::Fault => "fault",
        }
    }
}

/// What a finding is about.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum FindingPlace {
    /// The field port of this name.
    Port(String),
    /// The link of this name.
    Link(String),
    /// The controller.
    Controller,
}

impl fmt::Display for FindingPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Port(name) => write!(f, "port {name}"),
            Self::Link(name) => write!(f, "link {name}"),
            Self::Controller => f.write_str("controller"),
        }
    }
}

macro_rules! causes {
    ($($(#[$doc:meta])* $variant:ident = $name:literal,)*) => {
        /// The likely cause, for programs; people read the text.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
        #[non_exhaustive]
        pub enum Cause {
            $($(#[$doc])* $variant,)*
        }

        impl Cause {
            /// All causes.
            pub const ALL: &[Self] = &[$(Self::$variant),*];

            /// The name in JSON, such as `head_swapped`.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }
        }
    };
}

causes! {
    /// The port's device does not exist.
    DeviceGone = "device_gone",
    /// Nothing arrives.
    NoBytes = "no_bytes",
    /// Bytes arrive but no frame begins in them: baud rate, parity, or another protocol.
    NoHead = "no_head",
    /// The head's bytes come in the other order.
    HeadSwapped = "head_swapped",
    /// Frames of the right length begin with other bytes.
    HeadDiffers = "head_differs",
    /// Bit 7 is a parity bit.
    SevenBits = "seven_bits",
    /// Frames of the right length end with other bytes.
    TailDiffers = "tail_differs",
    /// Frames have another number of bytes.
    LengthDiffers = "length_differs",
    /// Frames begin but are incomplete.
    BrokenOff = "broken_off",
    /// Numbers are only plausible in the other byte order.
    ByteOrder = "byte_order",
    /// The checksum is right when computed in another way.
    ChecksumKind = "checksum_kind",
    /// The checksum is wrong with every known algorithm.
    ChecksumWrong = "checksum_wrong",
    /// The frames belong to another device.
    OtherDevice = "other_device",
    /// A field is not a number, or its value does not fit.
    BadValue = "bad_value",
    /// The device's counter does not change.
    Frozen = "frozen",
    /// Bytes arrive but the recipe has no input part.
    NoInput = "no_input",
    /// Some frames are damaged.
    Noise = "noise",
    /// A slave does not answer.
    PeerSilent = "peer_silent",
    /// Another slave answers.
    PeerOther = "peer_other",
    /// The port receives its own transmissions.
    Echo = "echo",
    /// A slave refuses requests.
    PeerRefuses = "peer_refuses",
    /// The CAN controller has left the bus.
    BusOff = "bus_off",
    /// The CAN controller sees many errors.
    BusErrors = "bus_errors",
    /// CAN frames have ids that no recipe has.
    ForeignIds = "foreign_ids",
    /// The number of a CAN id is right, but not its kind.
    IdKind = "id_kind",
    /// CAN frames have another length.
    CanLength = "can_length",
    /// Remote frames arrive instead of data.
    Remote = "remote",
    /// The controller's port refuses connections.
    Refused = "refused",
    /// Nobody answers at the controller's address.
    Unreachable = "unreachable",
    /// The controller's name cannot be resolved.
    NoSuchHost = "no_such_host",
    /// The link is connected but nothing arrives.
    LinkSilent = "link_silent",
    /// The data is of another protocol or dialect.
    Dialect = "dialect",
    /// The controller refuses requests.
    LinkRefuses = "link_refuses",
    /// Datagrams are sent but none come back.
    OneWay = "one_way",
    /// The controller has not connected to the listening port.
    NotConnected = "not_connected",
    /// A peer other than the controller connects.
    Stranger = "stranger",
    /// The controller is in manual mode.
    Manual = "manual",
    /// The arm has no power.
    PowerOff = "power_off",
    /// The arm is not enabled.
    Disabled = "disabled",
    /// The controller is still starting.
    Starting = "starting",
    /// The emergency stop or a safety door is active.
    SafetyStop = "safety_stop",
    /// A program is already running.
    ProgramRuns = "program_runs",
    /// No program has this name.
    ProgramName = "program_name",
    /// The requested state is already reached.
    NothingToDo = "nothing_to_do",
    /// A command failed for an unknown reason.
    CommandFailed = "command_failed",
    /// A command got no reply.
    NoReply = "no_reply",
    /// A command got a reply with an unknown text.
    OtherReply = "other_reply",
    /// A command was not sent.
    NotSent = "not_sent",
    /// The first value of a command field only set the base.
    FirstValue = "first_value",
    /// A value is in no command table.
    UnknownValue = "unknown_value",
    /// The gateway itself slept: the discarded input may contain commands.
    Slept = "slept",
}

/// What is wrong, with its texts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// What it is about.
    pub place: FindingPlace,
    /// The likely cause, for programs.
    pub cause: Cause,
    /// What is seen, such as `175 bytes, 0 frames; first seen AA 48`.
    pub seen: String,
    /// What was expected, such as `the head 48 AA`; may be empty.
    pub expected: String,
    /// The likely cause in words.
    pub likely: String,
    /// What to do.
    pub remedy: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.place, self.seen)?;
        if !self.expected.is_empty() {
            write!(f, "; expected {}", self.expected)?;
        }
        write!(f, ". {}. {}.", self.likely, self.remedy)
    }
}

impl Serialize for Finding {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let (kind, name) = match &self.place {
            FindingPlace::Port(name) => ("port", name.as_str()),
            FindingPlace::Link(name) => ("link", name.as_str()),
            FindingPlace::Controller => ("controller", ""),
        };
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("severity", self.severity.name())?;
        map.serialize_entry("place", kind)?;
        if !name.is_empty() {
            map.serialize_entry("name", name)?;
        }
        map.serialize_entry("cause", self.cause.name())?;
        map.serialize_entry("seen", &self.seen)?;
        map.serialize_entry("expected", &self.expected)?;
        map.serialize_entry("likely", &self.likely)?;
        map.serialize_entry("remedy", &self.remedy)?;
        map.serialize_entry("text", &self.to_string())?;
        map.end()
    }
}

impl FindingPlace {
    pub(crate) fn found(
        &self,
        severity: Severity,
        cause: Cause,
        seen: impl Into<String>,
        expected: impl Into<String>,
        likely: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        Finding {
            severity,
            place: self.clone(),
            cause,
            seen: seen.into(),
            expected: expected.into(),
            likely: likely.into(),
            remedy: remedy.into(),
        }
    }

    pub(crate) fn fault(
        &self,
        cause: Cause,
        seen: impl Into<String>,
        expected: impl Into<String>,
        likely: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        self.found(Severity::Fault, cause, seen, expected, likely, remedy)
    }

    pub(crate) fn warning(
        &self,
        cause: Cause,
        seen: impl Into<String>,
        expected: impl Into<String>,
        likely: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        self.found(Severity::Warning, cause, seen, expected, likely, remedy)
    }
}
