//! The counters of the controller, as `--stats` prints them.

use std::collections::BTreeMap;

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

/// A recipe port's counters since the controller was created.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct RecipePortCounters {
    /// Times the port came up.
    pub ups: u64,
    /// Bytes received; on CAN, data bytes.
    pub bytes_in: u64,
    /// Frames of the recipe found in them.
    pub frames_in: u64,
    /// Frames sent; each datagram to a UDP client counts.
    pub frames_out: u64,
    /// Bytes of the frames sent.
    pub bytes_out: u64,
    /// Cycles in which no frame was sent.
    pub skipped_cycles: u64,
    /// Bytes discarded because no frame begins there.
    pub skipped_bytes: u64,
    /// Frames with a wrong tail.
    pub tail_mismatches: u64,
    /// Bytes of partial frames, discarded after silence.
    pub discarded_bytes: u64,
    /// Bytes at a port whose recipe has no input part.
    pub unexpected_bytes: u64,
    /// Bytes received while the port was sending on its half-duplex line.
    pub bytes_while_sending: u64,
    /// Datagrams with a wrong length, head or tail.
    pub wrong_datagrams: u64,
    /// CAN frames with an id that is not in the recipe.
    pub unknown_ids: u64,
    /// CAN frames with a wrong length.
    pub wrong_lengths: u64,
    /// Remote frames.
    pub remote_frames: u64,
    /// Frames rejected because a float was not finite.
    pub rejected_values: u64,
    /// Fields with reserved bits set, which were cleared.
    pub masked_fields: u64,
    /// Frames of a user recipe while no program ran.
    pub frames_without_program: u64,
    /// Frames of a user recipe dropped for newer ones.
    pub inbox_overflows: u64,
    /// UDP clients displaced by new ones.
    pub clients_displaced: u64,
    /// UDP clients removed after a minute of silence.
    pub clients_silent: u64,
    /// UDP clients removed because they could not be reached.
    pub clients_gone: u64,
}
