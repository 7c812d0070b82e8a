//! The counters of the controller, as `--stats` prints them.

use std::collections::BTreeMap;

use super::ports::RecipePortCounters;

/// Counters of one of the TCP servers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct ServerCounters {
    /// Connections accepted.
    pub opened: u64,
    /// Connections closed at once: too many, or a fault for tests.
    pub refused: u64,
    /// Connections closed to make room for another one (docs/devices.md section 7).
    pub displaced: u64,
    /// Open connections.
    pub open: usize,
    /// Bytes received.
    pub bytes_in: u64,
    /// Bytes sent.
    pub bytes_out: u64,
    /// Requests answered; on the state stream, packets.
    pub requests: u64,
    /// Of these, requests that were refused: unknown commands, Modbus exceptions.
    pub refusals: u64,
    /// Connections closed because the client broke the protocol.
    pub violations: u64,
    /// Answers dropped by a fault for tests.
    pub muted: u64,
}

/// All counters since the controller was created.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct ControllerCounters {
    /// Port 2000.
    pub command: ServerCounters,
    /// Port 2001.
    pub state: ServerCounters,
    /// Modbus.
    pub modbus: ServerCounters,
    /// Recipe ports by name.
    pub ports: BTreeMap<String, RecipePortCounters>,
    /// Datagrams at the UDP server while no port uses it.
    pub stray_datagrams: u64,
    /// Programs started.
    pub programs_started: u64,
    /// Of these, programs that ended with an error.
    pub programs_failed: u64,
    /// State packets skipped on the 100 ms grid because of a late call.
    pub missed_state_packets: u64,
}
