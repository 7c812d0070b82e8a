//! What a port has seen.

/// A recipe port's counters since the controller was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct PortCounters {
    /// Times the port came up.
    pub ups: u64,
    /// Bytes received; on CAN, data bytes.
    pub bytes_in: u64,
    /// Frames found in them that the recipe has.
    pub frames_in: u64,
    /// Frames sent; a datagram to each client counts.
    pub frames_out: u64,
    /// Bytes of them.
    pub bytes_out: u64,
    /// Cycles without a frame of their own.
    pub skipped_cycles: u64,
    /// Bytes dropped because no frame begins there.
    pub skipped_bytes: u64,
    /// Frames whose tail was something else.
    pub tail_mismatches: u64,
    /// Bytes of partial frames that were dropped after silence.
    pub discarded_bytes: u64,
    /// Bytes at a port whose recipe has no input part.
    pub unexpected_bytes: u64,
    /// Bytes that came while the port was sending on its half-duplex line.
    pub bytes_while_sending: u64,
    /// Datagrams of another length, or with another head or tail.
    pub wrong_datagrams: u64,
    /// CAN frames with an id the recipe does not have.
    pub unknown_ids: u64,
    /// CAN frames whose data is not as long as the fields.
    pub wrong_lengths: u64,
    /// Remote frames.
    pub remote_frames: u64,
    /// Frames rejected because a float was not finite.
    pub rejected_values: u64,
    /// Fields whose reserved bits were set and cleared.
    pub masked_fields: u64,
    /// Frames of a user recipe while no program was there.
    pub frames_without_program: u64,
    /// Frames of a user recipe that made room for newer ones.
    pub inbox_overflows: u64,
    /// UDP clients that made room for newer ones.
    pub clients_displaced: u64,
    /// UDP clients that had not sent anything for a minute.
    pub clients_silent: u64,
    /// UDP clients that could not be reached any more.
    pub clients_gone: u64,
}
