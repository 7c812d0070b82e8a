//! What is counted of each peer of a line.

/// Counters of one peer of a line since the start; they wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct PeerCounters {
    /// Requests that were sent, with repetitions.
    pub requests: u32,
    /// Good replies.
    pub replies: u32,
    /// Requests without any reply in time.
    pub timeouts: u32,
    /// Requests whose reply had a wrong checksum.
    pub checksums: u32,
    /// Requests that the peer refused.
    pub refused: u32,
    /// The newest refusal's code on Modbus; 0 before one.
    pub refusal: u8,
    /// Repetitions.
    pub retries: u32,
    /// Times at which a request was not sent because a value of it was unknown or stale.
    pub unprepared: u32,
    /// Replies that came too late; nothing of them was taken.
    pub late_replies: u32,
    /// Requests that ended with what may have been their own echo.
    pub unconfirmed: u32,
    /// Times at which the peer had started, so that what is asked at its start was asked again.
    pub starts: u32,
    /// What became of events.
    pub events: EventCounters,
}

/// What became of events (docs/engine.md section 13), by the outcome's number; they wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default))]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct EventCounters {
    /// 2: the device confirmed it.
    pub done: u32,
    /// 3: the device refused it.
    pub refused: u32,
    /// 4: the device accepted it, and takes its time.
    pub accepted: u32,
    /// 5: it was sent, and no answer tells what became of it.
    pub unknown: u32,
    /// 6: it could not be sent in time.
    pub expired: u32,
    /// 7: not sent; a value is outside its limits.
    pub out_of_limits: u32,
    /// 8: not sent; a value is unknown or stale.
    pub no_value: u32,
    /// 9: not sent; the device is away.
    pub away: u32,
    /// 10: not sent; the event before it was still open.
    pub still_open: u32,
    /// 11: not sent; a write that stops the device came first.
    pub stopped: u32,
    /// 12: not sent; the step before it was not done.
    pub not_followed: u32,
}
