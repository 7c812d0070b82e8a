//! The common part of all judged devices: their log, mood, values, and replies on their way.

use proto_core::time::{Duration, Instant};

use super::mood::{Mood, Moods};
use crate::Rng;
use crate::device::{Act, Order};
use crate::device::{Done, SlaveDone};

/// A device without its protocol.
#[derive(Debug)]
pub(super) struct Machine {
    pub rng: Rng,
    moods: Moods,
    timeout: Duration,
    values: [u16; 3],
    counts: [u8; 3],
    /// Replies that will be sent: when, their bytes, and the entry in the log.
    leaving: Vec<(Instant, Vec<u8>, Act)>,
    log: Vec<Act>,
    /// The device is on a bus, where a damaged frame is lost.
    is_on_bus: bool,
    /// The order in the last request; `None` if it was a query.
    order: Option<Order>,
}

/// What happens to a reply.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fate {
    /// How long the reply takes.
    pub delay: Duration,
    /// The reply is not sent.
    pub is_lost: bool,
    /// The reply is sent with an error.
    pub is_wrong: bool,
    /// The reply certainly arrives at the gateway in time.
    pub in_time: bool,
}

/// The result of an order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Answer {
    Good,
    Refused(u8),
}

impl Machine {
    pub(super) fn new(rng: Rng, start: Instant, timeout: Duration, is_on_bus: bool) -> Self {
        Self {
            rng,
            moods: Moods::new(start),
            timeout,
            values: [0; 3],
            counts: [0; 3],
            leaving: Vec::new(),
            log: Vec::new(),
            is_on_bus,
            order: None,
        }
    }

    pub(super) fn is_on(&self) -> bool {
        self.moods.now != Mood::Off
    }

    /// Whether the device refuses orders. A refusing drive sends nothing on its own.
    pub(super) fn is_refusing(&self) -> bool {
        self.moods.now == Mood::Refusing
    }

    /// The device received a query or an order.
    pub(super) fn heard(&mut self, order: Option<Order>) {
        self.order = order;
        self.log.push(Act::Heard(order));
    }

    /// The device gets an order, and executes it or not. `has_codes`: its refusals have codes with different meanings.
    pub(super) fn order(&mut self, order: Order, values: Vec<u32>, has_codes: bool) -> Answer {
        self.heard(Some(order));
        if self.moods.now != Mood::Refusing || self.rng.below(2) == 0 {
            self.log.push(Act::Did(order, values));
            return Answer::Good;
        }
        let code = match has_codes {
            true => [1, 2, 3, 4, 5, 5, 6, 6, 6, 7, 8, 10, 11][self.rng.below(13) as usize],
            false => 1,
        };
        let does = match code {
            // Acknowledge: accepted, but still in progress.
            5 if has_codes => true,
            // The device failed while it executed the order, or a gateway in between failed.
            4 | 8 | 10 | 11 => self.rng.below(2) == 0,
            _ => false,
        };
        if does {
            self.log.push(Act::Did(order, values));
        }
        self.log.push(Act::Refused(order, code));
        Answer::Refused(code)
    }

    /// Reads a value of the device. The high byte of a value says which one it is.
    pub(super) fn value(&mut self, nth: usize) -> u16 {
        self.heard(None);
        self.renew(nth)
    }

    /// As [`Self::value`], without a query.
    pub(super) fn renew(&mut self, nth: usize) -> u16 {
        if self.rng.below(2) == 0 || self.values[nth] == 0 {
            self.counts[nth] = self.counts[nth].wrapping_add(1);
            self.values[nth] = (0x41 + nth as u16) << 8 | u16::from(self.counts[nth]);
            self.log.push(Act::Holds(nth, self.values[nth]));
        }
        self.values[nth]
    }

    /// What happens to the next reply in the current mood.
    pub(super) fn fate(&mut self) -> Fate {
        let delay = self.moods.delay(self.timeout, &mut self.rng);
        let happens = self.rng.below(2) == 0;
        Fate {
            delay,
            is_lost: self.moods.now == Mood::Losing && happens,
            is_wrong: self.moods.now == Mood::Damaged && happens,
            in_time: delay + WAY < self.timeout,
        }
    }

    /// The log entry of a reply to the last request. `tells`: the reply differs from the request.
    pub(super) fn replied(&self, tells: bool, is_whole: bool, in_time: bool) -> Act {
        Act::Replied { order: self.order, tells, is_whole, in_time: is_whole && in_time }
    }

    /// Logs that a reply was not sent, or not as a valid reply.
    pub(super) fn lose_reply(&mut self, tells: bool) {
        let lost = self.replied(tells, false, false);
        self.log.push(lost);
    }

    /// Sends a reply, depending on the mood. `tells`: the reply differs from the request.
    pub(super) fn reply(&mut self, mut bytes: Vec<u8>, tells: bool, now: Instant) {
        let fate = self.fate();
        if fate.is_lost || fate.is_wrong && self.is_on_bus {
            return self.lose_reply(tells);
        }
        if fate.is_wrong {
            let at = self.rng.below(bytes.len() as u64) as usize;
            // Never changes only the case of a letter, which would still be the same digit.
            bytes[at] ^= 1 << self.rng.below(5);
        }
        let left = self.replied(tells, !fate.is_wrong, fate.in_time);
        self.leaving.push((now + fate.delay, bytes, left));
    }

    pub(super) fn deadline(&self) -> Instant {
        self.leaving.iter().map(|(at, ..)| *at).min().unwrap_or(Instant::NEVER).min(self.moods.ends)
    }

    /// What is sent now, and whether the device has lost its power.
    pub(super) fn poll(&mut self, now: Instant) -> (Vec<Vec<u8>>, bool) {
        let mut has_lost_power = false;
        if now >= self.moods.ends {
            let was_on = self.is_on();
            self.moods.next(now, &mut self.rng);
            match (was_on, self.is_on()) {
                (true, false) => {
                    has_lost_power = true;
                    self.leaving.clear();
                    self.log.push(Act::PowerOff);
                }
                (false, true) => self.log.push(Act::PowerOn),
                _ => {}
            }
        }
        let mut leave = Vec::new();
        while let Some(nth) = self.leaving.iter().position(|(at, ..)| *at <= now) {
            let (_, bytes, left) = self.leaving.remove(nth);
            self.log.push(left);
            leave.push(bytes);
        }
        (leave, has_lost_power)
    }

    pub(super) fn take_done(&mut self) -> Vec<SlaveDone> {
        std::mem::take(&mut self.log)
            .into_iter()
            .map(|act| SlaveDone { slave: 0, what: Done::Acted(act) })
            .collect()
    }
}

/// More than a reply takes on the line and in an adapter that gathers bytes.
const WAY: Duration = Duration::from_millis(25);
