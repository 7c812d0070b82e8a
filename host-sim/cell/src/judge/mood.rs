//! The behaviour of a judged device, which changes every few seconds.

use proto_core::time::{Duration, Instant};

use crate::Rng;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mood {
    Prompt,
    Slow,
    /// Replies take 0.2 to 3 times the timeout.
    Late,
    /// Some replies are not sent.
    Losing,
    /// Some replies are sent with damage.
    Damaged,
    /// Some orders are refused, with one of several codes.
    Refusing,
    /// Without power.
    Off,
}

/// The current mood and its end.
#[derive(Debug)]
pub(super) struct Moods {
    pub now: Mood,
    pub ends: Instant,
}

impl Moods {
    pub(super) fn new(start: Instant) -> Self {
        Self { now: Mood::Prompt, ends: start + Duration::from_secs(4) }
    }

    pub(super) fn next(&mut self, now: Instant, rng: &mut Rng) {
        let (mood, most) = match rng.below(20) {
            0..6 => (Mood::Prompt, 25_000),
            6 | 7 => (Mood::Slow, 5_000),
            8..11 => (Mood::Late, 6_000),
            11 | 12 => (Mood::Losing, 4_000),
            13 | 14 => (Mood::Damaged, 4_000),
            15..18 => (Mood::Refusing, 6_000),
            18 => (Mood::Off, 2_500),
            _ => (Mood::Off, 12_000),
        };
        (self.now, self.ends) =
            (mood, now + Duration::from_micros(1) + rng.up_to(Duration::from_millis(most)));
    }

    /// The delay of a reply.
    pub(super) fn delay(&self, timeout: Duration, rng: &mut Rng) -> Duration {
        let timeout = timeout.as_micros();
        Duration::from_micros(match self.now {
            Mood::Slow => rng.below(timeout * 8 / 10),
            Mood::Late => rng.between(timeout / 5, timeout * 3),
            _ => rng.below(3_000),
        })
    }
}
