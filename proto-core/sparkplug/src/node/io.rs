//! The inputs, outputs and counters of a node, and why it cannot be configured or has no session.

use proto_core::time::Instant;

use crate::mqtt::ProtocolError;
use crate::topic::IdError;
use crate::value::Value;

/// An input of the node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Input<'a> {
    /// The requested connection is established.
    Opened,
    /// The connection could not be established, or is lost.
    Closed,
    /// Bytes from the server.
    Bytes(&'a [u8]),
    /// All values at this instant, by their places in the catalog; `None`: unknown. Values missing at the end are
    /// unknown too.
    Sample {
        /// The values.
        values: &'a [Option<Value>],
        /// The devices that work: bit n is device n.
        alive: u32,
    },
    /// Values of the next sample, from a place on; `None`: unknown.
    Values {
        /// The place of the first value.
        first: usize,
        /// The values.
        values: &'a [Option<Value>],
    },
    /// The sample is complete: the values given by [`Input::Values`] are those of this instant.
    Sampled {
        /// The devices that work, as in [`Input::Sample`].
        alive: u32,
    },
    /// The UTC of this instant.
    Time {
        /// Milliseconds since 1970.
        utc_ms: u64,
    },
    /// Send the death, close the connection, and open none again.
    End,
}

/// What the driver has to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NodeOutput<'b> {
    /// Open a connection to the server, then report [`Input::Opened`] or [`Input::Closed`].
    Open,
    /// Store this number so that it survives a restart, before the next call of
    /// [`EdgeNode::poll_output`](super::EdgeNode::poll_output).
    Keep {
        /// The number, to be given to [`EdgeNode::new`](super::EdgeNode::new) after a restart.
        bd_seq: u8,
    },
    /// Send all these bytes before the next call of [`EdgeNode::poll_output`](super::EdgeNode::poll_output).
    Send(&'b [u8]),
    /// Close the connection, without reporting it.
    Close,
    /// There is more to do: call again. Other tasks may run first, and inputs may be given.
    Busy,
    /// Nothing to do until then, or until the next input.
    Sleep {
        /// [`Instant::NEVER`] if there is nothing to wait for.
        until: Instant,
    },
}

/// Why a node cannot be configured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum NodeError {
    /// The catalog has more metrics than there is room for.
    Metrics {
        /// Their number.
        count: usize,
        /// The maximum number.
        room: usize,
    },
    /// The catalog has more devices than [`MAX_DEVICES`](crate::catalog::MAX_DEVICES).
    Devices {
        /// Their number.
        count: usize,
    },
    /// The name of a device cannot be part of a topic.
    Device {
        /// The number of the device.
        nth: usize,
        /// What is wrong with its name.
        error: IdError,
    },
    /// Two devices have the same name.
    SameDevice {
        /// The number of the second one.
        nth: usize,
    },
    /// The catalog has no metric at a place.
    Metric {
        /// The place.
        place: usize,
    },
}

/// Why a session ended or could not begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SessionFailure {
    /// The connection could not be established, or was lost.
    Closed,
    /// The server did not answer in time.
    Silent,
    /// The server refused CONNECT with this MQTT 3.1.1 return code.
    Refused {
        /// The return code; 4: wrong user or password, 5: not authorised.
        code: u8,
    },
    /// The server refused the subscription.
    SubscriptionRefused,
    /// The server does not speak MQTT 3.1.1.
    Protocol(ProtocolError),
    /// The primary host is offline.
    HostOffline,
    /// What was written does not match its computed length, because the catalog changed or the driver's buffer is too
    /// short.
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

/// Counters since the node was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct NodeCounters {
    /// Connections that the server accepted.
    pub sessions: u32,
    /// Births of the node.
    pub births: u32,
    /// Births of the node that were requested by a command.
    pub rebirths: u32,
    /// Data messages.
    pub data: u64,
    /// Values that were published late, marked as historical.
    pub historical: u64,
    /// Values that were never published, because there was no room to store them.
    pub lost: u64,
    /// Values that wait to be published.
    pub kept: usize,
    /// Metrics in commands that were refused, as they are not writable.
    pub refused: u32,
    /// Messages that were malformed or too long.
    pub unreadable: u32,
    /// Sessions and attempts that failed.
    pub failures: u32,
    /// Metrics left out of a birth because they are longer than [`MAX_METRIC`](super::MAX_METRIC).
    pub left_out: u32,
}

impl NodeCounters {
    /// All counters at zero.
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
