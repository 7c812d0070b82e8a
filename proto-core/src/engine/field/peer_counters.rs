//! Counters of each peer of a line.

/// Counters of one peer of a line since the start; they wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct PeerCounters {
    /// Requests sent, with repetitions.
    pub requests: u32,
    /// Good replies.
    pub replies: u32,
    /// Requests without any reply in time.
    pub timeouts: u32,
    /// Requests whose reply had a wrong checksum.
    pub checksums: u32,
    /// Requests that the peer refused.
    pub refused: u32,
    /// Modbus code of the newest refusal; 0 before the first.
    pub refusal: u8,
    /// Repetitions.
    pub retries: u32,
    /// Requests that were due but not sent, because a value was unknown or stale.
    pub unprepared: u32,
    /// Replies that arrived too late and were not taken.
    pub late_replies: u32,
    /// Requests after which only their own possible echo arrived.
    pub unconfirmed: u32,
    /// Starts of the peer, after each of which its start exchanges were repeated.
    pub starts: u32,
    /// Outcomes of events.
    pub events: EventCounters,
}

/// Outcomes of events (docs/engine.md section 13), with the outcome's number; they wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct EventCounters {
    /// 2: the device confirmed it.
    pub done: u32,
    /// 3: the device refused it.
    pub refused: u32,
    /// 4: the device accepted it and needs more time.
    pub accepted: u32,
    /// 5: it was sent, but no reply tells whether it was executed.
    pub unknown: u32,
    /// 6: it could not be sent in time.
    pub expired: u32,
    /// 7: not sent; a value is outside its limits.
    pub out_of_limits: u32,
    /// 8: not sent; a value is unknown or stale.
    pub no_value: u32,
    /// 9: not sent; the device does not respond, or its port is down.
    pub away: u32,
    /// 10: not sent; the previous event was still open.
    pub still_open: u32,
    /// 11: not sent; a write that stops the device took precedence.
    pub stopped: u32,
    /// 12: not sent; the previous step was not done.
    pub not_followed: u32,
}
