//! Everything that was done, refused or skipped, counted.

/// What happened on a field port. Counters wrap after 2^32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct PortCounters {
    /// Frames accepted.
    pub frames_in: u32,
    /// Bytes received (CAN: data bytes).
    pub bytes_in: u32,
    /// Frames handed over for sending.
    pub frames_out: u32,
    /// Bytes handed over for sending (CAN: data bytes).
    pub bytes_out: u32,
    /// Frames rejected for a value that is not finite (D22).
    pub rejected_not_finite: u32,
    /// Frames rejected because a bound value did not fit its variable (D22).
    pub rejected_out_of_range: u32,
    /// CAN frames ignored because the recipe does not have their id (D17).
    pub rejected_id: u32,
    /// CAN frames rejected because their length is not the declared one (D17).
    pub rejected_length: u32,
    /// Remote frames ignored (D17).
    pub rejected_remote: u32,
    /// Frames on a port whose recipe has no input part.
    pub rejected_no_input: u32,
    /// Heads whose frame did not end in the tail (D19).
    pub tail_mismatches: u32,
    /// Bytes dropped while looking for a frame (D19).
    pub resync_bytes: u32,
    /// Bytes of partial frames discarded after silence (D19), and bytes that waited while the gateway
    /// itself slept.
    pub discarded_bytes: u32,
    /// Chunks of bytes, or CAN frames, discarded because they waited while the gateway itself slept.
    pub asleep: u32,
    /// Accepted frames in which reserved bits were masked (D22).
    pub masked: u32,
    /// Bit values that were replaced by newer ones because the queue of edges was full.
    pub edges_lost: u32,
    /// Values dropped before they could be written: older than the port's timeout, or waiting for a
    /// link that was lost.
    pub values_expired: u32,
    /// Accepted frames with a value that could not be passed on: its link was down.
    pub undelivered: u32,
    /// Accepted frames with a value that had to wait for its neighbours to be read back.
    pub withheld: u32,
    /// Cycles in which no output frame could be sent in time (D20).
    pub skipped_cycles: u32,
    /// Cycles in which no output frame was sent because its sources were stale or unknown.
    pub stale_cycles: u32,
    /// Times the field frame was overdue.
    pub timeouts: u32,
    /// Times the device was reported gone.
    pub downs: u32,
    /// Times the CAN controller was reported bus-off.
    pub bus_offs: u32,
    /// Commands picked by a value.
    pub commands: u32,
    /// Commands that could not be sent.
    pub commands_dropped: u32,
}

/// What happened on a controller link, beside [`crate::link::LinkHistory`]. Counters wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct LinkCounters {
    /// Requests, frames or commands sent.
    pub sent: u32,
    /// Answers, frames or packets accepted.
    pub received: u32,
    /// Bytes received.
    pub bytes_in: u32,
    /// Requests without an answer in time.
    pub timeouts: u32,
    /// Exceptions and failure replies.
    pub refused: u32,
    /// Malformed answers, frames and packets.
    pub malformed: u32,
    /// Values received that were not finite: they are unknown until a readable one comes.
    pub unreadable: u32,
    /// Connections reset because the peer's transport had not acknowledged what was handed over by
    /// the time after which it must not be delivered.
    pub unacknowledged: u32,
    /// Bytes dropped while looking for a frame.
    pub resync_bytes: u32,
    /// Microseconds from the newest request to its answer.
    pub round_trip_us: u32,
    /// The longest of these.
    pub round_trip_max_us: u32,
}

impl LinkCounters {
    /// Nothing happened yet.
    pub(super) const ZERO: Self = Self {
        sent: 0,
        received: 0,
        bytes_in: 0,
        timeouts: 0,
        refused: 0,
        malformed: 0,
        unreadable: 0,
        unacknowledged: 0,
        resync_bytes: 0,
        round_trip_us: 0,
        round_trip_max_us: 0,
    };

    /// An answer came `micros` after its request.
    pub(super) fn answered(&mut self, micros: u64) {
        bump(&mut self.received);
        self.round_trip_us = u32::try_from(micros).unwrap_or(u32::MAX);
        self.round_trip_max_us = self.round_trip_max_us.max(self.round_trip_us);
    }
}

/// One more.
pub(super) fn bump(counter: &mut u32) {
    add(counter, 1);
}

/// `n` more.
pub(super) fn add(counter: &mut u32, n: usize) {
    *counter = counter.wrapping_add(n as u32);
}
