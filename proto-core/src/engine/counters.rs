//! Counters of everything that was accepted, rejected or skipped.

/// Counters of a field port. They wrap after 2^32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct PortCounters {
    /// Frames accepted.
    pub frames_in: u32,
    /// Bytes received (CAN: data bytes).
    pub bytes_in: u32,
    /// Frames handed over to the driver.
    pub frames_out: u32,
    /// Bytes handed over to the driver (CAN: data bytes).
    pub bytes_out: u32,
    /// Frames rejected because a value is not finite (D22); for device frames, those of which no value was taken.
    pub rejected_not_finite: u32,
    /// Frames rejected because a bound value did not fit its variable (D22); for device frames, those of which no value
    /// was taken.
    pub rejected_out_of_range: u32,
    /// CAN frames ignored because the recipe does not have their id (D17).
    pub rejected_id: u32,
    /// CAN frames rejected because their length is not the declared one (D17).
    pub rejected_length: u32,
    /// Remote frames ignored (D17).
    pub rejected_remote: u32,
    /// Frames rejected because their checksum is wrong.
    pub rejected_checksum: u32,
    /// Frames rejected because a field is not a number, such as a letter among digits; for device frames, those of which
    /// no value was taken.
    pub rejected_unreadable: u32,
    /// Valid frames of another device: a constant differs.
    pub rejected_other_device: u32,
    /// Frames rejected because their alive counter repeats that of the previous frame: the device may be frozen.
    pub rejected_counter: u32,
    /// Fields of accepted device frames that were rejected: a value that does not fit, is not finite, or is not a
    /// number.
    pub rejected_fields: u32,
    /// Fields of accepted frames for which the device reports that it has no value now.
    pub fields_without_value: u32,
    /// Frames received on a port whose recipe has no input part.
    pub rejected_no_input: u32,
    /// Frames that began with the head but did not end with the tail (D19).
    pub tail_mismatches: u32,
    /// Bytes dropped while looking for a frame (D19).
    pub resync_bytes: u32,
    /// Bytes of partial frames discarded after silence (D19), and bytes discarded because they waited while the gateway
    /// itself slept.
    pub discarded_bytes: u32,
    /// Chunks of bytes, or CAN frames, discarded because they waited while the gateway itself slept.
    pub asleep: u32,
    /// Accepted frames in which reserved bits were masked (D22).
    pub masked: u32,
    /// Accepted frames whose alive counter is not the next one: frames are missing before them.
    pub counter_jumps: u32,
    /// Frames with a text that is configured to be ignored, such as that of a scanner that read nothing.
    pub ignored: u32,
    /// Bit values replaced by newer ones because the queue of edges was full.
    pub edges_lost: u32,
    /// Values dropped before they were written: older than the port's timeout, or waiting for a link that was lost.
    pub values_expired: u32,
    /// Accepted frames with a value that was dropped because its link was down.
    pub undelivered: u32,
    /// Accepted frames with a value that was withheld until other variables were read back.
    pub withheld: u32,
    /// Cycles in which no output frame could be sent in time (D20).
    pub skipped_cycles: u32,
    /// Cycles in which no output frame was sent because its sources were stale or unknown, or because a field could not
    /// have its value.
    pub stale_cycles: u32,
    /// Requests without a good reply, after all repetitions.
    pub unanswered: u32,
    /// Requests that the device refused.
    pub refused: u32,
    /// Times that an input frame became overdue.
    pub timeouts: u32,
    /// Times that the device was reported gone.
    pub downs: u32,
    /// Times that the CAN controller was reported bus-off.
    pub bus_offs: u32,
    /// Commands picked by a value.
    pub commands: u32,
    /// Commands that could not be sent.
    pub commands_dropped: u32,
    /// Values that are in no command table: neither a command nor idle.
    pub commands_unknown: u32,
    /// Values that would have picked a command but only set the base: the first ones after the start, silence or a lost
    /// device.
    pub commands_based: u32,
}

/// Counters of a controller link, in addition to [`crate::link::LinkHistory`]. They wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct LinkCounters {
    /// Requests, frames or commands sent.
    pub sent: u32,
    /// Replies, frames or packets accepted.
    pub received: u32,
    /// Bytes received.
    pub bytes_in: u32,
    /// Requests without a reply within the timeout.
    pub timeouts: u32,
    /// Exceptions and failure replies.
    pub refused: u32,
    /// Malformed replies, frames and packets.
    pub malformed: u32,
    /// Received values that were not finite; the variables are unknown until a readable value arrives.
    pub unreadable: u32,
    /// Connections reset because the peer's transport had not acknowledged data before its deadline.
    pub unacknowledged: u32,
    /// Bytes dropped while looking for a frame.
    pub resync_bytes: u32,
    /// Time from the newest request with a reply to that reply, in microseconds.
    pub round_trip_us: u32,
    /// The longest round trip, in microseconds.
    pub round_trip_max_us: u32,
}

impl PortCounters {
    /// Counts a frame of `len` bytes that was handed over.
    pub(super) fn sent(&mut self, len: usize) {
        bump(&mut self.frames_out);
        add(&mut self.bytes_out, len);
    }

    /// Number of rejected frames, for any reason; wraps. Does not include CAN frames for other nodes:
    /// [`Self::rejected_id`] and [`Self::rejected_remote`] also count on a healthy bus.
    pub fn rejected(&self) -> u32 {
        let all = [
            self.rejected_not_finite,
            self.rejected_out_of_range,
            self.rejected_length,
            self.rejected_checksum,
            self.rejected_unreadable,
            self.rejected_other_device,
            self.rejected_counter,
            self.rejected_no_input,
            self.tail_mismatches,
        ];
        all.into_iter().fold(0, u32::wrapping_add)
    }
}

impl LinkCounters {
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

    /// Counts a reply that arrived `micros` after its request.
    pub(super) fn answered(&mut self, micros: u32) {
        bump(&mut self.received);
        self.round_trip_us = micros;
        self.round_trip_max_us = self.round_trip_max_us.max(micros);
    }
}

pub(super) fn bump(counter: &mut u32) {
    add(counter, 1);
}

pub(super) fn add(counter: &mut u32, n: usize) {
    *counter = counter.wrapping_add(n as u32);
}
