//! An event of an exchange: the bit that triggers it, its progress and its outcome (docs/engine.md section 13).

use super::peer_counters::EventCounters;
use crate::sysvar::SysVar;
use crate::time::{Duration, Instant};

/// The outcome of an event, as reported to the robot (docs/engine.md section 13).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize), serde(rename_all = "snake_case"))]
#[repr(u8)]
#[non_exhaustive]
pub enum Outcome {
    /// There was no event yet.
    #[default]
    None = 0,
    /// It waits to be sent, or for its reply.
    Open = 1,
    /// The device confirmed it.
    Done = 2,
    /// The device refused it.
    Refused = 3,
    /// The device accepted it and needs more time (Modbus exception 5).
    Accepted = 4,
    /// It was sent, but no reply tells whether it was executed.
    Unknown = 5,
    /// It could not be sent in time.
    Expired = 6,
    /// It was not sent: a value is outside its limits.
    OutOfLimits = 7,
    /// It was not sent: a value is unknown or stale.
    NoValue = 8,
    /// It was not sent: the device does not respond, or its port is down.
    Away = 9,
    /// It was not sent: the previous event was still open.
    StillOpen = 10,
    /// It was not sent: a write that stops the device took precedence.
    Stopped = 11,
    /// It was not sent: the previous step was not done.
    NotFollowed = 12,
}

/// The bit that triggers an exchange.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Trigger {
    pub var: SysVar,
    pub bit: u8,
    /// The newest reading.
    pub last: Option<Reading>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Reading {
    pub on: bool,
    pub at: Instant,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Event {
    /// No event is open.
    Over,
    /// The bit rose at `at`; newer values are pending.
    Risen { at: Instant, until: Instant },
    /// Its request is made, and waits for the exchange that it follows.
    Behind { len: u16, until: Instant },
    /// Its request is made and may be sent.
    Ready { len: u16, until: Instant },
    /// Its request was sent.
    Sent { len: u16, until: Instant },
}

/// What is reported to the robot about an exchange's events.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ReportedOutcome {
    pub outcome: Outcome,
    /// The code with which the device refused it.
    pub code: u16,
    /// Number of events that have ended, wrapping.
    pub ended: u16,
}

impl Trigger {
    pub(crate) const fn new((var, bit): (SysVar, u8)) -> Self {
        Self { var, bit, last: None }
    }

    /// Forgets the last reading, so that the next one is the first.
    pub(crate) const fn forget(&mut self) {
        self.last = None;
    }

    /// Takes a reading over the connection that is up since `up_since`. Returns whether the bit has risen, for an
    /// event, and for a write that stops, for which the bit need not have been read as 0 before.
    pub(crate) fn read(&mut self, reading: Reading, up_since: Instant, stale_after: Duration) -> [bool; 2] {
        let before = self.last.replace(reading);
        if !reading.on {
            return [false; 2];
        }
        // By its time, because a reading of an earlier connection may be checked again while this one is up.
        let before = before.filter(|before| before.at >= up_since);
        let was_off =
            before.is_some_and(|before| !before.on && reading.at.saturating_since(before.at) <= stale_after);
        // What happened between two connections is unknown.
        [was_off, !before.is_some_and(|before| before.on)]
    }
}

impl Event {
    pub(crate) const fn is_over(self) -> bool {
        matches!(self, Self::Over)
    }

    /// Whether it waits to be sent.
    pub(crate) const fn waits(self) -> bool {
        matches!(self, Self::Risen { .. } | Self::Behind { .. } | Self::Ready { .. })
    }

    /// Until when it may be sent, while it waits.
    pub(crate) const fn expires_at(self) -> Instant {
        match self {
            Self::Risen { until, .. } | Self::Behind { until, .. } | Self::Ready { until, .. } => until,
            Self::Over | Self::Sent { .. } => Instant::NEVER,
        }
    }
}

impl EventCounters {
    pub(crate) fn count(&mut self, outcome: Outcome) {
        let counter = match outcome {
            Outcome::None | Outcome::Open => return,
            Outcome::Done => &mut self.done,
            Outcome::Refused => &mut self.refused,
            Outcome::Accepted => &mut self.accepted,
            Outcome::Unknown => &mut self.unknown,
            Outcome::Expired => &mut self.expired,
            Outcome::OutOfLimits => &mut self.out_of_limits,
            Outcome::NoValue => &mut self.no_value,
            Outcome::Away => &mut self.away,
            Outcome::StillOpen => &mut self.still_open,
            Outcome::Stopped => &mut self.stopped,
            Outcome::NotFollowed => &mut self.not_followed,
        };
        *counter = counter.wrapping_add(1);
    }
}
