//! The keys of a configuration at which there can be an error.

/// A key of the controller's section.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ControllerKey {
    /// Its address.
    Address,
    /// Its dialect.
    Dialect,
    /// Its command, state and Modbus ports.
    Ports,
    /// The recipe link.
    RecipeLink,
}

/// A key of the board's own address.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum NetworkKey {
    /// Address and prefix.
    Address,
    /// The router.
    Router,
    /// The name server.
    Dns,
}

/// A key of a recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum RecipeKey {
    /// The recipe as a whole.
    Whole,
    /// Its name.
    Name,
    /// When a port sends it.
    Send,
}

/// A key of an exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ExchangeKey {
    /// The exchange as a whole.
    Whole,
    /// The slave or other peer.
    Peer,
    /// The addresses and the fields of registers or coils.
    Registers,
    /// Its period.
    Every,
    /// The bit that triggers it.
    Rising,
    /// How long its reply may take.
    Timeout,
    /// The pause after it.
    Pause,
    /// How long after an event it may be sent.
    Trigger,
    /// How long after its request a late reply may arrive.
    Late,
    /// Whether it stops its peer.
    Stop,
    /// The exchange that it follows.
    Follow,
    /// When the values of its reply are overdue.
    Overdue,
    /// The variables for the outcome of its events.
    Outcome,
    /// The request.
    Request,
    /// The reply.
    Reply,
    /// The pending answer.
    Pending,
    /// The refusal.
    Refusal,
    /// The sign of a restart of its peer in the reply.
    Restarted,
}

/// A key of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum PortKey {
    /// Its name.
    Name,
    /// Its recipe.
    Recipe,
    /// Its cycle.
    Cycle,
    /// Its timeout.
    Timeout,
    /// Its safe values.
    OnTimeout,
    /// The age at which its outputs are stale.
    StaleAfter,
    /// A serial line's speed.
    Baud,
    /// A serial line's stop bits.
    StopBits,
    /// A serial line's idle gap.
    IdleGap,
    /// A serial line's turnaround.
    Turnaround,
    /// Whether a serial line echoes.
    Echo,
    /// A CAN bus's speed.
    Bitrate,
    /// The address to listen on.
    Listen,
    /// The device to connect to.
    To,
    /// The variables of its health.
    Health,
    /// Whether safe values apply from the start.
    SafeAtStart,
    /// The time without a change after which it sends.
    Refresh,
    /// The time without a frame after which a peer of its exchanges counts as restarted.
    Absent,
}
