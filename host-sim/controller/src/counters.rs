//! What the controller has seen, as `--stats` prints it.

use std::collections::BTreeMap;

use super::ports::PortCounters;

/// Counters of one of the TCP servers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct ServerCounters {
    /// Connections taken.
    pub opened: u64,
    /// Connections closed at once: too many, or a test wanted it.
    pub refused: u64,
    /// Connections closed to make room for another one (docs/devices.md section 7).
    pub displaced: u64,
    /// Connections that are open.
    pub open: usize,
    /// Bytes received.
    pub bytes_in: u64,
    /// Bytes sent.
    pub bytes_out: u64,
    /// Requests answered; on the state stream, packets.
    pub requests: u64,
    /// Of them, those refused: unknown commands, Modbus exceptions.
    pub refusals: u64,
    /// Connections closed because the client broke the protocol.
    pub violations: u64,
    /// Answers swallowed because a test wanted it.
    pub muted: u64,
}

/// Everything that is counted, since the controller was made.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct Counters {
    /// Port 2000.
    pub command: ServerCounters,
    /// Port 2001.
    pub state: ServerCounters,
    /// Modbus.
    pub modbus: ServerCounters,
    /// Recipe ports by name.
    pub ports: BTreeMap<String, PortCounters>,
    /// Datagrams at the UDP server while no port has it.
    pub stray_datagrams: u64,
    /// Programs that were started.
    pub programs_started: u64,
    /// Of them, those that ended with an error.
    pub programs_failed: u64,
    /// State packets that a late call missed on the 100 ms grid.
    pub missed_state_packets: u64,
}
