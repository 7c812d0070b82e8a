//! The behaviour of a polled device, which changes every few seconds: prompt, slow, late, refusing, dead, or with
//! damaged replies.

use proto_core::time::{Duration, Instant};

use crate::Rng;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Behaviour {
    Prompt,
    Slow,
    /// Some replies arrive after they have been given up.
    Late,
    /// It refuses requests, if it can.
    Refusing,
    /// One bit of some replies is wrong.
    Damaged,
    /// Some replies end too early.
    Short,
    /// Some replies are lost.
    Losing,
    /// Some replies are those of another slave, or to other requests.
    Mistaken,
    /// Other bytes come before some replies.
    Noisy,
    Dead,
}

/// The present behaviour of a device.
#[derive(Debug)]
pub(super) struct Behaves {
    pub like: Behaviour,
    ends: Instant,
}

/// The effect of a new behaviour on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Change {
    /// It has power.
    Alive,
    /// It loses its power.
    Dead,
    /// It loses its power for so long that it forgets everything it was told.
    Forgets,
}

impl Behaves {
    pub(super) fn new(start: Instant) -> Self {
        Self { like: Behaviour::Prompt, ends: start + Duration::from_secs(5) }
    }

    /// Begins another behaviour when the present one is over.
    pub(super) fn update(&mut self, now: Instant, rng: &mut Rng) -> Option<Change> {
        if now < self.ends {
            return None;
        }
        let (like, most) = match rng.below(24) {
            0..10 => (Behaviour::Prompt, 20_000),
            10 | 11 => (Behaviour::Slow, 5_000),
            12 | 13 => (Behaviour::Late, 5_000),
            14 => (Behaviour::Refusing, 2_000),
            15 => (Behaviour::Damaged, 5_000),
            16 => (Behaviour::Short, 3_000),
            17 => (Behaviour::Losing, 3_000),
            18 => (Behaviour::Mistaken, 3_000),
            19 => (Behaviour::Noisy, 3_000),
            20 | 21 => (Behaviour::Dead, 1_400),
            22 => (Behaviour::Dead, 10_000),
            _ => (Behaviour::Dead, 90_000),
        };
        let lasts = rng.up_to(Duration::from_millis(most));
        (self.like, self.ends) = (like, now + lasts);
        Some(match like {
            Behaviour::Dead if lasts > FORGETS_AFTER => Change::Forgets,
            Behaviour::Dead => Change::Dead,
            _ => Change::Alive,
        })
    }

    /// The delay of a reply.
    pub(super) fn delay(&self, timeout: Duration, rng: &mut Rng) -> Duration {
        let timeout = timeout.as_micros();
        Duration::from_micros(match self.like {
            Behaviour::Slow => rng.below(timeout * 8 / 10),
            Behaviour::Late if rng.below(2) == 0 => rng.between(timeout / 2, timeout * 3 - MARGIN),
            _ => rng.below(3_000),
        })
    }
}

/// A reply is at the master this long before three times the timeout, in microseconds: the time of a reply on a line,
/// of other replies before it, and in an adapter that gathers bytes.
const MARGIN: u64 = 45_000;
/// After this long without power, a device has forgotten everything it was told. By then it has missed enough requests
/// for the gateway to know that it was away.
const FORGETS_AFTER: Duration = Duration::from_millis(1_500);
