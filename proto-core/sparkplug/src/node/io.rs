//! What a node takes, asks for and counts, and why it cannot be made or has no session.

use proto_core::time::Instant;

use crate::mqtt::ProtocolError;
use crate::topic::IdError;
use crate::value::Value;

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Input<'a> {
    /// The connection that was asked for is there.
    Opened,
    /// It could not be made, or is gone.
    Closed,
    /// Bytes of the server.
    Bytes(&'a [u8]),
    /// All values at this instant, by the places of the catalog; `None`: unknown. What is missing at the end is
    /// unknown too.
    Sample {
        /// The values.
        values: &'a [Option<Value>],
        /// The devices that work: bit n is device n.
        alive: u32,
    },
    /// Values of the next sample, by the places from this one on; `None`: unknown.
    Values {
        /// The place of the first one.
        first: usize,
        /// The values.
        values: &'a [Option<Value>],
    },
    /// All values were given by [`Input::Values`]: they are those of this instant.
    Sampled {
        /// The devices that work, as in [`Input::Sample`].
        alive: u32,
    },
    /// UTC at this instant.
    Time {
        /// Milliseconds since 1970.
        utc_ms: u64,
    },
    /// Die, close the connection and open none any more.
    End,
}

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NodeOutput<'b> {
    /// Open a connection to the server, and report [`Input::Opened`] or [`Input::Closed`].
    Open,
    /// Keep this number where it survives a restart, before the next output is asked for.
    Keep {
        /// The number, to be given to [`EdgeNode::new`](super::EdgeNode::new) after a restart.
        bd_seq: u8,
    },
    /// Send all these bytes before the next output is asked for.
    Send(&'b [u8]),
    /// Close the connection; it is not to be reported.
    Close,
    /// There is more to do: ask again. Others may run before, and inputs may be given.
    Busy,
    /// Nothing until then, or until the next input.
    Sleep {
        /// [`Instant::NEVER`] if there is nothing to wait for.
        until: Instant,
    },
}

/// Why a node cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum NodeError {
    /// More metrics than there is room for.
    Metrics {
        /// Their number.
        count: usize,
        /// The room.
        room: usize,
    },
    /// More devices than [`MAX_DEVICES`](crate::catalog::MAX_DEVICES).
    Devices {
        /// Their number.
        count: usize,
    },
    /// The name of a device cannot be part of a topic.
    Device {
        /// The device.
        nth: usize,
        /// What is wrong with its name.
        error: IdError,
    },
    /// Two devices have the same name.
    SameDevice {
        /// The second one.
        nth: usize,
    },
    /// The catalog has no metric at a place.
    Metric {
        /// The place.
        place: usize,
    },
}

/// Why a session ended or did not begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SessionFailure {
    /// There was no connection, or it broke.
    Closed,
    /// The server did not answer in time.
    Silent,
    /// The server refused CONNECT, with this code of MQTT 3.1.1.
    Refused {
        /// 4: wrong user or password, 5: not authorised.
        code: u8,
    },
    /// The server refused the subscription.
    SubscriptionRefused,
    /// The server does not speak MQTT 3.1.1.
    Protocol(ProtocolError),
    /// The primary host is offline.
    HostOffline,
    /// The catalog, or the driver's buffer, does not keep what is written of it.
    Broken,
}

impl core::fmt::Display for SessionFailure {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Closed => "no connection",
            Self::Silent => "the broker does not answer",
            Self::Refused { code: 4 } => "the broker refuses the user or the password",
            Self::Refused { code: 5 } => "the broker does not allow this client",
            Self::Refused { code } => return write!(f, "the broker refuses the connection with code {code}"),
            Self::SubscriptionRefused => "the broker refuses the subscription to commands",
            Self::Protocol(_) => "the broker does not speak MQTT 3.1.1",
            Self::HostOffline => "the primary host is offline",
            Self::Broken => "what is told changes while it is told",
        })
    }
}

impl core::error::Error for SessionFailure {}

/// Counts since the node was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct NodeCounters {
    /// Connections that the server accepted.
    pub sessions: u32,
    /// Births of the node.
    pub births: u32,
    /// Those of them that were asked for.
    pub rebirths: u32,
    /// Messages of data.
    pub data: u64,
    /// Values that were told late, marked as historical.
    pub historical: u64,
    /// Values that were never told, because there was no room to keep them.
    pub lost: u64,
    /// Values that wait to be told.
    pub kept: usize,
    /// Commands that were not obeyed: metrics that nobody may write.
    pub refused: u32,
    /// Messages that nobody could read, or that were too long.
    pub unreadable: u32,
    /// Sessions and attempts that failed.
    pub failures: u32,
    /// Metrics left out of a birth because they are longer than [`MAX_METRIC`](super::MAX_METRIC).
    pub left_out: u32,
}

impl NodeCounters {
    /// Before anything has happened.
    pub const NONE: Self = Self {
        sessions: 0,
        births: 0,
        rebirths: 0,
        data: 0,
        historical: 0,
        lost: 0,
        kept: 0,
        refused: 0,
        unreadable: 0,
        failures: 0,
        left_out: 0,
    };
}
