//! Kinds of faults, with names and relative frequencies.

/// A kind of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FaultKind {
    /// A server refuses connections, and the current connection is reset.
    Refused,
    /// The network to a server drops everything, and the current connection becomes half-open.
    BlackHole,
    /// A connection is reset.
    Reset,
    /// A connection is reset in the middle of a transmission.
    ResetMidPacket,
    /// A connection becomes half-open.
    HalfOpen,
    /// One direction of a connection stalls.
    Stall,
    /// Datagrams are lost, delayed and duplicated.
    Datagrams,
    /// All datagrams of a link are lost for a while.
    Burst,
    /// A peer's TCP acknowledges nothing, or receives nothing.
    Unacknowledged,
    /// The cable of one link, or of all links, is unplugged.
    Cable,
    /// Another program sends datagrams to a port where the gateway listens.
    Stranger,
    /// A server executes requests but does not answer.
    Mute,
    /// The replies of a server are late.
    SlowAnswers,
    /// The Modbus server replies with an exception.
    Exception,
    /// Port 2000 accepts only one client.
    OneClient,
    /// The state link is closed in the middle of a packet.
    HalfStatePacket,
    /// The state stream loses bytes and goes on.
    StateBytesLost,
    /// A value of the controller is NaN or infinite.
    Unreadable,
    /// A line flips bits.
    Noise,
    /// A device sends garbage.
    Garbage,
    /// A line or bus is cut.
    Cut,
    /// The adapter of a line is unplugged.
    Unplugged,
    /// A CAN controller is bus-off.
    BusOff,
    /// The controller is switched off and on.
    ControllerRestart,
    /// The controller loses its power for a while.
    PowerCut,
    /// The controller restarts with software of another dialect.
    Dialect,
    /// The gateway is switched off and on.
    GatewayRestart,
    /// The gateway is not called for less than half a second.
    GatewayStall,
    /// The gateway is not called for longer than that.
    GatewaySleep,
}

impl FaultKind {
    /// All kinds.
    pub const ALL: [Self; 29] = [
        Self::Refused,
        Self::BlackHole,
        Self::Reset,
        Self::ResetMidPacket,
        Self::HalfOpen,
        Self::Stall,
        Self::Datagrams,
        Self::Burst,
        Self::Unacknowledged,
        Self::Cable,
        Self::Stranger,
        Self::Mute,
        Self::SlowAnswers,
        Self::Exception,
        Self::OneClient,
        Self::HalfStatePacket,
        Self::StateBytesLost,
        Self::Unreadable,
        Self::Noise,
        Self::Garbage,
        Self::Cut,
        Self::Unplugged,
        Self::BusOff,
        Self::ControllerRestart,
        Self::PowerCut,
        Self::Dialect,
        Self::GatewayRestart,
        Self::GatewayStall,
        Self::GatewaySleep,
    ];

    /// Relative frequency. Faults that stop everything for long are rare, to leave time for the others.
    pub(super) const fn weight(self) -> u64 {
        match self {
            Self::GatewaySleep | Self::PowerCut | Self::GatewayRestart | Self::Dialect => 1,
            Self::Cable | Self::ControllerRestart => 2,
            _ => 4,
        }
    }

    /// A short name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Refused => "connections refused",
            Self::BlackHole => "network swallows",
            Self::Reset => "connection reset",
            Self::ResetMidPacket => "reset in the middle",
            Self::HalfOpen => "half-open connection",
            Self::Stall => "one direction stalls",
            Self::Datagrams => "datagrams lost and doubled",
            Self::Burst => "burst of lost datagrams",
            Self::Unacknowledged => "nothing acknowledged",
            Self::Cable => "cable out",
            Self::Stranger => "datagram of a stranger",
            Self::Mute => "server says nothing",
            Self::SlowAnswers => "slow answers",
            Self::Exception => "Modbus exceptions",
            Self::OneClient => "one client of port 2000",
            Self::HalfStatePacket => "half a state packet",
            Self::StateBytesLost => "state stream loses bytes",
            Self::Unreadable => "values not finite",
            Self::Noise => "noise on a line",
            Self::Garbage => "garbage from a device",
            Self::Cut => "line or bus cut",
            Self::Unplugged => "adapter pulled out",
            Self::BusOff => "bus-off",
            Self::ControllerRestart => "controller restart",
            Self::PowerCut => "controller without power",
            Self::Dialect => "controller of another dialect",
            Self::GatewayRestart => "gateway restart",
            Self::GatewayStall => "gateway stalls",
            Self::GatewaySleep => "gateway sleeps",
        }
    }
}
