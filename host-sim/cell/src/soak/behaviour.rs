//! The behaviour of a simulated device that answers requests. It changes every few seconds: prompt, slow, late,
//! refusing, dead, or with damaged replies.

use proto_core::time::{Duration, Instant};

use crate::Rng;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Behaviour {
    Prompt,
    Slow,
    /// Some replies come only after the master has given them up.
    Late,
    /// The device refuses requests, if it can.
    Refusing,
    /// Some replies have a wrong bit.
    Damaged,
    /// Some replies are cut short.
    Short,
    /// Some replies are missing.
    Losing,
    /// Some replies come from another slave, or answer another request.
    Mistaken,
    /// Some replies have other bytes before them.
    Noisy,
    Dead,
}

/// The current behaviour of a device.
#[derive(Debug)]
pub(super) struct Behaves {
    pub like: Behaviour,
    ends: Instant,
}

/// How a new behaviour changes the state of the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Change {
    /// The device has power.
    Alive,
    /// The device loses its power.
    Dead,
    /// The device loses its power for so long that it forgets what it was told.
    Forgets,
}

impl Behaves {
    pub(super) fn new(start: Instant) -> Self {
        Self { like: Behaviour::Prompt, ends: start + Duration::from_secs(5) }
    }

    /// Starts another behaviour when the current one is over.
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

/// In microseconds. A reply is sent this long before three times the timeout, so it arrives within them: time for the
/// reply on the line, for replies before it, and for an adapter that gathers bytes.
const MARGIN: u64 = 45_000;
/// After this long without power, a device has forgotten what it was told. By then the gateway has sent enough requests
/// to know that the device was away.
const FORGETS_AFTER: Duration = Duration::from_millis(1_500);
