//! UTC, once the driver has reported it.

use proto_core::time::Instant;

/// Converts instants to UTC in milliseconds.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct UtcClock {
    known: Option<(Instant, u64)>,
}

impl UtcClock {
    /// A clock that does not know UTC.
    pub(crate) const fn unknown() -> Self {
        Self { known: None }
    }

    /// Sets UTC to `utc_ms` at this instant. Returns `true` if UTC was unknown before.
    pub(crate) fn set(&mut self, at: Instant, utc_ms: u64) -> bool {
        self.known.replace((at, utc_ms)).is_none()
    }

    pub(crate) const fn is_known(&self) -> bool {
        self.known.is_some()
    }

    /// The milliseconds since 1970 at an instant; while UTC is unknown, those since [`Instant::ZERO`].
    pub(crate) fn at(&self, instant: Instant) -> u64 {
        let ms = |from: Instant, to: Instant| to.saturating_since(from).as_millis();
        match self.known {
            None => ms(Instant::ZERO, instant),
            Some((at, utc)) => utc.saturating_add(ms(at, instant)).saturating_sub(ms(instant, at)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instants_before_and_after_are_told() {
        let mut clock = UtcClock::default();
        let at = Instant::from_millis;
        assert_eq!((clock.is_known(), clock.at(at(5_000))), (false, 5_000));
        assert!(clock.set(at(5_000), 1_700_000_000_000));
        assert_eq!(clock.at(at(7_000)), 1_700_000_002_000);
        assert_eq!(clock.at(at(1_000)), 1_699_999_996_000);
        assert!(!clock.set(at(6_000), 1_700_000_001_500));
        assert_eq!(clock.at(at(6_000)), 1_700_000_001_500);
    }
}
