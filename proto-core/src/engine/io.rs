//! The engine's inputs and outputs.

use core::net::SocketAddr;

use crate::config::MAX_PORTS;
use crate::time::Instant;
use crate::wire::can::CanFrame;

/// A field or listening port, by its index in [`crate::config::GatewayConfig::ports`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct PortId(pub u8);

/// A link to the controller, or to the devices of a port of Modbus TCP; [`super::Engine::links`] lists them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkId(pub u8);

impl LinkId {
    /// The command link: port 2000.
    pub const COMMAND: Self = Self(0);
    /// The state link: port 2001.
    pub const STATE: Self = Self(1);
    /// The Modbus link.
    pub const MODBUS: Self = Self(2);
    /// The recipe link to the controller's UDP server.
    pub const RECIPE_UDP: Self = Self(3);
    /// The urgent link: a second connection to port 2000, for commands that stop the robot (D26).
    pub const URGENT: Self = Self(FIRST_PORT + MAX_PORTS as u8);

    /// The link of a listening port or of a Modbus TCP port.
    pub const fn of_port(port: PortId) -> Self {
        Self(port.0.saturating_add(FIRST_PORT))
    }

    /// The port that the link belongs to, if any.
    pub const fn port(self) -> Option<PortId> {
        match self.0.checked_sub(FIRST_PORT) {
            Some(port) if self.0 < Self::URGENT.0 => Some(PortId(port)),
            _ => None,
        }
    }
}

/// The lowest id of a port's link.
const FIRST_PORT: u8 = 4;

/// The kind of a link: what the driver opens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum LinkKind {
    /// TCP to the controller's command port.
    Command,
    /// A second connection to the controller's command port, for commands that stop the robot.
    Urgent,
    /// TCP to the controller's state port.
    State,
    /// TCP to the controller's Modbus port.
    Modbus,
    /// UDP to the controller's recipe port.
    RecipeUdp,
    /// TCP: listen on the port's address, accept one connection.
    RecipeTcpListen {
        /// The port.
        port: PortId,
    },
    /// UDP: listen on the port's address, reply to the newest sender of a frame.
    RecipeUdpListen {
        /// The port.
        port: PortId,
    },
    /// TCP to the devices of a field port of Modbus TCP; not to the controller.
    ModbusDevice {
        /// The port.
        port: PortId,
    },
}

impl LinkKind {
    /// A short name for logs and statistics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Command => "command",
            Self::Urgent => "urgent",
            Self::State => "state",
            Self::Modbus => "modbus",
            Self::RecipeUdp => "udp2011",
            Self::RecipeTcpListen { .. } => "tcp-listen",
            Self::RecipeUdpListen { .. } => "udp-listen",
            Self::ModbusDevice { .. } => "modbus-tcp",
        }
    }
}

/// Where a link goes and how it is opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Endpoint<'a> {
    /// How it is opened, and on which port.
    pub transport: Transport,
    /// The controller's or device's address or host name, as configured; empty if the driver learns it otherwise. For a
    /// listening link, the only peer that may connect or send.
    pub host: &'a str,
}

impl<'a> Endpoint<'a> {
    /// An endpoint at `host`.
    pub const fn new(transport: Transport, host: &'a str) -> Self {
        Self { transport, host }
    }
}

/// How a link is opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Transport {
    /// Connect with TCP.
    Tcp {
        /// The controller's or device's port.
        port: u16,
    },
    /// Send UDP datagrams from any local port, and receive the replies.
    Udp {
        /// The controller's port.
        port: u16,
    },
    /// Listen, and accept one TCP connection.
    TcpListen {
        /// The address to listen on; on a board with one address only the port matters.
        local: SocketAddr,
    },
    /// Receive UDP datagrams, and reply to the newest sender.
    UdpListen {
        /// The address to listen on; on a board with one address only the port matters.
        local: SocketAddr,
    },
}

/// A CAN controller's error state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BusState {
    /// Error-active: normal operation.
    Active,
    /// Error-warning: an error counter has passed 96.
    Warning,
    /// Error-passive.
    Passive,
    /// Bus-off: nothing can be sent until the driver recovers it and reports another state.
    BusOff,
}

impl BusState {
    /// One word for people and statistics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Active => "active",
            Self::Warning => "warning",
            Self::Passive => "passive",
            Self::BusOff => "bus-off",
        }
    }
}

/// Health of a field port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum PortState {
    /// Its input frames arrive in time. A port without an input part only needs its device.
    Working,
    /// An input frame is overdue, or none has arrived yet.
    Silent,
    /// The CAN controller has left the bus.
    BusOff,
    /// Its device is not available.
    Gone,
}

impl PortState {
    /// One word for people and statistics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Working => "working",
            Self::Silent => "silent",
            Self::BusOff => "bus-off",
            Self::Gone => "gone",
        }
    }
}

/// Result of the newest command that a port's values picked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
#[non_exhaustive]
pub enum ReplyCode {
    /// No value has picked a command yet.
    #[default]
    None = 0,
    /// Waiting to be sent, or for its reply.
    Pending = 1,
    /// The controller replied that it succeeded.
    Success = 2,
    /// The controller replied that it failed.
    Fail = 3,
    /// The controller sent another reply.
    Other = 4,
    /// No reply arrived in time, or the link was lost before it.
    NoReply = 5,
    /// It was not sent: the link was down, or too many commands were waiting.
    NotSent = 6,
}

impl ReplyCode {
    /// One word for people and statistics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Pending => "pending",
            Self::Success => "success",
            Self::Fail => "fail",
            Self::Other => "other",
            Self::NoReply => "noreply",
            Self::NotSent => "notsent",
        }
    }
}

/// An event that the driver reports to the engine.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub enum Input<'a> {
    /// A port's device is ready. Not used for a Modbus TCP port, which has a link.
    PortUp {
        /// The port.
        port: PortId,
    },
    /// A port's device is gone. What was handed over for sending is lost, and no [`Input::PortSent`] follows.
    PortDown {
        /// The port.
        port: PortId,
    },
    /// Bytes from a serial line, in chunks of any size.
    PortBytes {
        /// The port.
        port: PortId,
        /// The bytes.
        bytes: &'a [u8],
    },
    /// A frame from a CAN bus.
    PortCan {
        /// The port.
        port: PortId,
        /// The frame.
        frame: CanFrame,
    },
    /// Everything handed over for sending has left the port.
    PortSent {
        /// The port.
        port: PortId,
    },
    /// A CAN controller's error state changed.
    PortBus {
        /// The port.
        port: PortId,
        /// The new state.
        state: BusState,
    },
    /// A link that the engine opened is usable.
    LinkUp {
        /// The link.
        link: LinkId,
    },
    /// A link could not be opened, or was lost. No [`Input::LinkSent`] follows for what was handed over to it.
    LinkDown {
        /// The link.
        link: LinkId,
    },
    /// Bytes from a link; for a datagram link, one whole datagram per call.
    LinkBytes {
        /// The link.
        link: LinkId,
        /// The bytes.
        bytes: &'a [u8],
    },
    /// The transport has taken everything handed over and has room for more. This says nothing about delivery.
    LinkSent {
        /// The link.
        link: LinkId,
    },
    /// How many of the bytes handed over to a TCP link since it came up the peer's transport has not acknowledged.
    /// Report it before bytes that arrived, and at least every 20 ms while the number changes; never for a datagram
    /// link.
    LinkAcked {
        /// The link.
        link: LinkId,
        /// Unacknowledged bytes, including those the driver still holds.
        left: u32,
    },
    /// Time has passed, and everything that arrived before has been reported. Only this input lets deadlines pass.
    Tick,
}

/// Whether an input may have produced an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Handled {
    /// Call [`super::Engine::poll_output`] until it is [`Output::Sleep`].
    Poll,
    /// Nothing to do: the engine sleeps until the instant of the newest [`Output::Sleep`]. Polling it is harmless.
    Asleep,
}

/// A task for the driver.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Output<'a> {
    /// Send on a serial line, then report [`Input::PortSent`].
    PortSend {
        /// The port.
        port: PortId,
        /// One whole frame.
        bytes: &'a [u8],
    },
    /// Queue a CAN frame after the previous ones; report [`Input::PortSent`] when the queue is empty. At most
    /// [`crate::recipe::model::MAX_CAN_IDS`] frames are handed over before that.
    PortSendCan {
        /// The port.
        port: PortId,
        /// The frame.
        frame: CanFrame,
    },
    /// Open a link, then report [`Input::LinkUp`] or [`Input::LinkDown`].
    LinkOpen {
        /// The link.
        link: LinkId,
        /// Where it goes.
        to: Endpoint<'a>,
    },
    /// Close a link at once and report nothing more about it. Reset TCP connections: unacknowledged bytes must not be
    /// delivered later.
    LinkClose {
        /// The link.
        link: LinkId,
    },
    /// Send on a link (on a datagram link: one datagram), then report [`Input::LinkSent`].
    LinkSend {
        /// The link.
        link: LinkId,
        /// The bytes.
        bytes: &'a [u8],
    },
    /// Nothing more to do before this instant.
    Sleep {
        /// The latest time to report [`Input::Tick`]; [`Instant::NEVER`] without a configuration.
        until: Instant,
    },
}
